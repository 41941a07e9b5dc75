"""A worker that is told to stop: its job ends in time, or goes back into the queue as if it had not been started.

The heartbeat of a job goes on after the database did not answer once.
"""

from __future__ import annotations

import json
import logging
import shutil
import signal
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest
from sqlalchemy.exc import OperationalError

from tests.whole.stack import wait_for
from tests.workers.jobs import job_row
from tests.workers.run.processes import started_worker, worker_of
from workers import logs
from workers.broker import app as queue
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.catalogue.tables import DEFAULT_OWNER, JobRow
from workers.contract.jobs import Phase
from workers.files.store import Store
from workers.run.attempt import Attempt
from workers.run.child import Stopping
from workers.run.runner import Runner
from workers.settings import Settings
from workers.tasks.context import Context

Task = Callable[[Context, Mapping[str, Any]], str]


class Bench:
    """A runner with one task of the test's own, in a thread."""

    def __init__(self, folder: Path, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
        self.catalogue = catalogue
        self.stopping = Stopping()
        self._settings = Settings(data_dir=folder / "data", heartbeat_s=0.05, broker_url="filesystem://")
        self._monkeypatch = monkeypatch

    def run(self, task: Task) -> JobRow:
        """The job's row after a run of it."""
        self._monkeypatch.setattr("workers.tasks.psf_build.psf_build", task)
        job, _ = self.catalogue.jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)
        self.catalogue.jobs.mark_submitted(job.id)
        store = Store(self._settings.data_dir)
        Runner(self._settings, self.catalogue, store, stopping=self.stopping).run(job.id)
        return self.row(job.id)

    def row(self, job_id: str) -> JobRow:
        """The job's row."""
        return job_row(self.catalogue, job_id)


