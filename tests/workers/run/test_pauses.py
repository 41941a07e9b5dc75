"""A long job pauses for a short job of another owner, and then goes on as if nothing had happened."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.workers.conftest import Clock
from tests.workers.jobs import claimed, job_row
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import JobRow
from workers.contract.jobs import Phase, Queue
from workers.files.store import Store
from workers.run import attempt
from workers.run.attempt import Attempt
from workers.run.child import Child, Stopping
from workers.run.runner import Runner
from workers.settings import Settings
from workers.tasks.context import Context

STEPS, STEP_S = 10, 0.01
FREE_MIB = 1000


class Kept(Child):
    """A child that notes its end instead of ending this process."""

    def __init__(self) -> None:
        super().__init__(threads=1)
        self.ended = False

    def end(self) -> None:
        self.ended = True


class Bench:
    """A runner whose jobs work for STEPS steps. started, ended: the owners of the jobs, in this order."""

    def __init__(self, folder: Path, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(attempt, "REPORT_EVERY_S", 0.0)
        monkeypatch.setattr("workers.tasks.psf_build.psf_build", self._task)
        self.catalogue, self.child = catalogue, Kept()
        self.started: list[str] = []
        self.ended: list[str] = []
        self.during: Callable[[str, int], None] = lambda owner, step: None
        self._folder, self._number = folder, 0

    def submit(
        self, owner: str, *, seconds: float = 0.03, memory_mib: int = 100, queue: Queue = Queue.INTERACTIVE
    ) -> JobRow:
        """A waiting job that the broker has received."""
        self._number += 1
        needs = {"seconds": seconds, "memory_mib": memory_mib, "start_s": seconds}
        job, _ = self.catalogue.jobs.submit(
            "psf-build", {"number": self._number}, f"k{self._number}", owner, queue=queue, estimate=needs
        )
        self.catalogue.jobs.mark_submitted(job.id)
        return job

    def run(self, job: JobRow, **changes: Any) -> JobRow:
        """The row of a job after its run."""
        settings = Settings(
            data_dir=self._folder / "data",
            broker_url="filesystem://",
            heartbeat_s=0.01,
            max_job_memory_mib=FREE_MIB,
            **changes,
        )
        runner = Runner(settings, self.catalogue, Store(settings.data_dir), child=self.child)
        runner.run(job.id)
        return self.row(job)

    def row(self, job: JobRow) -> JobRow:
        return job_row(self.catalogue, job.id)

    def _task(self, context: Context, _parameters: Mapping[str, Any]) -> str:
        self.started.append(context.owner)
        for step in range(STEPS):
            time.sleep(STEP_S)
            self.during(context.owner, step)
            context.report("at work", step + 1, STEPS)
        self.ended.append(context.owner)
        return f"result of {context.owner}"


@pytest.fixture
def bench(tmp_path: Path, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(tmp_path, catalogue, monkeypatch)


def test_a_long_job_pauses_for_the_short_job_of_another_owner(bench: Bench) -> None:
    long = bench.submit("long", seconds=60)
    short = bench.submit("short")
    row = bench.run(long)
    assert (bench.started, bench.ended) == (["long", "short"], ["short", "long"])
    assert (row.phase, row.result_id, row.attempt) == (Phase.COMPLETED, "result of long", 1)
    row = bench.row(short)
    assert (row.phase, row.result_id, row.attempt) == (Phase.COMPLETED, "result of short", 1)
    assert bench.catalogue.turns.claim_next(short.id, Queue.INTERACTIVE, "w") is None, (
        "its message does nothing"
    )


def test_pauses_are_short_and_do_not_count(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, looks = Clock(), []
    monkeypatch.setattr(attempt, "time", clock)

    def run_short(seconds: float) -> bool:
        looks.append(seconds)
        clock.now += 5.0
        return len(looks) == 2  # the second look finds a job

    job, _ = catalogue.jobs.submit("psf-build", {}, "k", "long")
    lease = claimed(catalogue, job.id)
    started = clock.now
    one = Attempt(
        catalogue, lease, 1.0, Stopping(), None, limit_s=12.0, run_short=run_short,
        started=started, resumed=started,
    )  # fmt: skip
    for step, worked_s in enumerate((10.0, 0.5, 1.0)):
        clock.now += worked_s
        one.report("at work", step, 9)
    assert looks == [10.0, 15.5, 1.0], "a look without a job starts nothing anew; a pause does"
    assert one.started == started + 15.0
    clock.now += 0.6
    with pytest.raises(attempt.TookTooLong, match=r"12 s .*HELIOPSF_MAX_JOB_S"):
        one.report("at work", 9, 9)


def test_other_jobs_wait_for_their_turn(bench: Bench) -> None:
    others = [
        bench.submit("long"),
        bench.submit("short", seconds=100.0),  # too long
        bench.submit("short", memory_mib=FREE_MIB - 99),  # too large
        bench.submit("short", queue=Queue.BULK),
    ]
    long = bench.submit("long", seconds=60)
    assert bench.run(long).phase == Phase.COMPLETED
    assert [bench.row(other).phase for other in others] == [Phase.QUEUED] * 4


def test_which_attempts_pause_and_which_do_not(bench: Bench) -> None:
    short = bench.submit("short")
    lost = bench.submit("lost", seconds=60)
    assert bench.catalogue.jobs.requeue(claimed(bench.catalogue, lost.id, "lost"))
    assert bench.run(lost).attempt == 2
    assert bench.row(short).phase == Phase.QUEUED, "the short job may have ended the first attempt"
    bench.run(bench.submit("long", seconds=60, queue=Queue.BULK), worker_queues="bulk")
    assert bench.row(short).phase == Phase.QUEUED, "the worker does not serve its queue"
    in_thread = threading.Thread(target=bench.run, args=(bench.submit("long", seconds=60),))
    in_thread.start()
    in_thread.join()
    assert bench.row(short).phase == Phase.QUEUED, "the report came from another thread"
    bench.run(bench.submit("short", seconds=60, queue=Queue.BULK))
    assert bench.row(short).phase == Phase.COMPLETED, "a bulk turn pauses for its own owner too"


def test_a_job_cancelled_during_its_pause_ends_after_the_short_one(bench: Bench) -> None:
    long = bench.submit("long", seconds=60)
    short = bench.submit("short")

    def cancel(owner: str, step: int) -> None:
        if owner == "short" and step == 0:
            bench.catalogue.jobs.cancel(long.id)
            time.sleep(0.3)  # longer than a task may ignore its cancellation

    bench.during = cancel
    row = bench.run(long, cancel_s=0.1)
    assert (row.phase, bench.row(short).phase) == (Phase.ABORTED, Phase.COMPLETED)
    assert not bench.child.ended, "the process was not ended"


def test_a_short_job_that_fails_or_is_cancelled_does_not_concern_the_long_one(bench: Bench) -> None:
    long = bench.submit("long", seconds=60)
    fails, cancelled = bench.submit("fails"), bench.submit("cancelled", seconds=0.04)

    def fail(owner: str, step: int) -> None:
        if owner == "fails":
            raise ValueError("of the test")
        if owner == "cancelled" and step == 0:
            bench.catalogue.jobs.cancel(cancelled.id)

    bench.during = fail
    assert bench.run(long).phase == Phase.COMPLETED
    assert bench.row(fails).phase == Phase.ERROR
    assert bench.row(cancelled).phase == Phase.ABORTED


def test_a_job_that_takes_too_long_ends_at_its_next_step(bench: Bench) -> None:
    row = bench.run(bench.submit("slow"), max_job_s=STEPS * STEP_S / 2)
    assert row.error is not None and bench.ended == []
    assert (row.error["code"], row.error["fault"]) == ("took-too-long", "user")
