"""Jobs in the catalogue: submitted, claimed, executing, ended.

The table of jobs is the only source of truth about jobs: the broker may lose messages. Every change of a job's phase is
a compare-and-set on the row, so any number of workers, servers and reconcilers may try at once. Times that they compare
with each other, such as heartbeats, come from the database's clock.
"""

from __future__ import annotations

import logging
import time
import uuid
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, and_, case, literal, or_, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import InstrumentedAttribute, aliased

from workers.catalogue.database import Database
from workers.catalogue.tables import JobRow, TermsRow
from workers.contract.identities import canonical_hash
from workers.contract.kinds import queue_of
from workers.contract.phases import LIVE, Fault, JobError, Phase
from workers.contract.queues import Queue

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Lease:
    """The right to work on a job. Changes made under a lost lease have no effect."""

    job_id: str
    token: str


@dataclass(frozen=True)
class Waiting:
    """A job to give to the broker."""

    id: str
    queue: Queue


class Jobs:
    """The table of jobs; each method is one transaction."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def submit(
        self,
        kind: str,
        parameters: dict[str, Any],
        request_key: str,
        owner: str,
        *,
        queue: Queue | None = None,
        estimate: dict[str, Any] | None = None,
    ) -> tuple[JobRow, bool]:
        """A new queued job, or the live job of an identical request; also returns whether it is new.

        A shared job that waits in a less urgent queue moves to ``queue``. queue None: the queue of the job's kind. A
        cancelled job and a job with UWS terms are not shared: the new job gets a key of its own, waits while the other
        one executes, and then finds its result, if there is one.
        """
        queue = queue or queue_of(kind)
        for _ in range(3):  # the identical job may fail between the two statements
            key, existing = self._shared(owner, request_key)
            if existing is not None:
                return self._moved_up(existing, queue), False
            row = JobRow(
                id=uuid.uuid4().hex,
                owner=owner,
                kind=kind,
                parameters=parameters,
                request_key=key,
                work_key=request_key,
                phase=Phase.QUEUED,
                queue=queue,
                created_at=time.time(),
                estimate=estimate,
            )
            try:
                with self._database.writing.begin() as session:
                    session.add(row)
                return row, True
            except IntegrityError:
                continue
        raise RuntimeError(f"job for request {request_key} neither inserted nor found")

    def _shared(self, owner: str, request_key: str) -> tuple[str, JobRow | None]:
        """The live job that an identical request shares, or None, and the key of that job or of a new one.

        The key of a job beside one that is not shared follows from that job's id, so that later identical requests find
        the new job.
        """
        key = request_key
        live = select(JobRow, TermsRow.job_id).outerjoin(TermsRow, TermsRow.job_id == JobRow.id)
        live = live.where(JobRow.owner == owner, JobRow.phase.in_(LIVE))
        while True:
            with self._database.reading() as session:
                found = session.execute(live.where(JobRow.request_key == key)).first()
            if found is None:
                return key, None
            row, terms = found
            stops = row.cancel_requested and row.phase != Phase.COMPLETED
            if not stops and terms is None:
                return key, row
            key = canonical_hash({"request_key": request_key, "beside": row.id})

    def _moved_up(self, row: JobRow, queue: Queue) -> JobRow:
        order = list(Queue)
        if row.phase == Phase.QUEUED and order.index(queue) < order.index(Queue(row.queue)):
            waiting = [JobRow.id == row.id, JobRow.phase == Phase.QUEUED]
            if self._set(waiting, queue=queue, submitted_at=None, submissions=0):
                row.queue, row.submitted_at = queue, None
        return row

    def get(self, job_id: str) -> JobRow | None:
        """The job's row, or None."""
        with self._database.reading() as session:
            return session.get(JobRow, job_id)

    def mark_submitted(self, *job_ids: str) -> None:
        """Note that the broker has received the jobs' ids."""
        self._set(
            [JobRow.id.in_(job_ids)], submitted_at=self._database.now, submissions=JobRow.submissions + 1
        )

    def forget_submission(self, job_id: str) -> None:
        """Note that a worker took a queued job's message from the broker but did not claim the job."""
        self._set([JobRow.id == job_id, JobRow.phase == Phase.QUEUED], submitted_at=None)

    def claim(self, job_id: str, worker: str) -> Lease | None:
        """QUEUED -> EXECUTING for exactly one of the workers that try; None for all others.

        Also None while another job with the same result executes; the job is submitted again later.
        """
        lease = Lease(job_id, uuid.uuid4().hex)
        now = self._database.now
        try:
            claimed = self._set(
                [JobRow.id == job_id, JobRow.phase == Phase.QUEUED],
                phase=Phase.EXECUTING,
                attempt=JobRow.attempt + 1,
                lease=lease.token,
                started_at=now,
                heartbeat_at=now,
                worker=worker,
                step=0,
                steps=0,
                stage="",
            )
        except IntegrityError:  # the index one_at_work_a_result
            self.forget_submission(job_id)
            return None
        return lease if claimed else None

    def heartbeat(self, lease: Lease) -> bool:
        """Note that the job is alive; False if the lease is lost or the job was cancelled."""
        return self._set([*_held(lease), JobRow.cancel_requested.is_(False)], heartbeat_at=self._database.now)

    def progress(self, lease: Lease, stage: str, step: int, steps: int) -> bool:
        """Store the job's progress, which is also a heartbeat; False as for ``heartbeat``."""
        return self._set(
            [*_held(lease), JobRow.cancel_requested.is_(False)],
            stage=stage,
            step=step,
            steps=steps,
            heartbeat_at=self._database.now,
        )

    def complete(self, lease: Lease, result_id: str) -> bool:
        """EXECUTING -> COMPLETED under the lease."""
        return self._set(
            _held(lease), phase=Phase.COMPLETED, ended_at=self._database.now, result_id=result_id, lease=None
        )

    def fail(self, lease: Lease, error: JobError) -> bool:
        """EXECUTING -> ERROR under the lease."""
        return self._set(
            _held(lease),
            phase=Phase.ERROR,
            ended_at=self._database.now,
            error=error.model_dump(mode="json"),
            lease=None,
        )

    def requeue(self, lease: Lease) -> bool:
        """EXECUTING -> QUEUED under the lease, after a transient failure. The job is submitted again after the usual wait.

        A cancelled job is aborted instead.
        """
        return self._set(
            _held(lease), **self._again(), submitted_at=self._database.now, submissions=JobRow.attempt
        )

    def abort(self, lease: Lease) -> bool:
        """EXECUTING -> ABORTED under the lease, when the worker has stopped a cancelled job."""
        return self._set(
            [*_held(lease), JobRow.cancel_requested.is_(True)],
            phase=Phase.ABORTED,
            ended_at=self._database.now,
            lease=None,
        )

    def cancel(self, job_id: str) -> None:
        """PENDING, QUEUED -> ABORTED. An executing job is asked to stop; an ended job does not change."""
        at_work = JobRow.phase == Phase.EXECUTING
        self._set(  # one statement: between two, the job could be claimed or queued again
            [JobRow.id == job_id, JobRow.phase.in_((Phase.PENDING, Phase.QUEUED, Phase.EXECUTING))],
            phase=case((at_work, JobRow.phase), else_=Phase.ABORTED.value),
            ended_at=case((at_work, JobRow.ended_at), else_=self._database.now),
            cancel_requested=True,
        )

    def hand_back(self, lease: Lease) -> bool:
        """EXECUTING -> QUEUED under the lease because the worker stops. The attempt does not count."""
        return self._set(
            [*_held(lease), JobRow.cancel_requested.is_(False)],
            phase=Phase.QUEUED,
            attempt=JobRow.attempt - 1,
            submitted_at=None,
            submissions=0,
            lease=None,
        )

    def give_up_silent(self, lease_s: float, max_attempts: int) -> list[str]:
        """Queue jobs again whose worker has been silent for longer than the lease; returns their ids.

        A cancelled job is aborted instead. A job that was started ``max_attempts`` times ends in ERROR.
        """
        silent = [JobRow.phase == Phase.EXECUTING, JobRow.heartbeat_at < self._database.now - lease_s]
        too_often = and_(JobRow.cancel_requested.is_(False), JobRow.attempt >= max_attempts)
        error = JobError(
            fault=Fault.INTERNAL,
            code="worker-lost",
            message=f"the worker was lost {max_attempts} times while it ran this job; the job is not tried again",
        )
        ended = {
            "phase": Phase.ERROR,
            "ended_at": self._database.now,
            "lease": None,
            "error": error.model_dump(mode="json"),
        }
        with self._database.writing.begin() as session:
            lost = update(JobRow).where(*silent, too_often).values(**ended)
            for job_id in session.scalars(lost.returning(JobRow.id)):
                log.error("job %s: %s (%s)", job_id, error.message, error.code)
        with self._database.writing.begin() as session:
            # Other jobs may have been cancelled, or lost too often, since the previous statement.
            back = update(JobRow).where(*silent, ~too_often).values(**self._again(), submitted_at=None)
            taken = session.execute(back.returning(JobRow.id, JobRow.phase))
            return [job_id for job_id, phase in taken if phase == Phase.QUEUED]

    def unsubmitted(self, resubmit_s: float, limit: int = 1000) -> list[Waiting]:
        """Queued jobs that the broker never received or seems to have lost, by queue, then oldest first.

        The wait doubles with each submission of a job, so that a long queue is not submitted again and again.
        """
        waits = {number: resubmit_s * 2 ** (number - 1) for number in range(2, 9)}
        wait_s = case(
            (JobRow.submissions <= 1, resubmit_s),
            *((JobRow.submissions == number, wait) for number, wait in waits.items()),
            else_=resubmit_s * 2**8,
        )
        due = or_(JobRow.submitted_at.is_(None), JobRow.submitted_at < self._database.now - wait_s)
        query = select(JobRow.id, JobRow.queue).where(JobRow.phase == Phase.QUEUED, due, no_equal_at_work())
        found: list[Waiting] = []
        with self._database.reading() as session:
            for queue in Queue:
                of_queue = query.where(JobRow.queue == queue).order_by(JobRow.created_at)
                rows = session.execute(of_queue.limit(limit - len(found)))
                found += [Waiting(job_id, Queue(name)) for job_id, name in rows]
        return found

    def of_kind(self, kind: str) -> Sequence[JobRow]:
        """All jobs of a kind, in any phase. For kinds that have few jobs."""
        with self._database.reading() as session:
            return session.scalars(select(JobRow).where(JobRow.kind == kind)).all()

    def others_wait(self, kind: str) -> bool:
        """Whether a job of another kind waits and could start now."""
        query = select(JobRow.id).where(JobRow.phase == Phase.QUEUED, JobRow.kind != kind, no_equal_at_work())
        with self._database.reading() as session:
            return session.scalars(query.limit(1)).first() is not None

    def at_work_on(self, owner: str, work_key: str) -> bool:
        """Whether a job with this result executes now."""
        query = select(JobRow.id).where(
            JobRow.owner == owner, JobRow.work_key == work_key, _is_at_work(JobRow.phase)
        )
        with self._database.reading() as session:
            return session.scalars(query.limit(1)).first() is not None

    def _again(self) -> dict[str, Any]:
        """Values that queue an executing job again, or abort it if it was cancelled."""
        cancelled = JobRow.cancel_requested.is_(True)
        return {
            "phase": case((cancelled, Phase.ABORTED.value), else_=Phase.QUEUED.value),
            "ended_at": case((cancelled, self._database.now)),
            "lease": None,
        }

    def run_times(self, kind: str, limit: int) -> list[tuple[dict[str, Any], float]]:
        """Estimate and duration in seconds of the newest completed jobs of a kind."""
        query = (
            select(JobRow.estimate, JobRow.ended_at - JobRow.started_at)
            .where(JobRow.kind == kind, JobRow.phase == Phase.COMPLETED)
            .where(JobRow.estimate.is_not(None), JobRow.started_at.is_not(None))
            .order_by(JobRow.created_at.desc())
            .limit(limit)
        )
        with self._database.reading() as session:
            return [(estimate or {}, float(seconds)) for estimate, seconds in session.execute(query)]

    def _set(self, conditions: Sequence[Any], **values: Any) -> bool:
        """Run one UPDATE; whether it changed a row."""
        return bool(self._database.change(update(JobRow).where(and_(*conditions)).values(**values)))


def no_equal_at_work() -> ColumnElement[bool]:
    """A condition: no other job with the same result executes now."""
    other = aliased(JobRow)
    at_work = select(other.id).where(
        other.owner == JobRow.owner,
        other.work_key == JobRow.work_key,
        _is_at_work(other.phase),
    )
    return ~at_work.exists()


def _is_at_work(phase: InstrumentedAttribute[str]) -> ColumnElement[bool]:
    # Literal in the statement's text, so that the databases see that they can use the partial index.
    return phase == literal(Phase.EXECUTING.value, literal_execute=True)


def _held(lease: Lease) -> list[Any]:
    return [
        JobRow.id == lease.job_id,
        JobRow.lease == lease.token,
        JobRow.phase == Phase.EXECUTING,
    ]
