"""A job that takes too much memory fails, and one that does not stop is ended; its worker goes on with the next job."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from mmap import MAP_ANONYMOUS, MAP_PRIVATE, PROT_READ, mmap
from pathlib import Path
from typing import Any

import psutil
import pytest
from celery import Celery

from tests.whole.stack import wait_for
from tests.workers.jobs import job_row
from tests.workers.run.processes import new_catalogue, started_worker, worker_of
from workers.broker import app as queue
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, JobRow
from workers.run.child import MARGIN, MIB, Child, data_bytes, is_out_of_memory
from workers.settings import Settings

# A worker of one process, whose jobs do what their parameters say.
WORKER = worker_of("""
import ctypes
import numpy as np

def task(context, parameters):
    context.report("at work", 1, 2)
    match parameters["what"]:
        case "greedy":
            kept = []
            while True:
                kept.append(np.ones(2**20))
                assert len(kept) * 8 <= parameters["most_mib"], "more memory than the limit"
        case "large":
            kept = np.ones(parameters["mib"] * 2**17)
        case "deaf":
            time.sleep(600)
        case "deaf in C":
            ctypes.PyDLL(None).sleep(600)  # with the interpreter's lock: no other thread can run
    return "result"
""")
LEASE_S = 2.0


@dataclass
class Worker:
    """A worker process, its catalogue and its broker."""

    process: subprocess.Popen[bytes]
    catalogue: Catalogue
    broker: Celery
    log: Path
    submitted: int = 0

    def submit(self, what: str, *, estimate_mib: int = 100, **parameters: Any) -> JobRow:
        """Submit a job."""
        self.submitted += 1
        job, _ = self.catalogue.jobs.submit(
            "psf-build",
            {"what": what, **parameters},
            f"key {self.submitted}",
            DEFAULT_OWNER,
            estimate={"memory_mib": estimate_mib, "seconds": 1.0, "start_s": 1.0},
        )
        assert queue.submit(self.broker, job.id)
        return job

    def wait(self, job: JobRow, phase: str) -> JobRow:
        """The job's row when it has this phase."""
        row = partial(job_row, self.catalogue, job.id)
        wait_for(lambda: row().phase == phase, f"{phase}; {self.log.read_text()}", 60.0)
        return row()

    def wait_at_work(self, job: JobRow) -> None:
        """Wait until the job's task has begun: before, a cancellation ends the job without its process."""
        row = partial(job_row, self.catalogue, job.id)
        wait_for(lambda: row().stage == "at work", f"the work; {self.log.read_text()}", 60.0)

    def child(self) -> int:
        """The process that runs the jobs."""
        (child,) = psutil.Process(self.process.pid).children()
        return int(child.pid)


@pytest.fixture(scope="module")
def worker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Worker]:
    folder = tmp_path_factory.mktemp("worker")
    settings = Settings(data_dir=folder / "data", broker_url="filesystem://")
    log = folder / "worker.log"
    times = {"stop_s": 0.1, "heartbeat_s": 0.1, "lease_s": LEASE_S, "cancel_s": 0.3}
    with (
        new_catalogue(settings) as catalogue,
        started_worker(WORKER, settings, log, worker_threads=2, **times) as process,
    ):
        yield Worker(process, catalogue, queue.make_app(settings), log)


def test_a_greedy_job_fails_at_its_limit_and_the_next_one_runs(worker: Worker) -> None:
    job = worker.submit("greedy", estimate_mib=200, most_mib=1000)
    row = worker.wait(job, "ERROR")
    assert row.error is not None
    assert (row.error["code"], row.error["fault"]) == ("out-of-memory", "user")
    assert "300 MiB" in row.error["message"] and "200 MiB" in row.error["message"]
    before = worker.child()
    worker.wait(worker.submit("large", estimate_mib=200, mib=250), "COMPLETED")
    assert worker.child() == before, "the same process: memory beyond the estimate was free again"


@pytest.mark.parametrize("what", ["deaf", "deaf in C"])
def test_a_job_that_ignores_its_cancellation_is_ended_with_its_process(worker: Worker, what: str) -> None:
    job = worker.submit(what)
    worker.wait_at_work(job)
    before = worker.child()
    worker.catalogue.jobs.cancel(job.id)
    worker.wait(worker.submit("nothing"), "COMPLETED")
    assert worker.child() != before, "a new process"
    if what == "deaf in C":  # the process was ended by the system's timer, and could not write the outcome
        worker.catalogue.jobs.give_up_silent(LEASE_S, max_attempts=3)  # as the reconciler does
    row = worker.wait(job, "ABORTED")
    assert row.result_id is None and row.lease is None


def test_the_limit_holds_in_the_block_and_ends_with_it() -> None:
    child = Child(threads=1)
    beyond = (round(MARGIN * 200) + 100) * MIB
    with pytest.raises(OSError, match="Cannot allocate memory"), child.limited(200):
        mmap(-1, beyond, flags=MAP_PRIVATE | MAP_ANONYMOUS)  # np.empty might get memory that was freed before
    assert len(mmap(-1, beyond, flags=MAP_PRIVATE | MAP_ANONYMOUS)) == beyond


def test_memory_that_is_only_reserved_is_not_counted() -> None:
    before = data_bytes()
    with mmap(-1, 2**34, flags=MAP_PRIVATE | MAP_ANONYMOUS, prot=PROT_READ):
        assert data_bytes() - before < 2**30


def test_which_errors_say_that_no_memory_is_left() -> None:
    for error, expected in (
        (MemoryError(), True),
        (OSError(12, "Cannot allocate memory"), True),
        (RuntimeError("can't start new thread"), True),
        (OSError(28, "No space left on device"), False),
        (RuntimeError("other"), False),
        (ValueError("other"), False),
    ):
        assert is_out_of_memory(error) is expected, error


def test_a_thread_beyond_the_limit_is_no_memory() -> None:
    """The stacks of threads count."""
    code = (
        "import resource, threading, time\n"
        "from workers.run.child import data_bytes, is_out_of_memory\n"
        "threading.stack_size(2**30)\n"
        "limit = data_bytes() + 2**29\n"
        "resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))\n"
        "try:\n    threading.Thread(target=time.sleep, args=(0,)).start()\n"
        "except RuntimeError as error:\n    print(is_out_of_memory(error))\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout == "True\n", done.stderr
