"""Waiting jobs: which one a worker claims next, and how many are expected to start before a given one.

The broker delivers messages in the order in which jobs were submitted. If each message started the job that it names,
one owner's many jobs would delay the single job of another. Therefore a message only allows a worker to start one job
of a queue; the database determines which job, by turns of the owners. There are as many messages as waiting jobs, so
every job starts. If messages are lost, the reconciler submits the waiting jobs again. A message has no effect if no job
waits.

The place of a job is the number of waiting jobs before it. More urgent queues come first. Before an owner's k-th job
of a queue starts, every owner whose turn is earlier starts up to k jobs, and every other owner starts up to k - 1 jobs.
The place is only an estimate: a worker may serve only some of the queues, and jobs that other owners submit later may
start first.
"""

from __future__ import annotations

from sqlalchemy import ColumnElement, Select, and_, func, or_, select
from sqlalchemy.orm import Session

from workers.catalogue.database import Database, Queries
from workers.catalogue.jobs import Jobs, Lease, is_at_work, no_equal_at_work
from workers.catalogue.tables import JobRow, OwnerTurnRow
from workers.contract.jobs import Phase, Queue

MOST_COUNTED = 1000
# at most this number of waiting jobs of a queue is read, oldest first, to count the jobs of each owner
MOST_READ = 10_000


class Turns:
    """Claims jobs of the table of jobs by turns; each method is one or more transactions of ``Jobs``."""

    def __init__(self, database: Database, jobs: Jobs) -> None:
        self._database, self._jobs = database, jobs

    def claim_next(self, told_id: str, queue: Queue, worker: str) -> Lease | None:
        """Claim the next job of a queue: a job of the owner whose turn it is. Returns None if no job of the queue can
        start now.

        A message of the broker allows a worker to start one job of a queue; ``told_id`` is the job that the message
        names. The owner whose jobs of this queue were claimed least recently comes first, so that the many jobs of
        one owner do not delay the single job of another. Of an owner's jobs, the oldest comes first; for a job that
        was handed back, the time of its last start is used instead of its creation time. The number of running jobs
        of an owner does not matter. Otherwise an owner with one long running job would wait until no other owner has
        a waiting job.
        """
        while (job_id := self._next(told_id, queue)) is not None:
            lease = self._jobs.claim(job_id, worker)
            if lease is not None:
                return lease
        # This message is used up. Jobs that wait for an identical job need another message later, so they are marked as
        # not submitted.
        blocked = [JobRow.phase == Phase.QUEUED, JobRow.queue == queue, ~no_equal_at_work()]
        received = JobRow.submitted_at.is_not(None)
        self._database.set(JobRow, [*blocked, received], submitted_at=None, changed_at=JobRow.changed_at)
        return None

    def leave_next(self, told_id: str, queue: Queue) -> str | None:
        """Record that a worker took a message from the broker but starts no job. The job will be submitted again.

        The job is the one that ``claim_next`` would claim. Returns its id; None if no job of the queue can start.
        """
        job_id = self._next(told_id, queue)
        if job_id is not None:
            self._jobs.forget_submission(job_id)
        return job_id

    def _next(self, told_id: str, queue: Queue) -> str | None:
        """The id of the next job of a queue; None if no job of the queue can start now."""
        with self._database.reading() as session:
            for owner in session.scalars(_owners(queue)).all():
                job_id = session.scalars(_oldest(owner, told_id, queue)).first()
                if job_id is not None:
                    return job_id
        return None


def _owners(queue: Queue) -> Select[str]:
    """The owners whose jobs wait in a queue; the owner who was served least recently comes first."""
    number = func.coalesce(OwnerTurnRow.number, 0)
    turn = and_(OwnerTurnRow.owner == JobRow.owner, OwnerTurnRow.queue == JobRow.queue)
    waiting = select(JobRow.owner).outerjoin(OwnerTurnRow, turn)
    waiting = waiting.where(JobRow.phase == Phase.QUEUED, JobRow.queue == queue)
    return waiting.group_by(JobRow.owner, OwnerTurnRow.number).order_by(number, JobRow.owner)


