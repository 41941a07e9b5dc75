"""Jobs in the catalogue, and parts of jobs that several workers share: submit, claim, run and end them.

The state of a job is stored only in the table of jobs, because the broker may lose messages. Every change of a job's
phase is a compare-and-set on the row. Therefore any number of workers, servers and reconcilers may try to change it at
the same moment. Heartbeats and the other times that one process compares with those of another come from the
database's clock.
A worker takes a part of a job by compare-and-set too, and then has a lease for it.
"""

from __future__ import annotations

import logging
import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import ColumnElement, and_, case, func, literal, or_, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import InstrumentedAttribute, Session, aliased

from workers.catalogue.database import Queries, insert_into
from workers.catalogue.tables import JobRow, OwnerTurnRow, PartRow, TermsRow
from workers.contract.identities import canonical_hash
from workers.contract.jobs import LIVE, Fault, JobError, Phase, Queue
from workers.contract.kinds import queue_of

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Lease:
    """The right to work on a job. When the lease is lost, further changes by this worker have no effect."""

    job_id: str
    token: str


class Jobs(Queries):
    """The table of jobs."""

    def submit(
        self,
        kind: str,
        parameters: Mapping[str, object],
        request_key: str,
        owner: str,
        *,
        queue: Queue | None = None,
        estimate: dict[str, float] | None = None,
    ) -> tuple[JobRow, bool]:
        """Queue a new job, or share the job of an identical request that is queued, executing or completed.

        A shared job that waits in a less urgent queue moves to ``queue``. A cancelled job or a job with UWS terms is
        not shared: the new job then gets a different key. The new job waits while the other job executes. If the other
        job has a result, the new job then uses this result.

        Parameters
        ----------
        queue
            The queue of the new job; None: the default queue of the job's kind.

        Returns
        -------
        tuple[JobRow, bool]
            The job, and whether it is new.
        """
        queue = queue or queue_of(kind)
        for _ in range(3):  # between the two statements, the identical job may fail
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
        """Find the queued, executing or completed job that this request can share; returns the key and the row of that
        job.

        If there is no such job, returns the key for a new job, and None instead of a job. If an identical job cannot
        be shared, the key of the new job is computed from the id of that job. Later identical requests then find the
        new job.
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
            if self._database.set(JobRow, waiting, queue=queue, submitted_at=None, submissions=0):
                row.queue, row.submitted_at = queue, None
        return row

    def get(self, job_id: str) -> JobRow | None:
        """The job's row, or None."""
        return self._database.row(JobRow, job_id)

    def mark_submitted(self, *job_ids: str) -> None:
        """Record that the broker has received the jobs' ids."""
        counted = {"submissions": JobRow.submissions + 1, "delayed": False}
        self._note([JobRow.id.in_(job_ids)], submitted_at=self._database.now, **counted)

    def forget_submission(self, job_id: str) -> None:
        """Record that a worker took the message of a queued job from the broker, but did not claim the job."""
        self._note([JobRow.id == job_id, JobRow.phase == Phase.QUEUED], submitted_at=None)

    def claim(self, job_id: str, worker: str) -> Lease | None:
        """Give a queued job to a worker. If several workers try, exactly one gets the lease; the others get None.

        While another job with the same result executes, every worker gets None; the reconciler submits the job again
        later.
        """
        lease = Lease(job_id, uuid.uuid4().hex)
        now = self._database.now
        claimed = update(JobRow).where(JobRow.id == job_id, JobRow.phase == Phase.QUEUED)
        claimed = claimed.values(
            phase=Phase.EXECUTING,
            attempt=JobRow.attempt + 1,
            lease=lease.token,
            started_at=now,
            heartbeat_at=now,
            worker=worker,
            step=0,
            steps=0,
            stage="",
            count_at=None,
            count_step=0,
        )
        try:
            with self._database.writing.begin() as session:
                found = session.execute(claimed.returning(JobRow.owner, JobRow.queue)).first()
                if found is not None:
                    self._count_turn(session, *found)
        except IntegrityError:  # because of the index one_at_work_a_result
            self.forget_submission(job_id)
            return None
        return None if found is None else lease

    def _count_turn(self, session: Session, owner: str, queue: str) -> None:
        """Record that this owner is the one most recently served from a queue.

        The turns are numbered; times are not used, because clocks may be set back.
        """
        latest = select(func.coalesce(func.max(OwnerTurnRow.number), 0)).where(OwnerTurnRow.queue == queue)
        number = latest.scalar_subquery() + 1
        turn = insert_into(session, OwnerTurnRow).values(owner=owner, queue=queue, number=number)
        session.execute(
            turn.on_conflict_do_update(
                index_elements=["owner", "queue"], set_={"number": turn.excluded.number}
            )
        )

    def heartbeat(self, lease: Lease) -> bool:
        """Record that the worker is alive. Returns False if the lease is lost or the job was cancelled."""
        return self._note(
            [*_held(lease), JobRow.cancel_requested.is_(False)], heartbeat_at=self._database.now
        )

    def progress(self, lease: Lease, stage: str, step: int, steps: int) -> bool:
        """Store the job's progress and a heartbeat. Returns False if the lease is lost or the job was cancelled.

        A job counts its steps several times. A new count begins when the number of steps changes, or when the step is
        smaller than the step before. The row stores the time and the step at which the current count began; the
        remaining time of the job is estimated from them.
        """
        new_count = or_(JobRow.count_at.is_(None), JobRow.steps != steps, JobRow.step > step)
        return self._database.set(
            JobRow,
            [*_held(lease), JobRow.cancel_requested.is_(False)],
            count_at=case((new_count, self._database.now), else_=JobRow.count_at),
            count_step=case((new_count, step), else_=JobRow.count_step),
            stage=stage,
            step=step,
            steps=steps,
            heartbeat_at=self._database.now,
        )

    def complete(self, lease: Lease, result_id: str) -> bool:
        """End an executing job as COMPLETED. Returns False if the lease is lost."""
        return self._end(lease, Phase.COMPLETED, result_id=result_id)

    def fail(self, lease: Lease, error: JobError) -> bool:
        """End an executing job as ERROR. Returns False if the lease is lost."""
        return self._end(lease, Phase.ERROR, error=error.model_dump(mode="json"))

    def abort(self, lease: Lease) -> bool:
        """End a cancelled job as ABORTED, after its worker has stopped it. Returns False if the lease is lost."""
        return self._end(lease, Phase.ABORTED, JobRow.cancel_requested.is_(True))

    def _end(self, lease: Lease, phase: Phase, *conditions: ColumnElement[bool], **values: object) -> bool:
        ended = {"phase": phase, "ended_at": self._database.now, "lease": None}
        return self._database.set(JobRow, [*_held(lease), *conditions], **ended, **values)

    def requeue(self, lease: Lease) -> bool:
        """Queue an executing job again after a transient failure. Returns False if the lease is lost.

        The job is submitted again after the waiting time of ``unsubmitted``. A cancelled job is aborted instead.
        """
        delay = {"submitted_at": self._database.now, "submissions": JobRow.attempt, "delayed": True}
        return self._database.set(JobRow, _held(lease), **self._again(), **delay)

    def cancel(self, job_id: str) -> None:
        """Abort a pending or queued job, and tell the worker of an executing job to stop. An ended job does not
        change.
        """
        at_work = JobRow.phase == Phase.EXECUTING
        self._database.set(
            JobRow,  # one statement, because between two statements the job could be claimed or queued again
            [JobRow.id == job_id, JobRow.phase.in_((Phase.PENDING, Phase.QUEUED, Phase.EXECUTING))],
            phase=case((at_work, JobRow.phase), else_=Phase.ABORTED.value),
            ended_at=case((at_work, JobRow.ended_at), else_=self._database.now),
            cancel_requested=True,
        )

    def hand_back(self, lease: Lease) -> bool:
        """Queue an executing job again, because its worker stops. The attempt does not count. Returns False if the
        lease is lost.
        """
        return self._database.set(
            JobRow,
            [*_held(lease), JobRow.cancel_requested.is_(False)],
            phase=Phase.QUEUED,
            attempt=JobRow.attempt - 1,
            submitted_at=None,
            submissions=0,
            lease=None,
        )

    def give_up_silent(self, lease_s: float, max_attempts: int) -> list[str]:
        """Queue the jobs again whose worker has been silent for longer than ``lease_s``; returns the ids of these jobs.

        A cancelled job is aborted instead. A job that was already started ``max_attempts`` times ends in ERROR. If
        the database's clock was set back, a heartbeat may lie in the future. Such a heartbeat counts as a heartbeat
        of this moment, so that the lease of a lost worker does not last until the clock has caught up.
        """
        now = self._database.now
        ahead = [JobRow.phase == Phase.EXECUTING, JobRow.heartbeat_at > now + lease_s]
        started_at = case((JobRow.started_at > now, now), else_=JobRow.started_at)
        self._note(ahead, heartbeat_at=now, started_at=started_at)
        silent = [JobRow.phase == Phase.EXECUTING, JobRow.heartbeat_at < now - lease_s]
        too_often = and_(JobRow.cancel_requested.is_(False), JobRow.attempt >= max_attempts)
        error = JobError(
            fault=Fault.INTERNAL,
            code="worker-lost",
            message=f"the worker was lost {max_attempts} times while it ran this job; the job is not tried again: tell "
            "the operator",
        )
        with self._database.writing.begin() as session:
            lost = update(JobRow).where(*silent, too_often)
            lost = lost.values(
                phase=Phase.ERROR, ended_at=now, lease=None, error=error.model_dump(mode="json")
            )
            for job_id in session.scalars(lost.returning(JobRow.id)):
                log.error("job %s: %s (%s)", job_id, error.message, error.code)
        with self._database.writing.begin() as session:
            # After the previous statement, further jobs may have been cancelled, or lost in their last allowed attempt.
            back = update(JobRow).where(*silent, ~too_often).values(**self._again(), submitted_at=None)
            taken = session.execute(back.returning(JobRow.id, JobRow.phase))
            return [job_id for job_id, phase in taken if phase == Phase.QUEUED]

    def nobody_works(self, for_s: float) -> bool:
        """Whether no job has started, or has sent a heartbeat, in the last ``for_s`` seconds."""
        recent = JobRow.heartbeat_at > self._database.now - for_s
        return not self._database.any(select(JobRow.id).where(JobRow.phase.in_([*Phase]), recent))

    def unsubmitted(
        self, resubmit_s: float, limit: int = 1000, *, idle: bool = False
    ) -> list[tuple[str, Queue]]:
        """Ids and queues of queued jobs that the broker never received or seems to have lost; sorted by queue, then
        oldest first.

        A job seems lost when it has waited for ``resubmit_s`` since its submission. This waiting time doubles with each
        submission, so that the jobs of a long queue are not submitted again and again.

        Parameters
        ----------
        resubmit_s
            The first waiting time, s.
        limit
            The largest number of jobs that are returned.
        idle
            Whether there are workers, and all of them do nothing. The waiting time then does not double, because a
            worker would have taken a message that the broker still had.
        """
        waits = {number: resubmit_s * 2.0 ** max(0, number - 1) for number in range(9)}
        growing_s = case(waits, value=JobRow.submissions, else_=resubmit_s * 2.0**8)
        wait_s = literal(resubmit_s) if idle else growing_s
        now = self._database.now
        # If a submission lies in the future, the database's clock was set back after it.
        ahead = JobRow.submitted_at > now + resubmit_s
        due = or_(JobRow.submitted_at.is_(None), JobRow.submitted_at < now - wait_s, ahead)
        query = select(JobRow.id).where(JobRow.phase == Phase.QUEUED, due, no_equal_at_work())
        jobs: list[tuple[str, Queue]] = []
        with self._database.reading() as session:
            for queue in Queue:
                oldest = query.where(JobRow.queue == queue).order_by(JobRow.created_at)
                jobs += [(job_id, queue) for job_id in session.scalars(oldest.limit(limit - len(jobs)))]
        return jobs

    def that_made(self, owner: str, result_id: str) -> JobRow | None:
        """A completed job with this result; None if there is none, for example because it was deleted."""
        query = select(JobRow).where(
            JobRow.owner == owner, JobRow.phase == Phase.COMPLETED, JobRow.result_id == result_id
        )
        return self._database.first(query.order_by(JobRow.created_at.desc()))

    def reopen(self, job_id: str) -> bool:
        """Queue a completed job again. The job then has the state of a job that has not run. Returns False if the job
        is not COMPLETED.
        """
        again = {
            "phase": Phase.QUEUED,
            "result_id": None,
            "ended_at": None,
            "submitted_at": None,
            "submissions": 0,
            "attempt": 0,
            "cancel_requested": False,
        }
        return self._database.set(JobRow, [JobRow.id == job_id, JobRow.phase == Phase.COMPLETED], **again)

    def of_kind(self, kind: str) -> Sequence[JobRow]:
        """All jobs of a kind, in any phase. Use this only for kinds with few jobs."""
        return self._database.all(select(JobRow).where(JobRow.kind == kind))

    def others_wait(self, kind: str) -> bool:
        """Whether a job of another kind waits and could start now."""
        waits = (JobRow.phase == Phase.QUEUED, JobRow.kind != kind, no_equal_at_work())
        return self._database.any(select(JobRow.id).where(*waits))

    def any_to_do(self, queues: Sequence[Queue], lease_s: float, worker: str) -> bool:
        """Whether this worker runs a job of these queues, or one waits and could start now, or has lost its worker:
        that job will wait soon.

        Parameters
        ----------
        lease_s
            Time without a heartbeat after which a worker counts as lost, s.
        """
        silent = JobRow.heartbeat_at < self._database.now - lease_s
        waits = (
            [JobRow.phase == Phase.QUEUED, no_equal_at_work()],
            [
                JobRow.phase == Phase.EXECUTING,
                or_(silent, JobRow.worker == worker),
            ],
        )
        of_queues = select(JobRow.id).where(JobRow.queue.in_(queues))
        return any(self._database.any(of_queues.where(*one)) for one in waits)

    def at_work_on(self, owner: str, work_key: str) -> bool:
        """Whether a job with this result executes now."""
        this = (JobRow.owner == owner, JobRow.work_key == work_key, is_at_work(JobRow.phase))
        return self._database.any(select(JobRow.id).where(*this))

    def _again(self) -> dict[str, object]:
        """Values of an UPDATE that queues an executing job again, or aborts it if it was cancelled."""
        cancelled = JobRow.cancel_requested.is_(True)
        return {
            "phase": case((cancelled, Phase.ABORTED.value), else_=Phase.QUEUED.value),
            "ended_at": case((cancelled, self._database.now)),
            "lease": None,
        }

    def _note(self, conditions: Sequence[ColumnElement[bool]], **values: object) -> bool:
        """Make a change that streams of events do not report. Returns whether it changed the job."""
        return self._database.set(JobRow, conditions, changed_at=JobRow.changed_at, **values)


