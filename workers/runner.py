"""Runs one job: claim, heartbeat, task, outcome. The only place where an exception becomes a job's error."""

from __future__ import annotations

import contextvars
import logging
import os
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from sqlalchemy.exc import InterfaceError, OperationalError, SQLAlchemyError

from psfcore.errors import DataError
from workers import logs, tasks
from workers.catalogue import Catalogue, JobRow, Lease
from workers.context import Context
from workers.contract import Fault, JobError, Phase
from workers.settings import Settings
from workers.stopping import Stopping
from workers.store import Store

log = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]
TRANSIENT = (OperationalError, InterfaceError, ConnectionError, TimeoutError)
REPORT_EVERY_S = 0.3


def worker_name() -> str:
    """This process, as jobs and the list of workers name it."""
    return f"{socket.gethostname()}:{os.getpid()}"


class Cancelled(Exception):
    """The job was cancelled, or its lease lost: stop, and write nothing."""


@dataclass
class _Work:
    """A claimed job at work: progress out, cancellation in."""

    catalogue: Catalogue
    lease: Lease
    heartbeat_s: float
    stopping: Stopping
    also_report: Progress | None
    stopped: threading.Event = field(default_factory=threading.Event)
    ended: threading.Event = field(default_factory=threading.Event)
    last_report: float = 0.0

    def beat(self) -> None:
        """Heartbeat until the work ends; notes a cancellation, and hands the job back where the worker must go."""
        while not self.ended.wait(self.heartbeat_s):
            try:
                if self.stopping.due and self.catalogue.hand_back(self.lease):
                    log.warning("job %s: handed back, this worker stops", self.lease.job_id)
                    self.stopped.set()
                    return
                alive = self.catalogue.heartbeat(self.lease)
            except SQLAlchemyError as error:
                # If it lasts, the lease runs out and the job is given to another; nothing to do here.
                log.warning("job %s: heartbeat not written: %s", self.lease.job_id, error)
                continue
            if not alive:
                self.stopped.set()
                return

    def report(self, stage: str, step: int, steps: int) -> None:
        """Called by tasks at each step; raises ``Cancelled`` where the work should stop."""
        now = time.monotonic()
        if step == steps or now - self.last_report >= REPORT_EVERY_S:
            self.last_report = now
            try:
                if not self.catalogue.progress(self.lease, stage, step, steps):
                    self.stopped.set()
            except SQLAlchemyError as error:
                # Work that was done is not thrown away for a database that is away for a moment.
                log.warning("job %s: progress not written: %s", self.lease.job_id, error)
        if self.stopped.is_set():
            raise Cancelled(self.lease.job_id)
        if self.also_report is not None:
            self.also_report(stage, step, steps)


