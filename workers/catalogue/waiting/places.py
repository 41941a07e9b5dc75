"""Places: the number of waiting jobs that are expected to start before a given waiting job.

More urgent queues come first. In a queue the owners take turns (``workers.catalogue.waiting.turns``). Before an owner's
k-th job starts, every owner whose turn is earlier starts up to k jobs, and every other owner starts up to k - 1 jobs.
The place is only an estimate: a worker may serve only some of the queues, and jobs that other owners submit later may
start first.
"""

from __future__ import annotations

from sqlalchemy import ColumnElement, Select, and_, func, or_, select
from sqlalchemy.orm import Session

from workers.catalogue.database import Database
from workers.catalogue.tables import JobRow, OwnerTurnRow
from workers.contract.phases import Phase
from workers.contract.queues import Queue

MOST_COUNTED = 1000
MOST_READ = 10_000  # at most this number of waiting jobs of a queue is read, oldest first, to count the jobs of each owner


class Places:
    """Counts waiting jobs; each method is one transaction that reads a bounded number of rows."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def before(self, job: JobRow) -> int | None:
        """The number of waiting jobs that are expected to start before a job, at most MOST_COUNTED; None if the job
        is not QUEUED."""
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
    found = session.scalar(select(func.count()).select_from(query.limit(MOST_COUNTED).subquery()))
    return found or 0


def _of_others(session: Session, owner: str, queue: Queue, own_before: int) -> int:
    """The number of jobs of other owners that start before the owner's next job.

    own_before: how many jobs of the same owner start before this next job.
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
