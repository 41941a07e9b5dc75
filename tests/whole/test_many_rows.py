"""Lists and look-ups read what they answer with and no more, however many rows there are."""

from __future__ import annotations

import random
import re
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.whole.many_rows import QUESTIONS, Archive, Size, fill, plan, statements
from tests.whole.stack import Missing, postgres_database
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import Base
from workers.settings import Settings

FEW = Size(psfs=1_000, products=1_000)
MANY = Size(psfs=100_000, products=1_000_000)
WALK = re.compile(rf"Seq Scan|^SCAN ({'|'.join(Base.metadata.tables)})\b")
# What is read is bounded by something else than the number of rows: what is put in order then is too.
SORTED = re.compile("valid at a time|in a context|best PSF|why none fits|status")


@pytest.fixture(params=["sqlite", "postgresql"], scope="module")
def database(request: pytest.FixtureRequest) -> str:
    name: str = request.param
    return name


def filled(database: str, folder: Path, size: Size, resources: ExitStack) -> Archive:
    """A catalogue of this size, in a database of its own."""
    if database == "sqlite":
        url = f"sqlite:///{folder / f'{size.products}.sqlite'}"
    else:
        try:
            url = Settings(database_url=resources.enter_context(postgres_database())).catalogue_url
        except Missing as missing:
            pytest.skip(str(missing))
    catalogue = Catalogue(url)
    resources.callback(catalogue.close)
    catalogue.upgrade()
    archive = fill(catalogue, url, size)
    resources.callback(archive.engine.dispose)
    return archive


@pytest.fixture(scope="module")
def few(database: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Archive]:
    with ExitStack() as resources:
        yield filled(database, tmp_path_factory.mktemp("few"), FEW, resources)


@pytest.fixture(scope="module")
def many(database: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Archive]:
    with ExitStack() as resources:
        yield filled(database, tmp_path_factory.mktemp("many"), MANY, resources)


def steps(archive: Archive, name: str, *, forced: bool) -> list[str]:
    """All steps of all that a question asks of the database."""
    with statements() as sent:
        QUESTIONS[name](archive, random.Random(1))
    asked = [one for one in sent if one[0].lstrip().startswith(("SELECT", "WITH"))]
    assert asked, "nothing was asked"
    return [step for one in asked for step in plan(archive, *one, forced=forced)]


def test_every_list_and_look_up_is_by_index(few: Archive) -> None:
    for name in QUESTIONS:
        plan = steps(few, name, forced=True)
        assert [step for step in plan if WALK.search(step)] == [], (name, plan)
        ordered = [step for step in plan if "TEMP B-TREE FOR ORDER BY" in step]
        assert not ordered or SORTED.search(name), (name, plan)


@pytest.mark.slow
def test_with_many_rows_every_list_and_look_up_is_by_index(many: Archive) -> None:
    """By the database's own choice, with the statistics of real numbers of rows."""
    walk = re.compile(r"Seq Scan on (psfs|products|psf_changes)\b|^SCAN (psfs|products)")
    for name in QUESTIONS:
        plan = steps(many, name, forced=False)
        assert [step for step in plan if walk.search(step)] == [], (name, plan)
