"""A worker that is told to stop: its job ends in time, or goes back into the queue as if it had not been started.

The heartbeat of a job goes on after the database did not answer once.
"""

from __future__ import annotations

import json
import shutil
import signal
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
from sqlalchemy.exc import OperationalError

from tests.whole.stack import wait_for
from tests.workers.jobs import Bench, Task, job_row
from tests.workers.run.processes import new_catalogue, started_worker, worker_of
from workers.broker import app as queue
from workers.catalogue.jobs import Lease
from workers.catalogue.tables import DEFAULT_OWNER
from workers.contract.jobs import Phase
from workers.run.attempt import Attempt
from workers.run.child import Stopping
from workers.settings import Settings
from workers.tasks.catalogue_workspace import CatalogueWorkspace


def steps_for(seconds: float, at_work: Callable[[], None] = lambda: None) -> Task:
    """A task that says how far it is, again and again; ``at_work`` is called once it runs."""

    def task(context: CatalogueWorkspace, _: Mapping[str, Any]) -> str:
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


def test_a_cancelled_job_is_not_handed_back(bench: Bench) -> None:
    def cancelled(context: CatalogueWorkspace, _: Mapping[str, Any]) -> str:
        bench.catalogue.jobs.cancel(context.job_id)
        bench.stopping.ask(0.0)
        return steps_for(60.0)(context, {})

    row = bench.run(cancelled)
    assert (row.phase, row.result_id) == (Phase.ABORTED, None)


def test_a_job_that_takes_too_long_ends_at_its_next_report(bench: Bench) -> None:
    row = bench.run(steps_for(60.0), max_job_s=0.05)
    assert row.phase == Phase.ERROR and row.error is not None
    assert (row.error["code"], row.error["fault"]) == ("took-too-long", "user")
    assert "0.05 s (HELIOPSF_MAX_JOB_S)" in row.error["message"]


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
    attempt = Attempt(catalogue, Lease("job", "token"), Settings(heartbeat_s=0.01), Stopping())  # type: ignore[arg-type]
    with attempt.beating():
        assert third.wait(10.0), beats
    assert not attempt.stopped.is_set()


# Real processes -------------------------------------------------------------------------------------

DEAF = worker_of("""
def task(context, _):
    context.report("at work", 1, 2)
    time.sleep(60)
""")


def test_a_worker_that_stops_hands_back_the_job_of_a_deaf_task_and_is_gone(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / "data", broker_url="filesystem://", stop_s=0.5, heartbeat_s=0.2)
    log = tmp_path / "worker.log"
    with new_catalogue(settings) as catalogue:
        job, _ = catalogue.jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)
        assert queue.submit(queue.make_app(settings), job.id)
        with started_worker(DEAF, settings, log, stop_s=0.5, heartbeat_s=0.2, lease_s=3) as worker:
            wait_for(lambda: job_row(catalogue, job.id).phase == "EXECUTING", "the job is at work")
            wait_for(lambda: len(catalogue.census.workers(3.0)) == 1, "the worker says that it is there")
            processes = [psutil.Process(worker.pid), *psutil.Process(worker.pid).children(recursive=True)]
            worker.send_signal(signal.SIGTERM)
            status = worker.wait(settings.gone_s + 15.0)  # the machine may be busy
            _, left = psutil.wait_procs(processes, timeout=5)
        assert status == 0 and left == [], f"{status}, {left}; {log.read_text()}"
        row = job_row(catalogue, job.id)
        assert (row.phase, row.attempt, row.submitted_at) == (Phase.QUEUED, 0, None)
        assert catalogue.census.workers(60.0) == [], "it took its leave"
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert "exiting now" in lines[-1]["message"], lines
    (handed_back,) = [line for line in lines if "handed back" in line["message"]]
    assert (handed_back["job"], handed_back["owner"]) == (job.id, DEFAULT_OWNER), (
        "the thread of the heartbeat"
    )


def test_a_worker_that_ends_by_an_error_has_no_status_of_success(settings: Settings, tmp_path: Path) -> None:
    log = tmp_path / "worker.log"
    with (
        new_catalogue(settings) as catalogue,
        started_worker(worker_of("task = None"), settings, log) as worker,
    ):
        wait_for(lambda: len(catalogue.census.workers(60.0)) == 1, "the worker is there")
        shutil.rmtree(settings.data_dir / "broker" / "queue")
        assert worker.wait(60.0) == 1