def _oldest(owner: str, told_id: str, queue: Queue) -> Select[str]:
    """The owner's oldest job that could start now.

    A job can start if the server has recorded that the broker received the job, and if no retry of the job is
    delayed. These conditions do not apply to the job ``told_id``: the broker may deliver its id before the server has
    recorded the submission.
    """
    received = and_(JobRow.submitted_at.is_not(None), JobRow.delayed.is_(False))
    # Not no_equal_at_work(): that condition is tested for each waiting job, of which there may be many thousands.
    at_work = select(JobRow.work_key).where(
        JobRow.owner == owner, is_at_work(JobRow.phase), JobRow.work_key.is_not(None)
    )
    oldest = (
        select(JobRow.id)
        .where(JobRow.owner == owner, JobRow.phase == Phase.QUEUED, JobRow.queue == queue)
        .where(or_(JobRow.id == told_id, received))
        .where(or_(JobRow.work_key.is_(None), JobRow.work_key.not_in(at_work)))
        .order_by(func.coalesce(JobRow.started_at, JobRow.created_at), JobRow.id)
    )
    return oldest.limit(1)


class Places(Queries):
    """Counts waiting jobs. Each method reads a bounded number of rows."""

    def before(self, job: JobRow) -> int | None:
        """The number of waiting jobs that are expected to start before a job, at most MOST_COUNTED; None if the job
        is not QUEUED.
        """
        if job.phase != Phase.QUEUED:
            return None
        began = job.created_at if job.started_at is None else job.started_at
        begins = func.coalesce(JobRow.started_at, JobRow.created_at)
        # No job starts before it is created, so the index on created_at bounds the search.
        earlier = and_(
            JobRow.created_at <= began, or_(begins < began, and_(begins == began, JobRow.id < job.id))
        )
        return self._count(job.owner, Queue(job.queue), earlier)

    def before_new(self, owner: str, queue: Queue) -> int:
        """The number of waiting jobs that are expected to start before a job that the owner would submit now."""
        return self._count(owner, queue)

    def _count(self, owner: str, queue: Queue, *own: ColumnElement[bool]) -> int:
        order = list(Queue)
        urgent = _waiting(JobRow.queue.in_(order[: order.index(queue)]))
        with self._database.reading() as session:
            own_before = _counted(session, _waiting(JobRow.queue == queue, JobRow.owner == owner, *own))
            before = own_before + _counted(session, urgent)
            if before < MOST_COUNTED:
                before += _of_others(session, owner, queue, own_before)
        return min(before, MOST_COUNTED)


def _waiting(*conditions: ColumnElement[bool]) -> Select[str]:
    return select(JobRow.id).where(JobRow.phase == Phase.QUEUED, *conditions)


def _counted(session: Session, query: Select[str]) -> int:
    return session.scalar(select(func.count()).select_from(query.limit(MOST_COUNTED).subquery())) or 0


def _of_others(session: Session, owner: str, queue: Queue, own_before: int) -> int:
    """The number of jobs of other owners that start before the owner's next job.

    Parameters
    ----------
    own_before
        Number of jobs of the same owner that start before this next job.
    """
    oldest = select(JobRow.owner).where(JobRow.phase == Phase.QUEUED, JobRow.queue == queue)
    read = oldest.order_by(JobRow.created_at).limit(MOST_READ).subquery()
    counts = select(read.c.owner, func.count()).where(read.c.owner != owner).group_by(read.c.owner)
    turns = select(OwnerTurnRow.owner, OwnerTurnRow.number).where(OwnerTurnRow.queue == queue)
    numbers = {turn.owner: turn.number for turn in session.execute(turns)}
    own_turn = numbers.get(owner, 0), owner
    return sum(
        min(count, own_before + ((numbers.get(other, 0), other) < own_turn))
        for other, count in session.execute(counts)
    )