class Runner:
    """Runs jobs of the catalogue in this process."""

    def __init__(
        self,
        settings: Settings,
        catalogue: Catalogue,
        store: Store,
        call_for_help: Callable[[str, int], None] = lambda job_id, workers: None,
        stopping: Stopping | None = None,
    ) -> None:
        self._settings, self._catalogue, self._store = settings, catalogue, store
        self._call_for_help = call_for_help
        self._stopping = stopping or Stopping()

    def run(self, job_id: str, on_progress: Progress | None = None) -> None:
        """Run the job if it is queued; else do nothing (it was redelivered, cancelled or taken)."""
        if self._stopping.asked:
            self._catalogue.forget_submission(job_id)
            log.info("job %s: left queued, this worker stops", job_id)
            return
        lease = self._catalogue.claim(job_id, worker=worker_name())
        if lease is None:
            log.info("job %s: not queued, nothing to do", job_id)
            return
        job = self._catalogue.job(job_id)
        if job is None:
            log.info("job %s: destroyed, nothing to do", job_id)
            return
        with logs.bound(job=job.id, owner=job.owner):
            log.info("job %s: %s starts, attempt %d", job.id, job.kind, job.attempt)
            work = _Work(self._catalogue, lease, self._settings.heartbeat_s, self._stopping, on_progress)
            beat = contextvars.copy_context().run
            heart = threading.Thread(target=beat, args=(work.beat,), name=f"heartbeat {job_id}", daemon=True)
            heart.start()
            try:
                self._attempt(job, lease, work)
            finally:
                work.ended.set()
                heart.join()

    def assist(self, job_id: str) -> None:
        """Share the parts of a job that is executing elsewhere, until none is left or it ends."""
        job = self._catalogue.job(job_id)
        if self._stopping.asked or job is None or job.phase != Phase.EXECUTING:
            return
        if job.kind not in tasks.ASSISTANTS:
            return

        looked_at = time.monotonic()

        def report(_stage: str, _step: int, _steps: int) -> None:
            nonlocal looked_at
            if self._stopping.due:
                raise Cancelled(job_id)
            if time.monotonic() - looked_at < REPORT_EVERY_S:
                return
            looked_at = time.monotonic()
            now = self._catalogue.job(job_id)
            if now is None or now.phase != Phase.EXECUTING or now.cancel_requested:
                raise Cancelled(job_id)

        context = Context(
            catalogue=self._catalogue,
            store=self._store,
            settings=self._settings,
            owner=job.owner,
            job_id=job.id,
            report=report,
        )
        with logs.bound(job=job.id, owner=job.owner):
            try:
                tasks.ASSISTANTS[job.kind](context, job.parameters)
            except Cancelled:
                log.info("job %s: no more help from here", job_id)
            except Exception:
                # The job's own worker meets the same trouble and says so; its error is the one that counts.
                log.exception("job %s: help failed", job_id)

    def _attempt(self, job: JobRow, lease: Lease, work: _Work) -> None:
        context = Context(
            catalogue=self._catalogue,
            store=self._store,
            settings=self._settings,
            owner=job.owner,
            job_id=job.id,
            report=work.report,
            call_for_help=lambda workers: self._call_for_help(job.id, workers),
        )
        try:
            result_id = tasks.TASKS[job.kind](context, job.parameters)
        except Cancelled:
            aborted = self._persist(lambda: self._catalogue.abort(lease))
            log.info("job %s: %s", job.id, "aborted" if aborted else "lease lost, left to another worker")
        except DataError as error:
            self._fail(lease, Fault.USER, error.code, error.message)
        except TRANSIENT as error:
            self._retry(job, lease, error)
        except Exception as error:
            log.exception("job %s failed", job.id)
            # What went wrong may name files and statements: it is for the operator's log alone.
            message = (
                f"the software failed ({type(error).__name__}); the worker's log has it under job {job.id}"
            )
            self._fail(lease, Fault.INTERNAL, "internal-error", message)
        else:
            completed = self._persist(lambda: self._catalogue.complete(lease, result_id))
            said = f"{Phase.COMPLETED}, result {result_id}" if completed else "done, but the lease was lost"
            log.info("job %s: %s", job.id, said)

    def _retry(self, job: JobRow, lease: Lease, error: Exception) -> None:
        log.warning("job %s: passing failure in attempt %d: %s", job.id, job.attempt, error)
        if job.attempt < self._settings.max_attempts:
            self._persist(lambda: self._catalogue.requeue(lease))
        else:
            message = f"failed {job.attempt} times: {type(error).__name__}"
            self._fail(lease, Fault.TRANSIENT, "gave-up", message)

    def _fail(self, lease: Lease, fault: Fault, code: str, message: str) -> None:
        error = JobError(fault=fault, code=code, message=message)
        self._persist(lambda: self._catalogue.fail(lease, error))
        log.warning("job %s: %s (%s)", lease.job_id, message, code)

    def _persist(self, write: Callable[[], bool]) -> bool:
        """Write a job's outcome, trying for as long as the lease may last while the database is away."""
        deadline = time.monotonic() + self._settings.lease_s
        while True:
            try:
                return write()
            except TRANSIENT as error:
                if time.monotonic() > deadline:
                    raise
                log.warning("outcome not written yet: %s", error)
                time.sleep(0.5)
