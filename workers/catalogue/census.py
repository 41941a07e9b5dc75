"""Counts for operators: worker processes, jobs by kind and phase, waiting jobs, and files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy import case, delete, func, select
from sqlalchemy.dialects import postgresql, sqlite

from workers.catalogue.database import Database
from workers.catalogue.jobs import no_equal_at_work
from workers.catalogue.tables import (
    ImageRow,
    JobRow,
    ProductRow,
    PsfRow,
    ReportRow,
    SolutionRow,
    TransitRow,
    WorkerRow,
)
from workers.contract.phases import Phase
from workers.contract.queues import Queue


@dataclass(frozen=True)
class JobTally:
    """The number of jobs of one kind in one phase, with sums over these jobs."""

    kind: str
    phase: str
    jobs: int
    attempts: int
    retries: int
    run_s: float  # sum over the jobs that ended: seconds from the last start to the end


@dataclass(frozen=True)
class FileTally:
    """The number of files of one kind and origin, and their size."""

    kind: str
    origin: str  # uploaded | built
    files: int
    bytes: int


class Census:
    """Counts, and the list of workers; each method is one transaction."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def announce(self, worker: str, started_at: float, version: str) -> None:
        """Record that a worker process is alive; delete the rows of workers that have been silent for an hour."""
        now = self._database.now
        insert = sqlite.insert if self._database.sqlite else postgresql.insert
        said = {"started_at": started_at, "heartbeat_at": now, "version": version}
        there = insert(WorkerRow).values(name=worker, **said)
        with self._database.writing.begin() as session:
            session.execute(delete(WorkerRow).where(WorkerRow.heartbeat_at < now - 3600.0))
            session.execute(there.on_conflict_do_update(index_elements=["name"], set_=said))

    def take_leave(self, worker: str) -> None:
        """Record that a worker process ends."""
        with self._database.writing.begin() as session:
            session.execute(delete(WorkerRow).where(WorkerRow.name == worker))

    def workers(self, lease_s: float) -> Sequence[WorkerRow]:
        """Worker processes whose last heartbeat is at most ``lease_s`` seconds old.

        A heartbeat in the future was sent before the database's clock was set back; such a worker is left out.
        """
        now = self._database.now
        query = select(WorkerRow).where(WorkerRow.heartbeat_at.between(now - lease_s, now + lease_s))
        with self._database.reading() as session:
            return session.scalars(query.order_by(WorkerRow.name)).all()

    def tally(self) -> list[JobTally]:
        """Jobs by kind and phase."""
        query = select(
            JobRow.kind,
            JobRow.phase,
            func.count(),
            func.sum(JobRow.attempt),
            func.sum(case((JobRow.attempt > 1, JobRow.attempt - 1), else_=0)),
            func.sum(func.coalesce(JobRow.ended_at - JobRow.started_at, 0.0)),
        ).group_by(JobRow.kind, JobRow.phase)
        with self._database.reading() as session:
            return [
                JobTally(kind, phase, int(jobs), int(attempts), int(retries), float(run_s))
                for kind, phase, jobs, attempts, retries, run_s in session.execute(query)
            ]

    def tally_files(self) -> list[FileTally]:
        """Numbers and bytes of files, by kind and origin."""
        found = []
        with self._database.reading() as session:
            for kind, upload in (("image", ImageRow), ("transit", TransitRow)):
                files, size = session.execute(
                    select(func.count(), func.coalesce(func.sum(upload.bytes), 0)).select_from(upload)
                ).one()
                found.append(FileTally(kind, "uploaded", int(files), int(size)))
            query = select(PsfRow.origin, func.count(), func.sum(PsfRow.bytes)).group_by(PsfRow.origin)
            for origin, files, size in session.execute(query):
                found.append(FileTally("psf", origin, int(files), int(size)))
            for kind, made in (("product", ProductRow), ("report", ReportRow), ("solution", SolutionRow)):
                files, size = session.execute(
                    select(func.count(), func.coalesce(func.sum(made.bytes), 0)).select_from(made)
                ).one()
                found.append(FileTally(kind, "built", int(files), int(size)))
        return found

    def oldest_queued_at(self, queue: Queue | None = None) -> float | None:
        """Creation time of the oldest waiting job, in one queue or in all; None if no job waits."""
        waiting = select(func.min(JobRow.created_at)).where(JobRow.phase == Phase.QUEUED)
        with self._database.reading() as session:
            return session.scalar(waiting if queue is None else waiting.where(JobRow.queue == queue))

    def count_silent(self, lease_s: float) -> int:
        """Number of executing jobs whose worker has been silent for longer than the lease."""
        now = self._database.now
        heard = JobRow.heartbeat_at.between(now - lease_s, now + lease_s)
        silent = (JobRow.phase == Phase.EXECUTING, ~heard)
        with self._database.reading() as session:
            return session.scalar(select(func.count()).select_from(JobRow).where(*silent)) or 0

    def count_unsubmitted(self, older_than_s: float) -> int:
        """Number of queued jobs that could start, but were not given to the broker within ``older_than_s``."""
        left = (
            JobRow.phase == Phase.QUEUED,
            JobRow.submitted_at.is_(None),
            JobRow.created_at < self._database.now - older_than_s,
            no_equal_at_work(),
        )
        with self._database.reading() as session:
            return session.scalar(select(func.count()).select_from(JobRow).where(*left)) or 0

    def clock(self) -> float:
        """The time of the database's clock, in seconds since 1970."""
        with self._database.reading() as session:
            return float(session.scalars(select(self._database.now)).one())
