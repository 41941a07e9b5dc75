"""Stage times in the catalogue: the sums over attempts; a failure to store them changes no job's outcome."""

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
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.stage_times import Spent
from workers.catalogue.tables import DEFAULT_OWNER, JobRow
from workers.contract.phases import Phase
from workers.files.store import Store
from workers.run.runner import Runner
from workers.settings import Settings
from workers.tasks.context import Context
from workers.tasks.stage_timer import STARTING

Task = Callable[[Context, Mapping[str, Any]], str]


def test_times_of_many_attempts_are_summed(catalogue: Catalogue) -> None:
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


def test_an_attempt_stores_its_stages_without_the_time_of_writing(
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
def test_failed_attempts_count_too(
    tmp_path: Path, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch, task: Task, phase: Phase
) -> None:
    assert run(tmp_path, catalogue, monkeypatch, task).phase == phase
    assert catalogue.stage_times.all()["psf-build", "at work"].steps == 1


@pytest.mark.parametrize("trouble", ["away", "no table"])
def test_a_job_ends_normally_if_its_times_cannot_be_stored(
    tmp_path: Path,
    catalogue: Catalogue,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    trouble: str,
) -> None:
    if trouble == "no table":
        with catalogue._engine.begin() as connection:
            connection.execute(text("ALTER TABLE stage_times RENAME TO elsewhere"))
    else:

        def away(*_: object) -> None:
            raise OperationalError("INSERT", None, Exception("away"))

        monkeypatch.setattr(catalogue.stage_times, "add", away)
    with caplog.at_level(logging.WARNING, "workers.run.runner"):
        job = run(tmp_path, catalogue, monkeypatch, slow_reports)
    assert (job.phase, job.result_id) == (Phase.COMPLETED, "result")
    assert "could not keep its stage times" in caplog.text
    if trouble == "no table":
        with catalogue._engine.begin() as connection:
            connection.execute(text("ALTER TABLE elsewhere RENAME TO stage_times"))
