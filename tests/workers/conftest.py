"""A temporary store and catalogue, and files taken into them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from service.local import LocalService
from tests.tables import copied_tables
from tests.whole.stack import Missing, postgres_database
from workers.catalogue.catalogue import Catalogue
from workers.settings import Settings


@pytest.fixture(scope="package", autouse=True)
def _tables(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with copied_tables(tmp_path_factory.mktemp("tables")):
        yield


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path / "data", database_url=None, broker_url="filesystem://")


@pytest.fixture
def local(settings: Settings) -> Iterator[LocalService]:
    service = LocalService(settings)
    yield service
    service.close()


@pytest.fixture(scope="session")
def postgres_tables() -> Iterator[str]:
    """A PostgreSQL database with this version's tables, to be copied."""
    with ExitStack() as resources:
        try:
            url = resources.enter_context(postgres_database())
        except Missing as missing:
            pytest.skip(str(missing))
        catalogue = Catalogue(Settings(database_url=url).catalogue_url)
        catalogue.upgrade()
        catalogue.close()
        yield url


@pytest.fixture(params=["sqlite", "postgresql"])
def catalogue(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Catalogue]:
    if request.param == "sqlite":
        catalogue = Catalogue(f"sqlite:///{tmp_path / 'c.sqlite'}")
        catalogue.upgrade()
        yield catalogue
        catalogue.close()
        return
    with postgres_database(template=request.getfixturevalue("postgres_tables")) as url:
        catalogue = Catalogue(Settings(database_url=url).catalogue_url)
        catalogue.upgrade()
        yield catalogue
        catalogue.close()