@pytest.fixture
def bench(tmp_path: Path, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(tmp_path, catalogue, monkeypatch)


def steps_for(seconds: float, at_work: Callable[[], None] = lambda: None) -> Task:
    """A task that says how far it is, again and again; ``at_work`` is called once it runs."""

    def task(context: Context, _: Mapping[str, Any]) -> str:
        at_work()
        ends = time.monotonic() + seconds
        while time.monotonic() < ends:
            context.report("at work", 1, 2)
            time.sleep(0.01)
        return "result"

    return task


def test_a_job_that_lasts_is_handed_back_and_the_attempt_does_not_count(bench: Bench) -> None:
    row = bench.run(steps_for(60.0, at_work=lambda: bench.stopping.ask(0.1)))
    assert (row.phase, row.attempt, row.lease) == (Phase.QUEUED, 0, None)
    assert [job_id for job_id, _ in bench.catalogue.jobs.unsubmitted(3600.0)] == [row.id], (
        "it is submitted at once"
    )
    bench.stopping = Stopping()  # another worker
    row = bench.run(steps_for(0.0))
    assert (row.phase, row.attempt, row.result_id) == (Phase.COMPLETED, 1, "result")


def test_a_job_that_ends_in_time_is_let_end_and_asking_again_does_not_move_the_moment(bench: Bench) -> None:
    assert bench.run(steps_for(0.2, at_work=lambda: bench.stopping.ask(60.0))).phase == Phase.COMPLETED
    stopping = Stopping()
    assert not stopping.asked and not stopping.due
    stopping.ask(0.0)
    stopping.ask(60.0)
    assert stopping.asked and stopping.due


def test_a_task_that_does_not_listen_loses_its_job_all_the_same(bench: Bench) -> None:
    seen: list[str] = []

    def deaf(context: Context, _: Mapping[str, Any]) -> str:
        bench.stopping.ask(0.0)
        wait_for(lambda: bench.row(context.job_id).phase == Phase.QUEUED, "the job is handed back")
        seen.append("handed back while it ran")
        return "too late"

    row = bench.run(deaf)
    assert seen and (row.phase, row.result_id, row.attempt) == (Phase.QUEUED, None, 0)


def test_a_worker_that_stops_takes_no_job(bench: Bench) -> None:
    bench.stopping.ask(30.0)
    row = bench.run(steps_for(0.0))
    assert (row.phase, row.attempt) == (Phase.QUEUED, 0)
    assert [job_id for job_id, _ in bench.catalogue.jobs.unsubmitted(3600.0)] == [row.id], (
        "the message is gone"
    )


def test_a_cancelled_job_is_not_handed_back(bench: Bench) -> None:
    def cancelled(context: Context, _: Mapping[str, Any]) -> str:
        bench.catalogue.jobs.cancel(context.job_id)
        bench.stopping.ask(0.0)
        return steps_for(60.0)(context, {})

    assert bench.run(cancelled).phase == Phase.ABORTED


def test_the_lines_of_a_job_carry_its_id_and_owner(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    said: list[dict[str, str]] = []

    class Keep(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            said.append({"message": record.getMessage(), **logs.about()})

    keep = Keep()
    logging.getLogger("workers.run").addHandler(keep)
    caplog.set_level(logging.INFO)
    row = bench.run(steps_for(60.0, at_work=lambda: bench.stopping.ask(0.0)))
    logging.getLogger("workers.run").removeHandler(keep)
    by_heart = [one for one in said if "handed back" in one["message"]]
    assert by_heart and len(said) >= 3
    assert all((one["job"], one["owner"]) == (row.id, "local") for one in said)
    assert logs.about() == {}


# Heartbeats -----------------------------------------------------------------------------------------


def test_a_heartbeat_that_failed_is_followed_by_another() -> None:
    beats: list[str] = []
    third = threading.Event()

    def heartbeat(lease: Lease) -> bool:
        beats.append(lease.job_id)
        if len(beats) == 1:
            raise OperationalError("UPDATE", {}, OSError("gone"))
        if len(beats) == 3:
            third.set()
        return True

    catalogue = SimpleNamespace(jobs=SimpleNamespace(heartbeat=heartbeat))
    attempt = Attempt(catalogue, Lease("job", "token"), 0.01, Stopping(), None, limit_s=60.0)  # type: ignore[arg-type]
    with attempt.beating():
        assert third.wait(10.0), beats
    assert not attempt.stopped.is_set()


# Real processes -------------------------------------------------------------------------------------

TASKS = {
    "listens": """
def task(context, _):
    while True:
        context.report("at work", 1, 2)
        time.sleep(0.02)
""",
    "deaf": """
def task(context, _):
    context.report("at work", 2, 2)
    time.sleep(60)
""",
}


@pytest.mark.parametrize("task", [pytest.param("listens", marks=pytest.mark.slow), "deaf"])
def test_a_worker_process_hands_its_job_back_and_is_gone_in_the_time_it_states(
    tmp_path: Path, task: str
) -> None:
    settings = Settings(data_dir=tmp_path / "data", broker_url="filesystem://", stop_s=0.5, heartbeat_s=0.2)
    settings.data_dir.mkdir()
    catalogue = Catalogue(settings.catalogue_url)
    catalogue.upgrade()
    job, _ = catalogue.jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)
    assert queue.submit(queue.make_app(settings), job.id)
    log = tmp_path / "worker.log"
    worker = started_worker(worker_of(TASKS[task]), settings, log, stop_s=0.5, heartbeat_s=0.2, lease_s=3)
    try:
        wait_for(lambda: job_row(catalogue, job.id).phase == "EXECUTING", "the job is at work")
        wait_for(lambda: len(catalogue.census.workers(3.0)) == 1, "the worker says that it is there")
        processes = [psutil.Process(worker.pid), *psutil.Process(worker.pid).children(recursive=True)]
        worker.send_signal(signal.SIGTERM)
        status = worker.wait(settings.gone_s + 15.0)  # the machine may be busy
        _, left = psutil.wait_procs(processes, timeout=5)
    finally:
        if worker.poll() is None:
            worker.kill()
            worker.wait()
    assert status == 0 and left == [], f"{status}, {left}; {log.read_text()}"
    row = job_row(catalogue, job.id)
    assert (row.phase, row.attempt, row.submitted_at) == (Phase.QUEUED, 0, None)
    told_of = log.read_text()
    assert ("another worker has the job" in told_of) == (task == "listens"), told_of
    assert "exiting now" in told_of or task == "listens", told_of
    assert catalogue.census.workers(60.0) == [], "it took its leave"
    catalogue.close()
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert any(line.get("job") == job.id for line in lines)


def test_a_worker_that_ends_by_an_error_has_no_status_of_success(settings: Settings, tmp_path: Path) -> None:
    settings.data_dir.mkdir()
    catalogue = Catalogue(settings.catalogue_url)
    catalogue.upgrade()
    worker = started_worker(worker_of("task = None"), settings, tmp_path / "worker.log")
    try:
        wait_for(lambda: len(catalogue.census.workers(60.0)) == 1, "the worker is there")
        shutil.rmtree(settings.data_dir / "broker" / "queue")
        assert worker.wait(60.0) == 1
    finally:
        if worker.poll() is None:
            worker.kill()
            worker.wait()
        catalogue.close()
