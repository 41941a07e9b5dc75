"""Jobs that are set up before they start: PENDING and what follows, and the terms that end them."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from workers.catalogue import Catalogue, JobRow
from workers.contract import Phase


def drafted(catalogue: Catalogue, **terms: Any) -> JobRow:
    return catalogue.draft("psf-build", {"instrument": "hri_euv"}, **terms)


def phase(catalogue: Catalogue, job: JobRow) -> Phase:
    row = catalogue.job(job.id)
    assert row is not None
    return Phase(row.phase)


def test_a_pending_job_waits_to_be_told(catalogue: Catalogue) -> None:
    job = drafted(catalogue)
    assert phase(catalogue, job) == Phase.PENDING and not Phase.PENDING.ended
    assert catalogue.claim(job.id, "me") is None
    assert catalogue.unsubmitted(0.0) == [] and catalogue.give_up_silent(0.0, 3) == []
    assert drafted(catalogue).id != job.id, "two may be set up alike"
    assert catalogue.submit("psf-build", {"instrument": "hri_euv"}, "k")[1], "equal requests do not share it"


def test_each_phase_after_pending(catalogue: Catalogue) -> None:
    job = drafted(catalogue)
    assert catalogue.amend(job.id, lambda given: given | {"size": "64"})
    assert not catalogue.start(job.id, job.parameters, {"size": 0}, "k"), "it was changed since"
    given = {"instrument": "hri_euv", "size": "64"}
    assert catalogue.start(job.id, given, {"instrument": "hri_euv", "size": 64}, "k")
    row = catalogue.job(job.id)
    assert row is not None and (row.phase, row.parameters["size"], row.request_key) == (Phase.QUEUED, 64, "k")
    assert not catalogue.start(job.id, row.parameters, {}, "k")
    assert not catalogue.amend(job.id, lambda given: {})
    assert catalogue.unsubmitted(0.0) == [job.id]
    assert catalogue.submit("psf-build", {}, "k")[0].id == job.id, "now an equal request shares it"
    lease = catalogue.claim(job.id, "me")
    assert lease is not None and not catalogue.start(job.id, row.parameters, {}, "k")
    assert catalogue.complete(lease, "r")
    assert not catalogue.start(job.id, row.parameters, {}, "k")
    assert phase(catalogue, job) == Phase.COMPLETED

    dropped = drafted(catalogue)
    catalogue.cancel(dropped.id)
    assert phase(catalogue, dropped) == Phase.ABORTED
    assert not catalogue.start(dropped.id, dropped.parameters, {}, "other")
    assert not catalogue.amend(dropped.id, lambda given: {})


def test_of_many_that_start_a_job_one_does_and_equal_ones_all_run(catalogue: Catalogue) -> None:
    job = drafted(catalogue)
    with ThreadPoolExecutor(8) as pool:
        told = list(pool.map(lambda _: catalogue.start(job.id, job.parameters, {}, "k"), range(16)))
    assert sum(told) == 1
    others = [drafted(catalogue) for _ in range(6)]
    with ThreadPoolExecutor(6) as pool:
        told = list(pool.map(lambda other: catalogue.start(other.id, other.parameters, {}, "k"), others))
    assert all(told)
    assert all(catalogue.claim(other.id, "me") for other in others)
    assert len({row.request_key for row in catalogue.page(JobRow, limit=20)}) == 7


def test_a_change_that_fails_changes_nothing(catalogue: Catalogue) -> None:
    job = drafted(catalogue)

    def change(given: dict[str, Any]) -> dict[str, Any]:
        raise ValueError(given)

    with pytest.raises(ValueError):
        catalogue.amend(job.id, change)
    row = catalogue.job(job.id)
    assert row is not None and row.parameters == job.parameters


def test_a_destroyed_job_is_lost_to_its_worker(catalogue: Catalogue) -> None:
    job = drafted(catalogue, run_id="mine", destruction_at=time.time() + 60)
    assert catalogue.start(job.id, job.parameters, {}, "k")
    lease = catalogue.claim(job.id, "me")
    assert lease is not None
    assert catalogue.destroy(job.id) and not catalogue.destroy(job.id)
    assert catalogue.job(job.id) is None and catalogue.terms(job.id).run_id is None
    assert not catalogue.heartbeat(lease) and not catalogue.progress(lease, "s", 1, 2)
    assert not catalogue.complete(lease, "r") and not catalogue.abort(lease)
    catalogue.set_terms(job.id, execution_duration_s=5)
    assert catalogue.terms(job.id).execution_duration_s == 0, "a job that is gone gets no terms"
    assert catalogue.submit("psf-build", {}, "k")[1], "an equal request is a new job"


def test_terms_end_jobs(catalogue: Catalogue) -> None:
    endless, slow, due, kept = (drafted(catalogue) for _ in range(4))
    catalogue.set_terms(slow.id, execution_duration_s=1)
    catalogue.set_terms(due.id, destruction_at=time.time() - 1)
    catalogue.set_terms(kept.id, destruction_at=time.time() + 60)
    catalogue.set_terms(kept.id, execution_duration_s=7)
    assert catalogue.terms(kept.id).destruction_at is not None, "one term is changed, the others stay"
    leases = {}
    for job in (endless, slow):
        assert catalogue.start(job.id, job.parameters, {}, job.id)
        leases[job.id] = catalogue.claim(job.id, "me")
    assert catalogue.end_by_terms() == [due.id]
    assert catalogue.heartbeat(leases[slow.id])
    time.sleep(1.1)
    assert catalogue.end_by_terms() == []
    assert not catalogue.heartbeat(leases[slow.id]) and catalogue.heartbeat(leases[endless.id])
    assert catalogue.abort(leases[slow.id]) and phase(catalogue, slow) == Phase.ABORTED
    assert [line.id for line in catalogue.job_lines()] == [kept.id, slow.id, endless.id]
