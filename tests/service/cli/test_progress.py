"""The progress that commands tell: a bar on a terminal, lines elsewhere, and the time left in a count of steps."""

from __future__ import annotations

import pytest

from service.cli import progress
from service.cli.progress import Pace, duration, progress_bar, say


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time in its only entry, s."""
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_the_time_left_never_counts_earlier_stages() -> None:
    """Reading took 250 s; then each of ten steps takes 1 s."""
    pace = Pace()
    assert pace.left_s(0, 5, 0.0) is None
    assert pace.left_s(4, 5, 240.0) == pytest.approx(60.0)
    assert pace.left_s(5, 5, 250.0) == 0.0
    assert pace.left_s(1, 11, 251.0) is None, "one report has no pace"
    assert pace.left_s(2, 11, 252.0) == pytest.approx(9.0)
    assert pace.left_s(5, 11, 255.0) == pytest.approx(6.0)


def test_a_count_that_begins_again_has_a_pace_of_its_own() -> None:
    pace = Pace()
    for step in range(5):
        pace.left_s(step, 4, 100.0 * step)
    assert pace.left_s(0, 4, 400.0) is None, "the same number of steps, a new round"
    assert pace.left_s(1, 4, 402.0) == pytest.approx(6.0)


def test_the_time_left_shrinks_while_a_step_lasts() -> None:
    pace = Pace()
    pace.left_s(0, 3, 0.0)
    assert [pace.left_s(1, 3, 10.0 + wait) for wait in (0, 5, 50)] == [20.0, 15.0, 0.0]


def test_durations_are_told_in_the_largest_unit() -> None:
    assert [duration(s) for s in (0, 6.4, 119, 125, 8000, 200_000)] == [
        "0 s", "6 s", "119 s", "2 min", "2 h", "2 days",
    ]  # fmt: skip


def test_a_terminal_shows_a_bar(
    clock: list[float], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    with progress_bar() as report:
        report("reading", 1, 4)
        clock[0] += 3
        report("reading", 2, 4)
        say("the service answers again")
        report("nothing to do", 0, 0)
        report("\x1b[2J", 0, 0)
        say("\x1b[2J")
    told = capsys.readouterr().err
    assert f"[{'#' * 10}{'-' * 10}] 2/4    3.0 s, 6 s left" in told
    assert "\nthe service answers again\n" in told and "0/0    3.0 s              " in told
    assert "\x1b" not in told and told.endswith("\\x1b[2J\n")


def test_without_a_terminal_a_line_is_written_now_and_then(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    with progress_bar() as report:
        for second in range(25):
            report("reading" if second < 12 else "fitting", second % 12, 24)
            clock[0] += 1
        say("a note")
    told = capsys.readouterr().err.splitlines()
    assert told == [
        "reading: step 10 of 24 after 10 s, 14 s left",
        "fitting: step 8 of 24 after 20 s, 16 s left",
        "a note",
    ]


def test_a_job_that_takes_longer_than_estimated_has_no_time_left(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    with progress_bar() as report:
        for second in range(40):
            report("fitting", min(10 * second, 99), 100)
            clock[0] += 1
    assert capsys.readouterr().err.splitlines() == [f"fitting: 99 % after {s} s" for s in (10, 20, 30)]


def test_a_short_command_writes_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar() as report:
        report("reading", 1, 2)
    assert capsys.readouterr().err == ""


def test_a_stage_and_its_step_as_text(subtests: pytest.Subtests) -> None:
    for stage, step, steps, text in (
        ("reading", 3, 20, "reading: step 3 of 20"),
        ("error estimate", 3, 12, "error estimate: realisation 3 of 12"),
        ("fit: round 2", 43, 100, "fit: round 2: 43 %"),
        ("saving", 0, 1, "saving"),
        ("saving", 1, 1, "saving: step 1 of 1"),
        ("compiling kernels (only once)", 0, 0, "compiling kernels (only once)"),
    ):
        with subtests.test(str((stage, step, steps, text))):
            assert progress.step_text(stage, step, steps) == text
