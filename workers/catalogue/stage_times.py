"""The time that jobs took: the total time of each stage by kind of job, and the durations of the newest jobs."""

from __future__ import annotations

from collections.abc import Mapping

from sqlalchemy import select
from sqlalchemy.dialects import postgresql, sqlite

from workers.catalogue.database import Database
from workers.catalogue.tables import JobRow, StageTimeRow
from workers.contract.phases import Phase
from workers.stage_timer import Spent


class KeptStageTimes:
    """The table of stage times; each method is one transaction."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, kind: str, spent: Mapping[str, Spent]) -> None:
        """Add the times of one attempt of a job of this kind."""
        insert = sqlite.insert if self._database.sqlite else postgresql.insert
        # The rows are sorted, so that two attempts that write at the same moment cannot deadlock.
        rows = [
            {"kind": kind, "stage": stage, "seconds": one.seconds, "steps": one.steps}
            for stage, one in sorted(spent.items())
        ]
        if not rows:
            return
        new = insert(StageTimeRow).values(rows)
        sums = {
            "seconds": StageTimeRow.seconds + new.excluded.seconds,
            "steps": StageTimeRow.steps + new.excluded.steps,
        }
        with self._database.writing.begin() as session:
            session.execute(new.on_conflict_do_update(index_elements=["kind", "stage"], set_=sums))

    def all(self) -> dict[tuple[str, str], Spent]:
        """Total times by kind of job and stage."""
        query = select(StageTimeRow).order_by(StageTimeRow.kind, StageTimeRow.stage)
        with self._database.reading() as session:
            return {(row.kind, row.stage): Spent(row.seconds, row.steps) for row in session.scalars(query)}

    def run_times(self, kind: str, limit: int) -> list[tuple[float, float]]:
        """Estimated time (before the measured factor) and duration of the newest completed jobs of a kind, s."""
        query = (
            select(JobRow.estimate, JobRow.ended_at - JobRow.started_at)
            .where(JobRow.kind == kind, JobRow.phase == Phase.COMPLETED)
            .where(JobRow.estimate.is_not(None), JobRow.started_at.is_not(None))
            .order_by(JobRow.created_at.desc())
            .limit(limit)
        )
        with self._database.reading() as session:
            return [
                ((one or {}).get("start_s", 0.0), float(took_s)) for one, took_s in session.execute(query)
            ]
