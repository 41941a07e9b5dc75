"""Lists and look-ups read what they answer with and no more, however many rows there are."""

from __future__ import annotations

import random
import re
import statistics
import time
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
ROUNDS = 200  # of every question, to each of the two
MORE_ROWS_MS = 3.0  # a question may have a full page of answers with many rows, and one with few
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


@pytest.mark.slow
def test_a_million_rows_take_at_most_three_times_as_long_as_a_thousand(few: Archive, many: Archive) -> None:
    """The slowest in a hundred of all questions together, asked of the two in turn; and the middle of each question."""
    took: dict[str, dict[str, list[float]]] = {name: {"few": [], "many": []} for name in QUESTIONS}
    for round_number in range(-5, ROUNDS):  # the first ones fill caches
        for name, ask in QUESTIONS.items():
            for which, asked in (("few", few), ("many", many)):
                rng = random.Random(round_number)
                started = time.perf_counter()
                ask(asked, rng)
                if round_number >= 0:
                    took[name][which].append(1e3 * (time.perf_counter() - started))
    print(f"\n{'question':<42} {'p50 few':>8} {'many':>8} {'p99 few':>8} {'many':>8}  (ms)")
    for name, times in took.items():
        p50, p99 = ({which: _percentile(t, q) for which, t in times.items()} for q in (50, 99))
        print(f"{name:<42} {p50['few']:8.2f} {p50['many']:8.2f} {p99['few']:8.2f} {p99['many']:8.2f}")
    whole = {which: [t for times in took.values() for t in times[which]] for which in ("few", "many")}
    p99 = {which: _percentile(times, 99) for which, times in whole.items()}
    print(
        f"all: p99 {p99['few']:.2f} ms with {FEW.products} products, {p99['many']:.2f} ms with {MANY.products}"
    )
    assert p99["many"] <= 3 * p99["few"]
    walked = [
        name
        for name, times in took.items()
        if statistics.median(times["many"]) > 3 * statistics.median(times["few"]) + MORE_ROWS_MS
    ]
    assert walked == []


def _percentile(times: list[float], percent: int) -> float:
    return statistics.quantiles(times, n=100, method="inclusive")[percent - 1]
