"""Timing the stages of an attempt: which time counts for which stage, and that the names stay few."""

from __future__ import annotations

import pytest

from psfcore.errors import DataError
from tests.workers.conftest import Clock
from workers.stage_timer import MOST_STAGES, OTHERS, STARTING, StageTime, StageTimer, short


def test_time_before_a_step_counts_for_its_stage(clock: Clock) -> None:
    times = StageTimer(_since=clock.now)
    for stage, step, took_s in (
        ("reading", 0, 1.0),  # the time before the first report
        ("deconvolving", 0, 2.0),  # still reading
        ("deconvolving", 1, 4.0),
        ("deconvolving", 1, 8.0),  # reported twice, counted once
        ("deconvolving", 2, 16.0),
        ("saving", 1, 32.0),
    ):
        clock.now += took_s
        with times.step(stage, step):
            clock.now += 1000.0  # the report itself
            with times.step("images", 7):  # a report within a report
                clock.now += 1000.0
    clock.now += 64.0
    assert times.end() == {
        STARTING: StageTime(1.0, 0),
        "reading": StageTime(2.0, 0),
        "deconvolving": StageTime(28.0, 2),
        "saving": StageTime(96.0, 1),
    }


def test_a_report_that_raises_is_counted_like_any_other(clock: Clock) -> None:
    times = StageTimer(_since=clock.now)
    with pytest.raises(DataError), times.step("reading", 1):
        raise DataError("x", "y")
    with times.step("reading", 2):
        pass
    assert times.end()["reading"].steps == 2


def test_names_stay_few() -> None:
    assert {short(f"fold {n}: errors of {n}") for n in range(50)} == {"fold n"}
    assert short("+2.5 DN: round 3") == short("-5 DN") == "n DN"
    assert len(short("x" * 999)) == 64
    times = StageTimer()
    for number in range(500):
        with times.step("abcdefghij"[number % 10] * (1 + number // 10), 1):
            pass
    assert len(times.end()) == MOST_STAGES + 1
    assert sum(one.steps for one in times.spent.values()) == 500 and times.spent[OTHERS].steps > 400
