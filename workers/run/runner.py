"""Runs one job: claims it, sends heartbeats, runs its task and records the outcome. No other module turns an
exception into the error of a job.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from importlib import import_module
from typing import Any

from sqlalchemy.exc import SQLAlchemyError

from psfcore.errors import DataError
from workers import logs, traces
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.database import is_away
from workers.catalogue.jobs import Lease
from workers.catalogue.quotas import NOT_KEPT
from workers.catalogue.tables import JobRow
from workers.contract.jobs import Fault, JobError, Phase, Queue
from workers.contract.kinds import KINDS
from workers.files.store import NO_ROOM, STORAGE_FULL, Store, is_disk_full
from workers.intake.repair import TABLES
from workers.run.attempt import Assistance, Attempt, Cancelled, TookTooLong
from workers.run.child import MARGIN, Child, Stopping, allowed_mib, is_out_of_memory, worker_name
from workers.settings import Settings
from workers.stage_timer import StageTimer
from workers.tasks.catalogue_workspace import CatalogueWorkspace
from workers.tasks.workspace import TurnOver

log = logging.getLogger(__name__)
FAILED = "job %s: %s (%s)"  # log line about a failed job: its id, and the message and the code of its error

LATE = ("psfcore.build", "psfcore.drawing.plots")  # libraries that tasks load when they need them


def is_transient(error: BaseException) -> bool:
    """Whether the same work may succeed later: the database, the store or the network could not be used now."""
    return isinstance(error, ConnectionError | TimeoutError) or is_away(error)


def load_tasks() -> None:
    """Import every task and late library, so that the first job of each kind does not wait for them."""
    for kind in KINDS.values():
        kind.load_task()
    for name in LATE:
        import_module(name)


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
        child: Child | None = None,
    ) -> None:
        """Run jobs with these settings, catalogue and store.

        Parameters
        ----------
        call_for_help
            Function of the id of a job and a number of workers, which asks up to this number of idle workers to share
            the job.
        submit
            Function that sends an unfinished job to the broker again; if it returns False, the reconciler does so.
        child
            This process, if the runner may limit the memory of the process and end it; None if it may do neither.
        """
        self._settings, self._catalogue, self._store = settings, catalogue, store
        self._call_for_help, self._submit = call_for_help, submit
        self._stopping = stopping or Stopping()
        self._child = child

    def run_next(self, told_id: str, queue: Queue) -> None:
        """Run the next job of a queue: a job of the owner whose turn it is. The message of the broker names the job
        ``told_id``.
        """
        if self._stopping.asked:
            left = self._catalogue.turns.leave_next(told_id, queue)
            log.info("job %s: left in the queue because this worker is stopping", left)
            return
        lease = self._catalogue.turns.claim_next(told_id, queue, worker=worker_name())
        if lease is None:
            log.info("queue %s: nothing to do for the message of job %s", queue, told_id)
            return
        self._run(lease)

    def _run(self, lease: Lease) -> None:
        # numba is imported only when a job runs, so that a process with a runner starts fast.
        from psfcore.kernel_files import listening

        job = self._catalogue.jobs.get(lease.job_id)
        if job is None:
            log.info("job %s: nothing to do: it was deleted", lease.job_id)
            return
        with logs.bound(job=job.id, owner=job.owner), traces.of_job(job.id, job.kind):
            log.info("job %s: %s starts, attempt %d", job.id, job.kind, job.attempt)
            attempt = Attempt(self._catalogue, lease, self._settings, self._stopping, self._child)
            try:
                with attempt.beating(), listening(attempt.compiling):
                    self._attempt(job, lease, attempt)
            finally:
                self._keep_times(job, attempt.times)

    def assist(self, job_id: str) -> None:
        """Compute parts of a job that another worker runs, until no part is left or the job ends."""
        job = self._catalogue.jobs.get(job_id)
        if self._stopping.asked or job is None or job.phase != Phase.EXECUTING:
            return
        assistant = KINDS[job.kind].load_assistant()
        if assistant is None:
            return
        assistance = Assistance(self._catalogue, job_id, self._stopping)
        workspace = self._workspace(job, assistance)
        with logs.bound(job=job.id, owner=job.owner):
            try:
                with self._limited(job):
                    assistant(workspace, job.parameters)
            except Cancelled:
                log.info("job %s: this worker stops assisting", job_id)
            except Exception:
                # The worker that runs the job meets the same error, and records it.
                log.exception("job %s: assisting failed", job_id)
            self._keep_times(job, assistance.times)

    def _workspace(self, job: JobRow, work: Attempt | Assistance, **functions: Any) -> CatalogueWorkspace:
        """The workspace of a task or an assistant. Only a task may use the ``functions``."""
        return CatalogueWorkspace(
            catalogue=self._catalogue,
            store=self._store,
            settings=self._settings,
            owner=job.owner,
            job_id=job.id,
            report=work.report,
            times=work.times,
            **functions,
        )

    def _attempt(self, job: JobRow, lease: Lease, attempt: Attempt) -> None:
        workspace = self._workspace(
            job,
            attempt,
            call_for_help=lambda workers: self._call_for_help(job.id, workers),
            guarded=lambda piece: self._guarded(job, attempt, piece),
            others_wait=lambda: self._stopping.asked or self._catalogue.jobs.others_wait(job.kind),
            lease=lease,
        )
        try:
            self._check_room(job)
            with self._limited(job):
                result_id = KINDS[job.kind].load_task()(workspace, job.parameters)
        except TurnOver:
            self._let_others_go_first(job, lease)
        except Cancelled:
            aborted = self._persist(lambda: self._catalogue.jobs.abort(lease))
            log.info("job %s: %s", job.id, "aborted" if aborted else "lease lost; another worker has the job")
        except (DataError, TookTooLong) as error:
            self._fail(lease, self._error_of(job, error))
        except Exception as error:
            if is_transient(error):
                self._retry(job, lease, error)
                return
            log.exception("job %s failed", job.id)
            self._fail(lease, self._error_of(job, error))
        else:
            completed = self._persist(lambda: self._catalogue.jobs.complete(lease, result_id))
            outcome = (
                f"{Phase.COMPLETED}, result {result_id}" if completed else "finished, but the lease was lost"
            )
            log.info("job %s: %s", job.id, outcome)

    def _check_room(self, job: JobRow) -> None:
        """Raise DataError "quota-exceeded" if the owner's quota has no room for the result of the job.

        The quota was checked when the job was submitted, but other jobs may have filled it since then. A result that
        already exists needs no room.
        """
        kind = KINDS[job.kind]
        if not kind.needs_room:
            return
        usage = self._catalogue.quotas.limited(job.owner, self._settings.quota_mib)
        if usage is None or not usage.full:
            return
        # An identical job, or an earlier attempt that could not record its end, may have made the result.
        if not self._catalogue.ids_among(TABLES[kind.result], [job.work_key or ""], job.owner):
            raise DataError("quota-exceeded", usage.no_room(NOT_KEPT))

    def _keep_times(self, job: JobRow, times: StageTimer) -> None:
        """Add the stage times of an attempt to the sums. The outcome of the attempt is already recorded, so a failure
        here is only logged.
        """
        spent = times.end()
        traces.note({f"heliopsf.stage.{name}_s": round(stage.seconds, 3) for name, stage in spent.items()})
        try:
            self._catalogue.stage_times.add(job.kind, spent)
        except SQLAlchemyError as error:
            log.warning("job %s: could not keep its stage times: %s", job.id, error)

    def _guarded(self, job: JobRow, attempt: Attempt, piece: Callable[[], None]) -> JobError | None:
        """Do one piece of a job that has many pieces. Returns the error of the piece, or None. Errors that concern
        the whole job are raised. The time limit of a job applies to each piece separately.
        """
        attempt.started = time.monotonic()
        try:
            piece()
        except Cancelled:
            raise
        except (DataError, TookTooLong) as error:
            return self._error_of(job, error)
        except Exception as error:
            if is_disk_full(error) or is_transient(error):
                raise
            log.exception("job %s: a piece of its work failed", job.id)
            return self._error_of(job, error)
        return None

    def _limited(self, job: JobRow) -> AbstractContextManager[None]:
        """Limit the memory of the block to the estimate of the job, if this process may be limited."""
        return nullcontext() if self._child is None else self._child.limited(self._estimate_mib(job))

    def _estimate_mib(self, job: JobRow) -> int:
        """The memory for which the job was admitted, MiB. Without an estimate, it is the operator's limit."""
        return int((job.estimate or {}).get("memory_mib", self._settings.max_job_memory_mib))

    def _error_of(self, job: JobRow, error: Exception) -> JobError:
        """The error of a job whose task raised this exception."""
        if isinstance(error, TookTooLong):
            return error.as_error()
        if isinstance(error, DataError):
            return JobError.of(error)
        if is_disk_full(error):
            return JobError(fault=Fault.TRANSIENT, code=STORAGE_FULL, message=NO_ROOM)
        if not is_out_of_memory(error):
            return _internal(job, error)
        estimate_mib = self._estimate_mib(job)
        limit = (
            f"expected a job of at most {allowed_mib(estimate_mib)} MiB, {MARGIN:g} times its estimate of "
            f"{estimate_mib} MiB"
        )
        if self._child is None:
            limit = f"expected enough memory for a job of about {estimate_mib} MiB"
        message = f"{limit}; the job needed more: {KINDS[job.kind].memory_advice}"
        return JobError(fault=Fault.USER, code="out-of-memory", message=message)

    def _let_others_go_first(self, job: JobRow, lease: Lease) -> None:
        if not self._persist(lambda: self._catalogue.jobs.hand_back(lease)):
            self._persist(lambda: self._catalogue.jobs.abort(lease))
            return
        self._catalogue.jobs.mark_submitted(job.id)
        if self._stopping.asked or not self._submit(job.id, Queue(job.queue)):
            self._catalogue.jobs.forget_submission(job.id)

    def _retry(self, job: JobRow, lease: Lease, error: Exception) -> None:
        log.warning("job %s: temporary failure in attempt %d: %s", job.id, job.attempt, error)
        if job.attempt < self._settings.max_attempts:
            self._persist(lambda: self._catalogue.jobs.requeue(lease))
        elif is_disk_full(error):  # the disk of the database is full
            self._fail(lease, JobError(fault=Fault.TRANSIENT, code=STORAGE_FULL, message=NO_ROOM))
        else:
            message = (
                f"expected a temporary failure to end; {job.attempt} attempts failed ({type(error).__name__}): "
                "try again later"
            )
            self._fail(lease, JobError(fault=Fault.TRANSIENT, code="gave-up", message=message))

    def _fail(self, lease: Lease, error: JobError) -> None:
        self._persist(lambda: self._catalogue.jobs.fail(lease, error))
        log.warning(FAILED, lease.job_id, error.message, error.code)
        traces.note({"heliopsf.error": error.code}, failed=error.code)

    def _persist(self, write: Callable[[], bool]) -> bool:
        """Write the outcome of a job. While the database does not answer, try again for the length of a lease."""
        deadline = time.monotonic() + self._settings.lease_s
        while True:
            try:
                return write()
            except SQLAlchemyError as error:
                if not is_away(error) or time.monotonic() > deadline:
                    raise
                log.warning("could not write the outcome of a job, trying again: %s", error)
                time.sleep(0.5)


def _internal(job: JobRow, error: Exception) -> JobError:
    """An error of the software. The text of the exception is written only into the operator's log, because this text
    may contain names of files and SQL statements.
    """
    message = (
        f"the software failed ({type(error).__name__}): send the job id {job.id} to the operator, whose worker log has "
        "the details"
    )
    return JobError(fault=Fault.INTERNAL, code="internal-error", message=message)
