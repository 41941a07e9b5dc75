"""Jobs that are set up before they start: PENDING and what follows, and the terms that end them."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from sqlalchemy import update

from tests.workers.databases import BOTH, change
from tests.workers.jobs import claimed, job_row
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, JobRow
from workers.contract.jobs import Phase


def drafted(catalogue: Catalogue, **terms: Any) -> JobRow:
    return catalogue.uws.draft("psf-build", {"instrument": "hri_euv"}, owner=DEFAULT_OWNER, **terms)


def test_a_pending_job_waits_until_it_is_started(catalogue: Catalogue) -> None:
    job = drafted(catalogue)

    def fail(given: dict[str, Any]) -> dict[str, Any]:
        raise ValueError("no", given)

    with pytest.raises(ValueError, match="no"):
        catalogue.uws.amend(job.id, fail)
    row = job_row(catalogue, job.id)
    assert row.parameters == job.parameters, "a change that fails changes nothing"
    assert job_row(catalogue, job.id).phase == Phase.PENDING and not Phase.PENDING.ended
    assert catalogue.jobs.claim(job.id, "me") is None
    assert catalogue.jobs.unsubmitted(0.0) == [] and catalogue.jobs.give_up_silent(0.0, 3) == []
    assert drafted(catalogue).id != job.id, "two may be set up alike"
    assert catalogue.jobs.submit("psf-build", {"instrument": "hri_euv"}, "k", DEFAULT_OWNER)[1], (
        "equal requests do not share it"
    )


def test_each_phase_after_pending(catalogue: Catalogue) -> None:
    job = drafted(catalogue)
    assert catalogue.uws.amend(job.id, lambda given: given | {"size": "64"})
    assert not catalogue.uws.start(job.id, job.parameters, {"size": 0}, "k"), "it was changed since"
    given = {"instrument": "hri_euv", "size": "64"}
    assert catalogue.uws.start(job.id, given, {"instrument": "hri_euv", "size": 64}, "k")
    row = job_row(catalogue, job.id)
    assert (row.phase, row.parameters["size"], row.request_key) == (Phase.QUEUED, 64, "k")
    assert not catalogue.uws.start(job.id, row.parameters, {}, "k")
    assert not catalogue.uws.amend(job.id, lambda given: {})
    assert [job_id for job_id, _ in catalogue.jobs.unsubmitted(0.0)] == [job.id]
    assert catalogue.jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)[0].id != job.id, (
        "its client may destroy or limit it: an equal request does not share that end"
    )
    lease = claimed(catalogue, job.id, "me")
    assert not catalogue.uws.start(job.id, row.parameters, {}, "k")
    assert catalogue.jobs.complete(lease, "r")
    assert not catalogue.uws.start(job.id, row.parameters, {}, "k")
    assert job_row(catalogue, job.id).phase == Phase.COMPLETED

    dropped = drafted(catalogue)
    catalogue.jobs.cancel(dropped.id)
    assert job_row(catalogue, dropped.id).phase == Phase.ABORTED
    assert not catalogue.uws.start(dropped.id, dropped.parameters, {}, "other")
    assert not catalogue.uws.amend(dropped.id, lambda given: {})


@BOTH
def test_one_of_many_starts_of_a_job_succeeds(catalogue: Catalogue) -> None:
    job = drafted(catalogue)
    with ThreadPoolExecutor(8) as pool:
        told = list(pool.map(lambda _: catalogue.uws.start(job.id, job.parameters, {}, "k"), range(16)))
    assert sum(told) == 1


def test_the_worker_of_a_destroyed_job_loses_its_lease(catalogue: Catalogue) -> None:
    job = drafted(catalogue, run_id="mine", destruction_at=time.time() + 60)
    assert catalogue.uws.start(job.id, job.parameters, {}, "k")
    lease = claimed(catalogue, job.id, "me")
    assert catalogue.uws.destroy(job.id) and not catalogue.uws.destroy(job.id)
    assert catalogue.jobs.get(job.id) is None and catalogue.uws.terms(job.id).run_id is None
    assert not catalogue.jobs.heartbeat(lease) and not catalogue.jobs.progress(lease, "s", 1, 2)
    assert not catalogue.jobs.complete(lease, "r") and not catalogue.jobs.abort(lease)
    catalogue.uws.set_terms(job.id, execution_duration_s=5)
    assert catalogue.uws.terms(job.id).execution_duration_s == 0, "a job that is gone gets no terms"
    assert catalogue.jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)[1], "an equal request is a new job"


@BOTH
def test_terms_end_jobs(catalogue: Catalogue) -> None:
    endless, slow, due, kept = (drafted(catalogue) for _ in range(4))
    catalogue.uws.set_terms(slow.id, execution_duration_s=1)
    catalogue.uws.set_terms(due.id, destruction_at=time.time() - 1)
    catalogue.uws.set_terms(kept.id, destruction_at=time.time() + 60)
    catalogue.uws.set_terms(kept.id, execution_duration_s=7)
    assert catalogue.uws.terms(kept.id).destruction_at is not None, "one term is changed, the others stay"
    leases = {}
    for job in (endless, slow):
        assert catalogue.uws.start(job.id, job.parameters, {}, job.id)
        leases[job.id] = catalogue.jobs.claim(job.id, "me")
    assert catalogue.uws.end_by_terms() == [due.id]
    assert catalogue.jobs.heartbeat(leases[slow.id])
    change(catalogue, update(JobRow).values(started_at=JobRow.started_at - 1.1))
    assert catalogue.uws.end_by_terms() == []
    assert not catalogue.jobs.heartbeat(leases[slow.id]) and catalogue.jobs.heartbeat(leases[endless.id])
    assert catalogue.jobs.abort(leases[slow.id]) and job_row(catalogue, slow.id).phase == Phase.ABORTED
    assert [line.id for line in catalogue.uws.lines(owner=DEFAULT_OWNER, last=9)] == [
        kept.id,
        slow.id,
        endless.id,
    ]
