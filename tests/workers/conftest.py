"""A temporary store and catalogue, and files taken into them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from sqlalchemy import text

from tests.blank_figures import blank_unless_told
from tests.in_process import InProcess
from tests.tables import copied_tables
from tests.whole.stack import Missing, postgres_database
from tests.workers.databases import change
from tests.workers.jobs import bench as bench
from workers import stage_timer
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import Base
from workers.settings import Settings


@pytest.fixture(scope="package", autouse=True)
def _tables(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with copied_tables(tmp_path_factory.mktemp("tables")):
        yield


@pytest.fixture(scope="module", autouse=True)
def _figures(request: pytest.FixtureRequest) -> Iterator[None]:
    yield from blank_unless_told(request)


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path / "data", database_url=None, broker_url="filesystem://")


@pytest.fixture
def local(settings: Settings) -> Iterator[InProcess]:
    service = InProcess(settings)
    yield service
    service.close()


@pytest.fixture(scope="session")
def postgres_tables() -> Iterator[str]:
    """The URL of a PostgreSQL database with this version's tables. Tests share it: to make one takes a second."""
    with ExitStack() as resources:
        try:
            url = resources.enter_context(postgres_database())
        except Missing as missing:
            pytest.skip(str(missing))
        catalogue_url = Settings(database_url=url).catalogue_url
        catalogue = Catalogue(catalogue_url)
        catalogue.upgrade()
        catalogue.close()
        yield catalogue_url


@pytest.fixture
def catalogue(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Catalogue]:
    """A catalogue without rows, in SQLite; the mark ``BOTH`` runs a test on PostgreSQL too."""
    postgresql = getattr(request, "param", "sqlite") == "postgresql"
    url = request.getfixturevalue("postgres_tables") if postgresql else f"sqlite:///{tmp_path / 'c.sqlite'}"
    catalogue = Catalogue(url)
    catalogue.upgrade()
    yield catalogue
    if postgresql:
        # A transaction that a test left open would let this wait for ever.
        tables = reversed(Base.metadata.sorted_tables)
        change(catalogue, text("SET LOCAL lock_timeout = '10s'"), *(table.delete() for table in tables))
    catalogue.close()


class Clock:
    """A clock that a test moves."""

    now = 100.0

    def perf_counter(self) -> float:
        return self.now

    monotonic = perf_counter


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The clock of the timers of stages."""
    clock = Clock()
    monkeypatch.setattr(stage_timer, "time", clock)
    return clock
