"""Figures for operators: worker processes, jobs by kind and phase, waiting jobs, files, and the time that jobs took."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import case, delete, func, literal, select

from workers.catalogue.database import Queries, insert_into
from workers.catalogue.jobs import no_equal_at_work
from workers.catalogue.quotas import FileRow
from workers.catalogue.tables import (
    ImageRow,
    JobRow,
    ProductRow,
    PsfRow,
    ReportRow,
    SolutionRow,
    StageTimeRow,
    TransitRow,
    WorkerRow,
)
from workers.contract.jobs import Phase, Queue
from workers.stage_timer import StageTime


@dataclass(frozen=True)
class JobTally:
    """The number of jobs of one kind in one phase, with sums over these jobs."""

    kind: str
    phase: str
    jobs: int
    attempts: int
    retries: int
    run_s: float  # sum over the jobs that ended: seconds from the last start to the end


# The tables of files, and the origin of their files; a PSF has its own origin.
ORIGINS: dict[type[FileRow], str] = {
    ImageRow: "uploaded",
    TransitRow: "uploaded",
    PsfRow: "",
    ProductRow: "built",
    ReportRow: "built",
    SolutionRow: "built",
}


@dataclass(frozen=True)
class FileTally:
    """The number of files of one kind and origin, and their size."""

    kind: str
    origin: str  # uploaded | built
    files: int
    bytes: int


class Census(Queries):
    """Counts, and the list of workers."""

    def announce(self, worker: str, started_at: float, version: str) -> None:
        """Record that a worker process is alive; delete the rows of workers that have been silent for an hour."""
        now = self._database.now
        values = {"started_at": started_at, "heartbeat_at": now, "version": version}
        with self._database.writing.begin() as session:
            session.execute(delete(WorkerRow).where(WorkerRow.heartbeat_at < now - 3600.0))
            row = insert_into(session, WorkerRow).values(name=worker, **values)
            session.execute(row.on_conflict_do_update(index_elements=["name"], set_=values))

    def take_leave(self, worker: str) -> None:
        """Record that a worker process ends."""
        self._database.change(delete(WorkerRow).where(WorkerRow.name == worker))

    def workers(self, lease_s: float) -> Sequence[WorkerRow]:
        """Worker processes whose last heartbeat is at most ``lease_s`` seconds old.

        A heartbeat in the future was sent before the database's clock was set back; such a worker is left out.
        """
        now = self._database.now
        query = select(WorkerRow).where(WorkerRow.heartbeat_at.between(now - lease_s, now + lease_s))
        return self._database.all(query.order_by(WorkerRow.name))

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
        return [
            JobTally(kind, phase, int(jobs), int(attempts), int(retries), float(run_s or 0.0))
            for kind, phase, jobs, attempts, retries, run_s in self._database.lines(query)
        ]

    def tally_files(self) -> list[FileTally]:
        """Numbers and bytes of files, by kind and origin."""
        tallies = []
        with self._database.reading() as session:
            for table, origin in ORIGINS.items():
                sums = (func.count(), func.coalesce(func.sum(table.bytes), 0))
                query = select(literal(origin), *sums).select_from(table)
                if table is PsfRow:
                    query = select(PsfRow.origin, *sums).group_by(PsfRow.origin)
                rows = session.execute(query)
                tallies += [FileTally(table.thing(), of, int(files), int(size)) for of, files, size in rows]
        return tallies

    def oldest_queued_at(self, queue: Queue | None = None) -> float | None:
        """Creation time of the oldest waiting job, in one queue or in all; None if no job waits."""
        waiting = select(func.min(JobRow.created_at)).where(JobRow.phase == Phase.QUEUED)
        return self._database.first(waiting if queue is None else waiting.where(JobRow.queue == queue))

    def count_silent(self, lease_s: float) -> int:
        """Number of executing jobs whose worker has been silent for longer than the lease."""
        now = self._database.now
        heard = JobRow.heartbeat_at.between(now - lease_s, now + lease_s)
        return self._database.count(JobRow, JobRow.phase == Phase.EXECUTING, ~heard)

    def count_unsubmitted(self, older_than_s: float) -> int:
        """Number of queued jobs that could start, but were not given to the broker within ``older_than_s``."""
        return self._database.count(
            JobRow,
            JobRow.phase == Phase.QUEUED,
            JobRow.submitted_at.is_(None),
            JobRow.created_at < self._database.now - older_than_s,
            no_equal_at_work(),
        )

    def count_untaken(self, older_than_s: float) -> int:
        """Number of queued jobs that are older than ``older_than_s``, and that were given to the broker more than once
        since they were queued.
        """
        return self._database.count(
            JobRow,
            JobRow.phase == Phase.QUEUED,
            JobRow.submissions > 1,
            JobRow.created_at < self._database.now - older_than_s,
        )


class KeptStageTimes(Queries):
    """The total time of each stage by kind of job, and the durations of the newest jobs."""

    def add(self, kind: str, spent: Mapping[str, StageTime]) -> None:
        """Add the times of one attempt of a job of this kind."""
        # The rows are sorted, so that two attempts that write at the same moment cannot deadlock.
        rows = [
            {"kind": kind, "stage": stage, "seconds": one.seconds, "steps": one.steps}
            for stage, one in sorted(spent.items())
        ]
        if not rows:
            return
        with self._database.writing.begin() as session:
            new = insert_into(session, StageTimeRow).values(rows)
            sums = {
                "seconds": StageTimeRow.seconds + new.excluded.seconds,
                "steps": StageTimeRow.steps + new.excluded.steps,
            }
            session.execute(new.on_conflict_do_update(index_elements=["kind", "stage"], set_=sums))

    def all(self) -> dict[tuple[str, str], StageTime]:
        """Total times by kind of job and stage."""
        query = select(StageTimeRow).order_by(StageTimeRow.kind, StageTimeRow.stage)
        return {(row.kind, row.stage): StageTime(row.seconds, row.steps) for row in self._database.all(query)}

    def run_times(self, kind: str, limit: int) -> list[tuple[float, float]]:
        """Estimated time (before the measured factor) and duration of the newest completed jobs of a kind, s."""
        query = (
            select(JobRow.estimate, JobRow.ended_at - JobRow.started_at)
            .where(JobRow.kind == kind, JobRow.phase == Phase.COMPLETED)
            .where(JobRow.estimate.is_not(None), JobRow.started_at.is_not(None))
            .order_by(JobRow.created_at.desc())
            .limit(limit)
        )
        return [
            ((one or {}).get("start_s", 0.0), float(took_s or 0.0))
            for one, took_s in self._database.lines(query)
        ]
