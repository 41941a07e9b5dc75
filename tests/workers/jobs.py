"""Rows of jobs and bulk runs, and the leases of workers."""

from __future__ import annotations

import time
from typing import Any

from workers.catalogue.bulks import new_id
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.catalogue.tables import BulkRow, JobRow
from workers.contract.bulk import BulkPhase


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


def bulk_row(owner: str, key: str = "k", *, listed: bool = True, **values: Any) -> BulkRow:
    """A bulk run that is at work; listed: whether all of its files are listed."""
    known = {
        "id": new_id(), "owner": owner, "name": "", "request": {}, "request_key": key, "psf_id": "p" * 64,
        "phase": BulkPhase.RUNNING if listed else BulkPhase.LISTING, "listed": listed, "created_at": time.time(),
        "running_since": time.time(),
    }  # fmt: skip
    return BulkRow(**(known | values))
