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
from workers import logs
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.catalogue.owners import NOT_KEPT
from workers.catalogue.tables import JobRow, ProductRow, PsfRow, ReportRow
from workers.contract.contract import Fault, JobError, Phase
from workers.contract.queues import Queue
from workers.files.store import Store
from workers.run import registry as tasks
from workers.run.stopping import Stopping
from workers.settings import Settings
from workers.tasks.context import Context, TurnOver
from workers.tasks.stage_timer import StageTimer

log = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]
TRANSIENT = (OperationalError, InterfaceError, ConnectionError, TimeoutError)
REPORT_EVERY_S = 0.3
# A bulk asks for room before each of its images, and may keep none in the service; tables of a PSF are not counted.
NEED_NO_ROOM = frozenset({"bulk", "psf-tables"})


def worker_name() -> str:
    """This process, as jobs and the list of workers name it."""
    return f"{socket.gethostname()}:{os.getpid()}"


class TookTooLong(Exception):
    """The job executes for longer than the operator lets it: stop, and say so."""

    def __init__(self, limit_s: float) -> None:
        super().__init__(
            f"expected a job to execute for at most {limit_s:g} s (HELIOPSF_MAX_JOB_S); it was stopped then"
        )


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
    limit_s: float
    started: float = field(default_factory=time.monotonic)
    stopped: threading.Event = field(default_factory=threading.Event)
    ended: threading.Event = field(default_factory=threading.Event)
    last_report: float = 0.0
    times: StageTimer = field(default_factory=StageTimer)

    def beat(self) -> None:
        """Heartbeat until the work ends; notes a cancellation, and hands the job back where the worker must go."""
        while not self.ended.wait(self.heartbeat_s):
            try:
                if self.stopping.due and self.catalogue.jobs.hand_back(self.lease):
                    log.warning("job %s: handed back, this worker stops", self.lease.job_id)
                    self.stopped.set()
                    return
                alive = self.catalogue.jobs.heartbeat(self.lease)
            except SQLAlchemyError as error:
                # If it lasts, the lease runs out and the job is given to another; nothing to do here.
                log.warning("job %s: heartbeat not written: %s", self.lease.job_id, error)
                continue
            if not alive:
                self.stopped.set()
                return

    def report(self, stage: str, step: int, steps: int) -> None:
        """Called by tasks at each step; raises ``Cancelled`` where the work should stop."""
        with self.times.step(stage, step):
            self._report(stage, step, steps)

    def _report(self, stage: str, step: int, steps: int) -> None:
        now = time.monotonic()
        if step == steps or now - self.last_report >= REPORT_EVERY_S:
            self.last_report = now
            try:
                if not self.catalogue.jobs.progress(self.lease, stage, step, steps):
                    self.stopped.set()
            except SQLAlchemyError as error:
                # Work that was done is not thrown away for a database that is away for a moment.
                log.warning("job %s: progress not written: %s", self.lease.job_id, error)
        if self.stopped.is_set():
            raise Cancelled(self.lease.job_id)
        if now - self.started > self.limit_s:
            raise TookTooLong(self.limit_s)
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
        submit: Callable[[str, Queue], bool] = lambda job_id, queue: False,
    ) -> None:
        """submit: gives a job to the broker that is not at its end; False leaves that to the reconciler."""
        self._settings, self._catalogue, self._store = settings, catalogue, store
        self._call_for_help, self._submit = call_for_help, submit
        self._stopping = stopping or Stopping()

    def run(self, job_id: str, on_progress: Progress | None = None) -> None:
        """Run the job if it is queued; else do nothing (it was redelivered, cancelled or taken)."""
        if self._stopping.asked:
            self._catalogue.jobs.forget_submission(job_id)
            log.info("job %s: left queued, this worker stops", job_id)
            return
        lease = self._catalogue.jobs.claim(job_id, worker=worker_name())
        if lease is None:
            log.info("job %s: not queued, or an equal one is at work: nothing to do", job_id)
            return
        job = self._catalogue.jobs.get(job_id)
        if job is None:
            log.info("job %s: destroyed, nothing to do", job_id)
            return
        with logs.bound(job=job.id, owner=job.owner):
            log.info("job %s: %s starts, attempt %d", job.id, job.kind, job.attempt)
            settings = self._settings
            work = _Work(
                self._catalogue, lease, settings.heartbeat_s, self._stopping, on_progress, settings.max_job_s
            )
            beat = contextvars.copy_context().run
            heart = threading.Thread(target=beat, args=(work.beat,), name=f"heartbeat {job_id}", daemon=True)
            heart.start()
            try:
                self._attempt(job, lease, work)
            finally:
                work.ended.set()
                heart.join()
                self._keep_times(job, work.times)

    def assist(self, job_id: str) -> None:
        """Share the parts of a job that is executing elsewhere, until none is left or it ends."""
        job = self._catalogue.jobs.get(job_id)
        if self._stopping.asked or job is None or job.phase != Phase.EXECUTING:
            return
        if job.kind not in tasks.ASSISTANTS:
            return

        looked_at = time.monotonic()
        times = StageTimer()

        def report(stage: str, step: int, _steps: int) -> None:
            with times.step(stage, step):
                look()

        def look() -> None:
            nonlocal looked_at
            if self._stopping.due:
                raise Cancelled(job_id)
            if time.monotonic() - looked_at < REPORT_EVERY_S:
                return
            looked_at = time.monotonic()
            now = self._catalogue.jobs.get(job_id)
            if now is None or now.phase != Phase.EXECUTING or now.cancel_requested:
                raise Cancelled(job_id)

        context = Context(
            catalogue=self._catalogue,
            store=self._store,
            settings=self._settings,
            owner=job.owner,
            job_id=job.id,
            report=report,
            times=times,
        )
        with logs.bound(job=job.id, owner=job.owner):
            try:
                tasks.ASSISTANTS[job.kind](context, job.parameters)
            except Cancelled:
                log.info("job %s: no more help from here", job_id)
            except Exception:
                # The job's own worker meets the same trouble and says so; its error is the one that counts.
                log.exception("job %s: help failed", job_id)
            self._keep_times(job, times)

    def _attempt(self, job: JobRow, lease: Lease, work: _Work) -> None:
        context = Context(
            catalogue=self._catalogue,
            store=self._store,
            settings=self._settings,
            owner=job.owner,
            job_id=job.id,
            report=work.report,
            call_for_help=lambda workers: self._call_for_help(job.id, workers),
            guarded=lambda piece: self._guarded(job, work, piece),
            others_wait=lambda: self._stopping.asked or self._catalogue.jobs.others_wait(job.kind),
            lease=lease,
            times=work.times,
        )
        try:
            self._check_room(job)
            result_id = tasks.TASKS[job.kind](context, job.parameters)
        except TurnOver:
            self._let_others_go_first(job, lease)
        except Cancelled:
            aborted = self._persist(lambda: self._catalogue.jobs.abort(lease))
            log.info("job %s: %s", job.id, "aborted" if aborted else "lease lost, left to another worker")
        except TookTooLong as error:
            self._fail(lease, Fault.USER, "took-too-long", str(error))
        except DataError as error:
            self._fail(lease, Fault.USER, error.code, error.message)
        except TRANSIENT as error:
            self._retry(job, lease, error)
        except Exception as error:
            log.exception("job %s failed", job.id)
            internal = _internal(job, error)
            self._fail(lease, internal.fault, internal.code, internal.message)
        else:
            completed = self._persist(lambda: self._catalogue.jobs.complete(lease, result_id))
            said = f"{Phase.COMPLETED}, result {result_id}" if completed else "done, but the lease was lost"
            log.info("job %s: %s", job.id, said)

    def _check_room(self, job: JobRow) -> None:
        """Raise DataError "quota-exceeded" where the owner may not keep what the job makes.

        There was room when it was asked for, but for any number of jobs at once. What is there already needs none.
        """
        if job.kind in NEED_NO_ROOM:
            return
        usage = self._catalogue.owners.usage(job.owner, self._settings.quota_mib)
        if usage.full and not self._is_there(job):
            raise DataError("quota-exceeded", usage.no_room(NOT_KEPT))

    def _is_there(self, job: JobRow) -> bool:
        """Whether what the job makes was made before: by an equal one, or by an attempt that could not say so."""
        made, find = job.work_key, self._catalogue.get
        if made is None:
            return False
        found = (
            find(ProductRow, made, job.owner),
            find(PsfRow, made, job.owner),
            find(ReportRow, made, job.owner),
        )
        return any(row is not None for row in found)

    def _keep_times(self, job: JobRow, times: StageTimer) -> None:
        """Add an attempt's stages to the sums; its outcome is written by now, and stays whatever comes of this."""
        try:
            self._catalogue.stage_times.add(job.kind, times.end())
        except SQLAlchemyError as error:
            log.warning("job %s: times of its stages not kept: %s", job.id, error)

    def _guarded(self, job: JobRow, work: _Work, piece: Callable[[], None]) -> JobError | None:
        """What one of a job's many pieces of work died of; what is the whole job's matter passes through.

        Each piece may take as long as a job of its own.
        """
        work.started = time.monotonic()
        try:
            piece()
        except (Cancelled, *TRANSIENT):
            raise
        except TookTooLong as error:
            return JobError(fault=Fault.USER, code="took-too-long", message=str(error))
        except DataError as error:
            return JobError(fault=Fault.USER, code=error.code, message=error.message)
        except Exception as error:
            log.exception("job %s: one of its pieces of work failed", job.id)
            return _internal(job, error)
        return None

    def _let_others_go_first(self, job: JobRow, lease: Lease) -> None:
        if not self._persist(lambda: self._catalogue.jobs.hand_back(lease)):
            self._persist(lambda: self._catalogue.jobs.abort(lease))
            return
        self._catalogue.jobs.mark_submitted(job.id)
        if self._stopping.asked or not self._submit(job.id, Queue(job.queue)):
            self._catalogue.jobs.forget_submission(job.id)

    def _retry(self, job: JobRow, lease: Lease, error: Exception) -> None:
        log.warning("job %s: passing failure in attempt %d: %s", job.id, job.attempt, error)
        if job.attempt < self._settings.max_attempts:
            self._persist(lambda: self._catalogue.jobs.requeue(lease))
        else:
            message = f"failed {job.attempt} times: {type(error).__name__}"
            self._fail(lease, Fault.TRANSIENT, "gave-up", message)

    def _fail(self, lease: Lease, fault: Fault, code: str, message: str) -> None:
        error = JobError(fault=fault, code=code, message=message)
        self._persist(lambda: self._catalogue.jobs.fail(lease, error))
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


def _internal(job: JobRow, error: Exception) -> JobError:
    """Our own error: what went wrong may name files and statements, and is for the operator's log alone."""
    message = f"the software failed ({type(error).__name__}); the worker's log has it under job {job.id}"
    return JobError(fault=Fault.INTERNAL, code="internal-error", message=message)
