"""Lists and look-ups read what they answer with and no more, however many rows there are."""

from __future__ import annotations

import random
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cache

import pytest

from tests.whole.many_rows import QUESTIONS, Archive, Size, fill, plan, statements
from tests.whole.stack import Missing, postgres_database
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import Base
from workers.settings import Settings

FEW = Size(psfs=1_000, products=1_000)
MANY = Size(psfs=100_000, products=1_000_000)
Fill = Callable[[Size], Archive]
WALK = re.compile(rf"Seq Scan|^SCAN ({'|'.join(Base.metadata.tables)})\b")
# What is read is bounded by something else than the number of rows: what is put in order then is too.
SORTED = re.compile("valid at a time|in a context|best PSF|why none fits|status")


@pytest.fixture(params=["sqlite", "postgresql"], scope="module")
def filled(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fill]:
    """A function that gives a catalogue of a size, in a database of its own."""
    with ExitStack() as resources:

        @cache
        def archive(size: Size) -> Archive:
            if request.param == "sqlite":
                url = f"sqlite:///{tmp_path_factory.mktemp('rows') / 'many.sqlite'}"
            else:
                try:
                    url = Settings(database_url=resources.enter_context(postgres_database())).catalogue_url
                except Missing as missing:
                    pytest.skip(str(missing))
            catalogue = Catalogue(url)
            resources.callback(catalogue.close)
            catalogue.upgrade()
            made = fill(catalogue, url, size)
            resources.callback(made.engine.dispose)
            return made

        yield archive


def steps(archive: Archive, name: str, *, forced: bool) -> list[str]:
    """All steps of all that a question asks of the database."""
    with statements() as sent:
        QUESTIONS[name](archive, random.Random(1))
    asked = [one for one in sent if one[0].lstrip().startswith(("SELECT", "WITH"))]
    assert asked, "nothing was asked"
    return [step for one in asked for step in plan(archive, *one, forced=forced)]


def test_every_list_and_look_up_is_by_index(filled: Fill) -> None:
    for name in QUESTIONS:
        plan = steps(filled(FEW), name, forced=True)
        assert [step for step in plan if WALK.search(step)] == [], (name, plan)
        ordered = [step for step in plan if "TEMP B-TREE FOR ORDER BY" in step]
        assert not ordered or SORTED.search(name), (name, plan)


@pytest.mark.slow
def test_with_many_rows_every_list_and_look_up_is_by_index(filled: Fill) -> None:
    """By the database's own choice, with the statistics of real numbers of rows."""
    walk = re.compile(r"Seq Scan on (psfs|products|psf_changes)\b|^SCAN (psfs|products)")
    for name in QUESTIONS:
        plan = steps(filled(MANY), name, forced=False)
        assert [step for step in plan if walk.search(step)] == [], (name, plan)
