"""Jobs that make the same: one is at work at a time, and what it made is what the others end with."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import text

from tests.whole.stack import wait_for
from workers import queue, tasks
from workers.catalogue import Catalogue
from workers.context import Context
from workers.contract import Fault, JobError, Phase
from workers.job_rows import Lease
from workers.reconciler import reconcile
from workers.runner import Runner
from workers.settings import Settings
from workers.store import Store
from workers.tables import DEFAULT_OWNER, JobRow, PsfRow


def started(catalogue: Catalogue, key: str = "k", owner: str = DEFAULT_OWNER) -> str:
    """The id of a job of a UWS client's that was told to run."""
    draft = catalogue.uws.draft("psf-build", {}, owner=owner)
    assert catalogue.uws.start(draft.id, {}, {"key": key}, key)
    return draft.id


def row(catalogue: Catalogue, job_id: str) -> JobRow:
    found = catalogue.jobs.get(job_id)
    assert found is not None
    return found


def claim(catalogue: Catalogue, job_id: str) -> Lease | None:
    return catalogue.jobs.claim(job_id, "w")


def waiting(catalogue: Catalogue) -> set[str]:
    return {job.id for job in catalogue.jobs.unsubmitted(3600.0)}


def test_of_equal_jobs_that_are_claimed_at_one_moment_one_is_at_work(catalogue: Catalogue) -> None:
    jobs = [started(catalogue) for _ in range(8)]
    catalogue.jobs.mark_submitted(*jobs)
    with ThreadPoolExecutor(8) as pool:
        leases = list(pool.map(lambda job: claim(catalogue, job), jobs))
    assert sum(lease is not None for lease in leases) == 1
    phases = sorted(row(catalogue, job).phase for job in jobs)
    assert phases == [Phase.EXECUTING] + 7 * [Phase.QUEUED]
    assert waiting(catalogue) == set(), "none is given to the broker in vain"
    assert not catalogue.jobs.others_wait("bulk"), "and a bulk does not make way for them"
    assert catalogue.census.count_unsubmitted(-1.0) == 0, "nor does an operator have to look after them"
    assert all(row(catalogue, job).attempt == 0 for job, lease in zip(jobs, leases, strict=True) if not lease)


@pytest.mark.parametrize("end", ["complete", "fail", "requeue", "hand_back", "destroy", "silent"])
def test_once_it_is_no_longer_at_work_the_next_may_be(catalogue: Catalogue, end: str) -> None:
    first, second = started(catalogue), started(catalogue)
    catalogue.jobs.mark_submitted(first, second)
    lease = claim(catalogue, first)
    assert lease is not None and claim(catalogue, second) is None
    match end:
        case "complete":
            assert catalogue.jobs.complete(lease, "r")
        case "fail":
            assert catalogue.jobs.fail(lease, JobError(fault=Fault.INTERNAL, code="c", message="m"))
        case "requeue":
            assert catalogue.jobs.requeue(lease)
        case "hand_back":
            assert catalogue.jobs.hand_back(lease)
        case "destroy":
            assert catalogue.uws.destroy(first)
        case "silent":
            assert catalogue.jobs.give_up_silent(-1.0, 3) == [first]
    assert second in waiting(catalogue)
    assert claim(catalogue, second) is not None


def test_others_are_not_kept_waiting(catalogue: Catalogue) -> None:
    first = started(catalogue)
    assert claim(catalogue, first) is not None
    assert claim(catalogue, started(catalogue, key="other")) is not None
    assert claim(catalogue, started(catalogue, owner="somebody")) is not None


def test_two_at_once_compute_once(
    tmp_path: Path, catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = Settings(data_dir=tmp_path / "data", broker_url="filesystem://", reconcile_s=0.05)
    computed: list[str] = []
    at_work, go_on = threading.Event(), threading.Event()

    def build(context: Context, parameters: Mapping[str, Any]) -> str:
        if context.catalogue.get(PsfRow, parameters["key"], context.owner) is None:
            computed.append(context.job_id)
            at_work.set()
            assert go_on.wait(60.0)
            made = PsfRow(
                owner=context.owner, id=parameters["key"], created_at=time.time(), name="n", version="1",
                status="draft", origin="built", file_sha256="f", bytes=1, details={},
            )  # fmt: skip
            context.catalogue.add(made)
        return str(parameters["key"])

    monkeypatch.setitem(tasks.TASKS, "psf-build", build)
    submitted: list[str] = []
    monkeypatch.setattr(queue, "submit", lambda app, job_id, queue_name: submitted.append(job_id) or True)
    runner = Runner(settings, catalogue, Store(settings.data_dir))
    first, second = started(catalogue), started(catalogue)
    catalogue.jobs.mark_submitted(first, second)
    worker = threading.Thread(target=runner.run, args=(first,))
    worker.start()
    try:
        assert at_work.wait(60.0)
        runner.run(second)  # another worker is given it now
        assert row(catalogue, second).phase == Phase.QUEUED
        assert reconcile(catalogue, queue.make_app(settings), settings) == 0
    finally:
        go_on.set()
        worker.join()
    wait_for(lambda: row(catalogue, first).phase == Phase.COMPLETED, "the first is done")
    assert reconcile(catalogue, queue.make_app(settings), settings) == 1 and submitted == [second]
    runner.run(second)
    assert computed == [first]
    assert row(catalogue, first).result_id == row(catalogue, second).result_id == "k"
    assert row(catalogue, second).phase == Phase.COMPLETED


def test_jobs_from_before_say_what_they_make_by_their_key(catalogue: Catalogue) -> None:
    draft = catalogue.uws.draft("psf-build", {}, owner=DEFAULT_OWNER)
    job = started(catalogue)
    with catalogue._engine.begin() as connection:  # as revision 0008 had it
        connection.execute(text("DROP INDEX one_at_work_a_result"))
        connection.execute(text("ALTER TABLE jobs DROP COLUMN work_key"))
        connection.execute(text("UPDATE alembic_version SET version_num = '0008'"))
    catalogue.upgrade()
    assert (row(catalogue, job).work_key, row(catalogue, draft.id).work_key) == ("k", None)
    assert claim(catalogue, job) is not None and claim(catalogue, started(catalogue)) is None
