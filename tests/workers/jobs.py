"""Rows of jobs and bulk runs, the leases of workers, and a runner of the test's own tasks."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from workers.catalogue.bulks import new_id
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.catalogue.tables import DEFAULT_OWNER, BulkRow, JobRow
from workers.contract.bulk import BulkPhase
from workers.contract.jobs import Queue
from workers.files.store import Store
from workers.run.child import Stopping
from workers.run.runner import Runner
from workers.settings import Settings
from workers.tasks.catalogue_workspace import CatalogueWorkspace

Task = Callable[[CatalogueWorkspace, Mapping[str, Any]], str]


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


def run_job(runner: Runner, catalogue: Catalogue, job_id: str) -> None:
    """Let a runner take the message of a job."""
    runner.run_next(job_id, Queue(job_row(catalogue, job_id).queue))


def bulk_row(owner: str, key: str = "k", *, listed: bool = True, **values: Any) -> BulkRow:
    """A bulk run that is at work; listed: whether all of its files are listed."""
    known = {
        "id": new_id(), "owner": owner, "name": "", "request": {}, "request_key": key, "psf_id": "p" * 64,
        "phase": BulkPhase.RUNNING if listed else BulkPhase.LISTING, "listed": listed, "created_at": time.time(),
        "running_since": time.time(),
    }  # fmt: skip
    return BulkRow(**(known | values))


class Bench:
    """A runner in this process, whose jobs run a task of the test's own."""

    def __init__(self, folder: Path, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
        self.catalogue, self.stopping = catalogue, Stopping()
        self._settings = Settings(data_dir=folder / "data", heartbeat_s=0.05, broker_url="filesystem://")
        self._monkeypatch = monkeypatch

    def run(self, task: Task, **changes: Any) -> JobRow:
        """The row of a job of this task after one attempt; a job that was handed back gets another attempt.

        changes: further settings of the worker.
        """
        self._monkeypatch.setattr("workers.tasks.psf_build.psf_build", task)
        job, _ = self.catalogue.jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)
        self.catalogue.jobs.mark_submitted(job.id)
        settings = self._settings.model_copy(update=changes)
        runner = Runner(settings, self.catalogue, Store(settings.data_dir), stopping=self.stopping)
        run_job(runner, self.catalogue, job.id)
        return job_row(self.catalogue, job.id)


@pytest.fixture
def bench(tmp_path: Path, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> Bench:
    """A runner with the catalogue of the test."""
    return Bench(tmp_path, catalogue, monkeypatch)
