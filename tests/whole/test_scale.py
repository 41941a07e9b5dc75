"""The costs of a mission and the simulated queue: cases with a known answer, and the tables of the page."""

from __future__ import annotations

from itertools import takewhile

import pytest

from studies.scale import PAGE, Case, Costs, simulated, tables, written

COSTS = Costs(core_s=10.0, statements=50.0, row_bytes=1e3, finish_s=1e-6, metrics_s=1e-7, quota_s=1e-7)
AT_ONCE = [0.0] * 1000


def test_workers_without_faults_need_the_time_of_their_images() -> None:
    found = simulated(Case(10, AT_ONCE, bandwidth=1e15), COSTS)
    assert found.ended_s == pytest.approx(1000.0, rel=1e-3) and found.lost == 0
    even = simulated(Case(20, [float(n) for n in range(1000)], bandwidth=1e15), COSTS)
    assert even.p95_s == pytest.approx(10.0, rel=1e-3), "no image waits for a worker"


def test_the_slowest_part_sets_the_pace() -> None:
    store = simulated(Case(500, AT_ONCE, bandwidth=4.0 * COSTS.moved_bytes), COSTS)
    assert store.ended_s == pytest.approx(1000 / 4.0 + COSTS.core_s, rel=0.01)
    locked = Costs(**(vars(COSTS) | {"finish_s": 0.5}))
    assert simulated(Case(500, AT_ONCE, bandwidth=1e15), locked).ended_s == pytest.approx(510.0, rel=0.01)
    slow = simulated(Case(1, AT_ONCE, bandwidth=COSTS.moved_bytes / 5.0, slow=True), COSTS)
    # An image takes 50 s in the first 600 s of an hour and then 10 s: 312 images an hour, and 64 in the fourth.
    assert slow.ended_s == pytest.approx(3 * 3600.0 + 600.0 + 52 * 10.0, rel=0.02)


def test_killed_workers_lose_time_and_no_image() -> None:
    case = Case(10, AT_ONCE, kill_s=100.0, bandwidth=1e15)
    found = simulated(case, COSTS)
    assert len(found.waits_s) == 1000
    # A worker lives for 100 s on average and is away for 60 s; it needs exp(0.1) tries of 10 s or less for an image.
    assert found.lost == pytest.approx(1000 * 0.105, rel=0.25)
    assert found.ended_s == pytest.approx(1000.0 * 1.6, rel=0.15)


def test_the_page_has_the_tables_of_these_costs() -> None:
    page = PAGE.read_text("utf-8")
    lines = list(takewhile(lambda line: not line.startswith("| a day of AIA"), tables(Costs.stored())))
    assert len(lines) > 20 and "\n".join(lines) in page, "`python -m studies.scale --write` writes them"


@pytest.mark.slow
def test_the_page_has_the_tables_of_the_simulation() -> None:
    page = PAGE.read_text("utf-8")
    assert written(page, Costs.stored()) == page
