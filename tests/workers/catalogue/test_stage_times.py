"""Times of jobs' stages: what counts for which, what is kept of attempts, and that keeping it harms none."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import text
from sqlalchemy.exc import OperationalError

from psfcore.errors import DataError
from workers.catalogue import stage_times
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.stage_times import MOST_STAGES, OTHERS, STARTING, Spent, StageTimes, short
from workers.catalogue.tables import DEFAULT_OWNER, JobRow
from workers.contract.phases import Phase
from workers.files.store import Store
from workers.run.runner import Runner
from workers.settings import Settings
from workers.tasks.context import Context

Task = Callable[[Context, Mapping[str, Any]], str]


class Clock:
    """A clock that goes on only where it is told to."""

    now = 100.0

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(stage_times, "time", clock)
    return clock


def test_seconds_before_a_step_are_its_stage_s_and_those_before_a_beginning_the_former_stage_s(
    clock: Clock,
) -> None:
    times = StageTimes(_since=clock.now)
    for stage, step, took_s in (
        ("reading", 0, 1.0),  # of what was before
        ("deconvolving", 0, 2.0),  # of the reading
        ("deconvolving", 1, 4.0),
        ("deconvolving", 1, 8.0),  # said twice, done once
        ("deconvolving", 2, 16.0),
        ("saving", 1, 32.0),
    ):
        clock.now += took_s
        with times.step(stage, step):
            clock.now += 1000.0  # saying so
            with times.step("images", 7):  # of the job that this is a piece of
                clock.now += 1000.0
    clock.now += 64.0
    assert times.end() == {
        STARTING: Spent(1.0, 0),
        "reading": Spent(2.0, 0),
        "deconvolving": Spent(28.0, 2),
        "saving": Spent(96.0, 1),
    }


def test_a_report_that_raises_is_counted_like_any_other(clock: Clock) -> None:
    times = StageTimes(_since=clock.now)
    with pytest.raises(DataError), times.step("reading", 1):
        raise DataError("x", "y")
    with times.step("reading", 2):
        pass
    assert times.end()["reading"].steps == 2


def test_names_stay_few() -> None:
    assert {short(f"fold {n}: errors of {n}") for n in range(50)} == {"fold n"}
    assert short("+2.5 DN: round 3") == short("-5 DN") == "n DN"
    assert len(short("x" * 999)) == 64
    times = StageTimes()
    for number in range(500):
        with times.step("abcdefghij"[number % 10] * (1 + number // 10), 1):
            pass
    assert len(times.end()) == MOST_STAGES + 1
    assert sum(one.steps for one in times.spent.values()) == 500 and times.spent[OTHERS].steps > 400


# In the catalogue -------------------------------------------------------------------------------------


def test_what_many_attempts_spend_is_added_up(catalogue: Catalogue) -> None:
    def add() -> None:
        for _ in range(20):
            catalogue.stage_times.add("deconvolve", {"b": Spent(0.5, 2), "a": Spent(0.25, 1)})

    threads = [threading.Thread(target=add) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    catalogue.stage_times.add("bulk", {"a": Spent(1.0, 0)})
    catalogue.stage_times.add("bulk", {})
    assert catalogue.stage_times.all() == {
        ("bulk", "a"): Spent(1.0, 0),
        ("deconvolve", "a"): Spent(20.0, 80),
        ("deconvolve", "b"): Spent(40.0, 160),
    }


def run(folder: Path, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch, task: Task) -> JobRow:
    """The row of a job of this task after an attempt."""
    settings = Settings(data_dir=folder / "data", broker_url="filesystem://")
    monkeypatch.setattr("workers.tasks.psf_build.psf_build", task)
    job, _ = catalogue.jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)
    Runner(settings, catalogue, Store(settings.data_dir)).run(job.id)
    row = catalogue.jobs.get(job.id)
    assert row is not None
    return row


def slow_reports(context: Context, _: Mapping[str, Any]) -> str:
    for step in range(4):
        context.report("at work: on something", step, 3)
        if step < 3:
            time.sleep(0.02)
    return "result"


def test_an_attempt_leaves_its_stages_and_the_time_of_writing_is_in_none(
    tmp_path: Path, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = catalogue.jobs.progress

    def slowly(*given: Any) -> bool:
        time.sleep(0.4)
        return written(*given)

    monkeypatch.setattr(catalogue.jobs, "progress", slowly)
    job = run(tmp_path, catalogue, monkeypatch, slow_reports)
    assert job.phase == Phase.COMPLETED
    kept = catalogue.stage_times.all()
    assert set(kept) == {("psf-build", STARTING), ("psf-build", "at work")}
    spent = kept["psf-build", "at work"]
    assert spent.steps == 3 and 0.06 <= spent.seconds < 1.2, "four writes of 0.4 s are not in it"
    catalogue.uws.destroy(job.id)
    assert catalogue.stage_times.all() == kept


def fails(context: Context, _: Mapping[str, Any]) -> str:
    context.report("at work", 1, 2)
    raise DataError("bad", "no good")


def passing(context: Context, _: Mapping[str, Any]) -> str:
    context.report("at work", 1, 2)
    raise ConnectionError


@pytest.mark.parametrize(("task", "phase"), [(fails, Phase.ERROR), (passing, Phase.QUEUED)])
def test_attempts_that_end_badly_count_too(
    tmp_path: Path, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch, task: Task, phase: Phase
) -> None:
    assert run(tmp_path, catalogue, monkeypatch, task).phase == phase
    assert catalogue.stage_times.all()["psf-build", "at work"].steps == 1


@pytest.mark.parametrize("trouble", ["away", "no table"])
def test_a_job_s_outcome_stands_where_its_times_cannot_be_kept(
    tmp_path: Path,
    catalogue: Catalogue,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    trouble: str,
) -> None:
    if trouble == "no table":
        with catalogue._engine.begin() as connection:
            connection.execute(text("DROP TABLE stage_times"))
    else:

        def away(*_: object) -> None:
            raise OperationalError("INSERT", None, Exception("away"))

        monkeypatch.setattr(catalogue.stage_times, "add", away)
    with caplog.at_level(logging.WARNING, "workers.run.runner"):
        job = run(tmp_path, catalogue, monkeypatch, slow_reports)
    assert (job.phase, job.result_id) == (Phase.COMPLETED, "result")
    assert "could not keep its stage times" in caplog.text
