"""Jobs of the UWS interface: clients set them up before they start, give them time limits, and destroy them."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from sqlalchemy import delete, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from workers.catalogue.database import Database, newest_first
from workers.catalogue.jobs import Jobs
from workers.catalogue.tables import JobRow, TermsRow
from workers.contract.identities import canonical_hash
from workers.contract.jobs import Phase
from workers.contract.kinds import queue_of


@dataclass(frozen=True)
class JobLine:
    """The values of a job that a list of jobs shows."""

    id: str
    phase: str
    owner: str
    created_at: float
    run_id: str | None


class UwsJobs:
    """Changes to the table of jobs that only UWS clients request; each method is one transaction."""

    def __init__(self, database: Database, jobs: Jobs) -> None:
        self._database, self._jobs = database, jobs

    def draft(self, kind: str, given: Mapping[str, object], *, owner: str, **terms: object) -> JobRow:
        """Create a PENDING job with the parameters ``given`` so far. Identical requests do not share it.

        Parameters
        ----------
        given
            The parameters that the client has given.
        **terms
            The columns of the job's ``TermsRow``.
        """
        job_id = uuid.uuid4().hex
        row = JobRow(
            id=job_id,
            owner=owner,
            kind=kind,
            parameters=given,
            request_key="",
            phase=Phase.PENDING,
            queue=queue_of(kind),
            created_at=time.time(),
        )
        with self._database.writing.begin() as session:
            session.add_all((row, TermsRow(job_id=job_id, **terms)))
        return row

    def amend(self, job_id: str, change: Callable[[dict[str, str]], dict[str, str]]) -> bool:
        """Change the parameters of a PENDING job (texts). In any other phase, nothing changes; returns False."""
        with self._database.writing.begin() as session:
            row = _locked(session, job_id)
            if row is None or row.phase != Phase.PENDING:
                return False
            row.parameters = change(dict(row.parameters))
            return True

    def start(
        self,
        job_id: str,
        given: Mapping[str, object],
        parameters: dict[str, object],
        request_key: str,
        estimate: dict[str, float] | None = None,
    ) -> bool:
        """Queue a pending job with ``parameters``, which were resolved from ``given``.

        Returns False if the job is not PENDING, or if its parameters are no longer ``given``. If an identical request
        has a job that is queued, executing or completed, this job gets a different key. This job then waits until the
        other job ends, and uses the result of the other job.
        """
        for key in (request_key, canonical_hash({"request_key": request_key, "job": job_id})):
            try:
                with self._database.writing.begin() as session:
                    row = _locked(session, job_id)
                    if row is None or row.phase != Phase.PENDING or row.parameters != given:
                        return False
                    row.phase, row.parameters, row.request_key = Phase.QUEUED, parameters, key
                    row.work_key, row.estimate = request_key, estimate
                return True
            except IntegrityError:
                continue
        raise RuntimeError(f"another job has the key that belongs to job {job_id} alone")

    def destroy(self, job_id: str) -> bool:
        """Delete a job, in any phase. Its worker loses the lease and stops. Its result stays."""
        with self._database.writing.begin() as session:
            row = _locked(session, job_id)
            session.execute(delete(TermsRow).where(TermsRow.job_id == job_id))
            if row is None:
                return False
            session.delete(row)
            return True

    def terms(self, job_id: str) -> TermsRow:
        """The UWS terms of a job: run id, time limit, destruction time."""
        return self._database.row(TermsRow, job_id) or TermsRow(job_id=job_id, execution_duration_s=0)

    def set_terms(self, job_id: str, **values: object) -> None:
        """Change UWS terms of a job."""
        with self._database.writing.begin() as session:
            # The lock on the job's row puts changes in order. Terms are not added to a deleted job.
            if _locked(session, job_id) is not None:
                session.merge(TermsRow(job_id=job_id, **values))

    def end_by_terms(self) -> list[str]:
        """Stop jobs that exceed their time limit; destroy jobs whose destruction time has come, and return their
        ids.
        """
        now = self._database.now
        too_long = select(JobRow.id).join(TermsRow, TermsRow.job_id == JobRow.id)
        too_long = too_long.where(
            JobRow.phase == Phase.EXECUTING,
            JobRow.cancel_requested.is_(False),
            TermsRow.execution_duration_s > 0,
            JobRow.started_at + TermsRow.execution_duration_s < now,
        )
        for job_id in self._database.all(too_long):
            self._jobs.cancel(job_id)
        due = self._database.all(select(TermsRow.job_id).where(TermsRow.destruction_at < now))
        return [job_id for job_id in due if self.destroy(job_id)]

    def lines(
        self, *, owner: str, last: int, phases: Sequence[str] = (), from_time: float | None = None
    ) -> list[JobLine]:
        """The newest ``last`` jobs of an owner, newest first.

        Parameters
        ----------
        phases
            The phases of the jobs; empty: all phases.
        from_time
            The earliest time at which the jobs were created, in seconds since 1970; None: any time.
        """
        query = select(JobRow.id, JobRow.phase, JobRow.owner, JobRow.created_at, TermsRow.run_id)
        query = query.outerjoin(TermsRow, TermsRow.job_id == JobRow.id).where(JobRow.owner == owner)
        if phases:
            query = query.where(JobRow.phase.in_(phases))
        if from_time is not None:
            query = query.where(JobRow.created_at >= from_time)
        return [
            JobLine(*line)
            for line in self._database.lines(newest_first(query, (JobRow.created_at, JobRow.id), last))
        ]


def _locked(session: Session, job_id: str) -> JobRow | None:
    """Lock the row of a job until the transaction ends; returns the row. None if there is no such job."""
    return session.get(JobRow, job_id, with_for_update=True)
