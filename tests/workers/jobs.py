"""Rows of jobs, and the leases of workers, for tests that know that they are there."""

from __future__ import annotations

from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.catalogue.tables import JobRow


def job_row(catalogue: Catalogue, job_id: str) -> JobRow:
    """The row of a job."""
    row = catalogue.jobs.get(job_id)
    assert row is not None
    return row


def claimed(catalogue: Catalogue, job_id: str, worker: str = "w") -> Lease:
    """The lease of a worker that claims a waiting job."""
    lease = catalogue.jobs.claim(job_id, worker)
    assert lease is not None
    return lease
