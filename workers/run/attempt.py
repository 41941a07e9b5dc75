"""One attempt at a job: its heartbeat, its progress, and the reasons to stop it early."""

from __future__ import annotations

import contextvars
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from sqlalchemy.exc import SQLAlchemyError

from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.contract.jobs import Fault, JobError, Phase
from workers.run.child import Child, Stopping
from workers.settings import Settings
from workers.stage_timer import StageTimer

log = logging.getLogger(__name__)

REPORT_EVERY_S = 0.3
COMPILING = "compiling kernels (only once)"  # a stage of any job, in the first jobs of an installation


class TookTooLong(Exception):
    """The job ran longer than the operator allows."""

    def __init__(self, limit_s: float) -> None:
        super().__init__(
            f"expected a job to run for at most {limit_s:g} s (HELIOPSF_MAX_JOB_S); this job was stopped after that "
            f"time: send a smaller request, or ask the operator for a higher limit"
        )

    def as_error(self) -> JobError:
        """The error of the job."""
        return JobError(fault=Fault.USER, code="took-too-long", message=str(self))


class Cancelled(Exception):
    """The job was cancelled, or this worker lost its lease. The task must stop and write no result."""


@dataclass
class Attempt:
    """A claimed job while it runs. The first report of progress later than ``max_job_s`` after ``started`` stops the
    job.

    Attributes
    ----------
    child
        This process; None if it must not be ended. The process is ended if the job must stop but still runs
        ``cancel_s`` later, or if the thread of the heartbeats cannot run for ``silent_s``.
    """

    catalogue: Catalogue
    lease: Lease
    settings: Settings
    stopping: Stopping
    child: Child | None = None
    started: float = field(default_factory=time.monotonic)
    stopped: threading.Event = field(default_factory=threading.Event)
    ended: threading.Event = field(default_factory=threading.Event)
    last_report: float = 0.0
    last_stage: str = ""
    times: StageTimer = field(default_factory=StageTimer)

    @contextmanager
    def beating(self) -> Iterator[None]:
        """Send heartbeats from another thread while the block runs."""
        run = contextvars.copy_context().run
        name = f"heartbeat {self.lease.job_id}"
        if self.child is not None:
            self.child.expect_news_within(self.settings.silent_s)
        heart = threading.Thread(target=run, args=(self._beat,), name=name, daemon=True)
        heart.start()
        try:
            yield
        finally:
            self.ended.set()
            heart.join()
            if self.child is not None:
                self.child.expect_no_news()

    def _beat(self) -> None:
        """Send heartbeats until the attempt ends or is cancelled. If the worker must stop, hand the job back."""
        while not self.ended.wait(self.settings.heartbeat_s):
            try:
                if self.child is not None:
                    self.child.expect_news_within(self.settings.silent_s)
                if self.stopping.due and self.catalogue.jobs.hand_back(self.lease):
                    log.warning("job %s: handed back because this worker is stopping", self.lease.job_id)
                    self.stopped.set()
                    return
                alive = self.catalogue.jobs.heartbeat(self.lease)
            except (SQLAlchemyError, MemoryError) as error:
                # Try again at the next heartbeat. If the database stays away, the lease expires and another worker gets
                # the job. MemoryError: the job has reached its memory limit, and its task gets the error too.
                log.warning("job %s: could not write the heartbeat: %r", self.lease.job_id, error)
                continue
            if not alive:
                self.stopped.set()
                self._end_if_deaf()
                return
            if time.monotonic() - self.started > self.settings.max_job_s + self.settings.cancel_s:
                self._give_up(
                    lambda: self.catalogue.jobs.fail(
                        self.lease, TookTooLong(self.settings.max_job_s).as_error()
                    )
                )

    def _end_if_deaf(self) -> None:
        """Wait until the task has stopped. If it does not stop within ``cancel_s``, end the process."""
        if self.child is not None and not self.ended.wait(self.settings.cancel_s):
            self._give_up(lambda: self.catalogue.jobs.abort(self.lease))

    def _give_up(self, record: Callable[[], bool]) -> None:
        """Record the outcome of a job whose task does not respond, and end the process."""
        if self.child is None:
            return
        log.error("job %s: its task does not stop: ending this process, which is replaced", self.lease.job_id)
        try:
            record()
        except SQLAlchemyError as error:
            # The lease expires, and then the job is aborted or queued again.
            log.warning("job %s: could not write its outcome: %s", self.lease.job_id, error)
        self.child.end()

    def report(self, stage: str, step: int, steps: int) -> None:
        """Tasks call this at each step. Raises ``Cancelled`` or ``TookTooLong`` if the work must stop."""
        with self.times.step(stage, step):
            self._report(stage, step, steps)

    def compiling(self, done: bool) -> None:
        """Report that the task begins to compile a kernel (``done`` False) or has compiled it. Raises as ``report``."""
        with self.times.step(COMPILING, int(done)):
            if not done:
                self._report(COMPILING, 0, 0)

    def _report(self, stage: str, step: int, steps: int) -> None:
        now = time.monotonic()
        if step == steps or stage != self.last_stage or now - self.last_report >= REPORT_EVERY_S:
            self.last_report, self.last_stage = now, stage
            try:
                if not self.catalogue.jobs.progress(self.lease, stage, step, steps):
                    self.stopped.set()
            except SQLAlchemyError as error:
                # The database may answer again soon, so the task continues: its work must not be lost.
                log.warning("job %s: could not write the progress: %s", self.lease.job_id, error)
        if self.stopped.is_set():
            raise Cancelled(self.lease.job_id)
        if time.monotonic() - self.started > self.settings.max_job_s:
            raise TookTooLong(self.settings.max_job_s)


@dataclass
class Assistance:
    """Help with a job that another worker runs. The help ends when the job ends."""

    catalogue: Catalogue
    job_id: str
    stopping: Stopping
    looked_at: float = field(default_factory=time.monotonic)
    times: StageTimer = field(default_factory=StageTimer)

    def report(self, stage: str, step: int, _steps: int) -> None:
        """Assistants call this at each step. Raises ``Cancelled`` if the job has ended or this worker must stop."""
        with self.times.step(stage, step):
            self._look()

    def _look(self) -> None:
        if self.stopping.due:
            raise Cancelled(self.job_id)
        if time.monotonic() - self.looked_at < REPORT_EVERY_S:
            return
        self.looked_at = time.monotonic()
        now = self.catalogue.jobs.get(self.job_id)
        if now is None or now.phase != Phase.EXECUTING or now.cancel_requested:
            raise Cancelled(self.job_id)