def no_equal_at_work() -> ColumnElement[bool]:
    """The condition that no other job with the same result executes now."""
    other = aliased(JobRow)
    at_work = select(other.id).where(
        other.owner == JobRow.owner,
        other.work_key == JobRow.work_key,
        is_at_work(other.phase),
    )
    return ~at_work.exists()


def is_at_work(phase: InstrumentedAttribute[str]) -> ColumnElement[bool]:
    """The condition that a job executes."""
    # The phase is a literal in the text of the statement. The databases use the partial index only then.
    return phase == literal(Phase.EXECUTING.value, literal_execute=True)


def _held(lease: Lease) -> list[ColumnElement[bool]]:
    return [
        JobRow.id == lease.job_id,
        JobRow.lease == lease.token,
        JobRow.phase == Phase.EXECUTING,
    ]


class Parts(Queries):
    """The table of parts.

    The row of a part that ``take`` returns is the right to work on it, as it was when it was taken. A worker that has
    lost this right can still store its result, if no other worker has stored a result of the part.
    """

    def open(self, owner: str, request_key: str, count: int) -> None:
        """Create the parts 0 to ``count`` - 1, except those that exist."""
        with self._database.writing.begin() as session:
            there = set(session.scalars(select(PartRow.number).where(*_of(owner, request_key))))
            missing = [number for number in range(count) if number not in there]
            session.add_all(PartRow(owner=owner, request_key=request_key, number=one) for one in missing)

    def take(self, owner: str, request_key: str, lease_s: float) -> PartRow | None:
        """Take an open part, or a part whose worker has been silent for ``lease_s`` seconds; None if there is no such
        part.
        """
        # A heartbeat in the future was sent before the database's clock was set back; it counts as a heartbeat of now.
        now = self._database.now
        of_job = _of(owner, request_key)
        self._database.set(PartRow, [*of_job, PartRow.heartbeat_at > now + lease_s], heartbeat_at=now)
        silent = PartRow.heartbeat_at < now - lease_s
        free = [*of_job, PartRow.result.is_(None), or_(PartRow.token.is_(None), silent)]
        lowest = select(PartRow.number).where(*free).order_by(PartRow.number)
        while (number := self._database.first(lowest)) is not None:
            part = PartRow(owner=owner, request_key=request_key, number=number, token=uuid.uuid4().hex)
            if self._database.set(
                PartRow, [*free, PartRow.number == number], token=part.token, heartbeat_at=now
            ):
                return part
        return None

    def heartbeat(self, part: PartRow) -> bool:
        """Renew the lease. Returns False if another worker took the part or the part is done."""
        return self._database.set(PartRow, _holding(part), heartbeat_at=self._database.now)

    def finish(self, part: PartRow, result: dict[str, object]) -> bool:
        """Store the result of a part. Returns False if the part already has a result.

        The first result is kept, even if the worker has lost the part, because every worker computes the same result.
        """
        return self._database.set(PartRow, _undone(part), result=result, token=None)

    def release(self, part: PartRow) -> None:
        """Release a part without a result."""
        self._database.set(PartRow, _holding(part), token=None)

    def results(self, owner: str, request_key: str) -> list[dict[str, object]]:
        """Results of the parts that are done, sorted by number."""
        done = select(PartRow.result).where(*_of(owner, request_key), PartRow.result.is_not(None))
        return [dict(one) for one in self._database.all(done.order_by(PartRow.number)) if one]


def _of(owner: str, request_key: str) -> list[ColumnElement[bool]]:
    return [PartRow.owner == owner, PartRow.request_key == request_key]


def _undone(part: PartRow) -> list[ColumnElement[bool]]:
    this = [*_of(part.owner, part.request_key), PartRow.number == part.number]
    return [*this, PartRow.result.is_(None)]


def _holding(part: PartRow) -> list[ColumnElement[bool]]:
    return [*_undone(part), PartRow.token == part.token]
