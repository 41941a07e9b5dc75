"""Completed jobs whose result was lost: they are queued again, and make the result again."""

from __future__ import annotations

from sqlalchemy import select, update

from workers.catalogue.database import Database
from workers.catalogue.tables import JobRow
from workers.contract.phases import Phase


class Again:
    """Finds completed jobs, and queues them again; each method is one transaction."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def that_made(self, owner: str, result_id: str) -> JobRow | None:
        """A completed job with this result; None if there is none, for example because it was deleted."""
        query = select(JobRow).where(
            JobRow.owner == owner, JobRow.phase == Phase.COMPLETED, JobRow.result_id == result_id
        )
        with self._database.reading() as session:
            return session.scalars(query.order_by(JobRow.created_at.desc())).first()

    def reopen(self, job_id: str) -> bool:
        """COMPLETED -> QUEUED. The job then has the state of a job that has not run. Returns False if the job is not
        COMPLETED."""
        again = {
            "phase": Phase.QUEUED,
            "result_id": None,
            "ended_at": None,
            "submitted_at": None,
            "submissions": 0,
            "attempt": 0,
            "cancel_requested": False,
        }
        completed = (JobRow.id == job_id, JobRow.phase == Phase.COMPLETED)
        return bool(self._database.change(update(JobRow).where(*completed).values(**again)))
