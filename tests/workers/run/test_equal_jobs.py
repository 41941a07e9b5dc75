"""Jobs that make the same: one is at work at a time, and what it made is what the others end with."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import update

from tests.workers.databases import BOTH, change
from tests.workers.jobs import job_row
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.catalogue.tables import DEFAULT_OWNER, JobRow
from workers.contract.jobs import Fault, JobError, Phase


def started(catalogue: Catalogue, key: str = "k", owner: str = DEFAULT_OWNER) -> str:
    """The id of a job of a UWS client's that was told to run."""
    draft = catalogue.uws.draft("psf-build", {}, owner=owner)
    assert catalogue.uws.start(draft.id, {}, {"key": key}, key)
    return draft.id


def claim(catalogue: Catalogue, job_id: str) -> Lease | None:
    return catalogue.jobs.claim(job_id, "w")


def waiting(catalogue: Catalogue) -> set[str]:
    return {job_id for job_id, _ in catalogue.jobs.unsubmitted(3600.0)}


@BOTH
def test_of_equal_jobs_that_are_claimed_at_one_moment_one_is_at_work(catalogue: Catalogue) -> None:
    for others in (started(catalogue, key="other"), started(catalogue, owner="somebody")):
        assert claim(catalogue, others) is not None
    jobs = [started(catalogue) for _ in range(8)]
    catalogue.jobs.mark_submitted(*jobs)
    with ThreadPoolExecutor(8) as pool:
        leases = list(pool.map(lambda job: claim(catalogue, job), jobs))
    assert sum(lease is not None for lease in leases) == 1
    phases = sorted(job_row(catalogue, job).phase for job in jobs)
    assert phases == [Phase.EXECUTING] + 7 * [Phase.QUEUED]
    assert waiting(catalogue) == set(), "none is given to the broker in vain"
    assert not catalogue.jobs.others_wait("bulk"), "and a bulk does not make way for them"
    assert catalogue.census.count_unsubmitted(-1.0) == 0, "nor does an operator have to look after them"
    assert all(
        job_row(catalogue, job).attempt == 0 for job, lease in zip(jobs, leases, strict=True) if not lease
    )


ENDS: dict[str, Callable[[Catalogue, Lease], object]] = {
    "complete": lambda catalogue, lease: catalogue.jobs.complete(lease, "r"),
    "fail": lambda catalogue, lease: catalogue.jobs.fail(lease, JobError(fault=Fault.INTERNAL, code="c", message="m")),
    "requeue": lambda catalogue, lease: catalogue.jobs.requeue(lease),
    "hand back": lambda catalogue, lease: catalogue.jobs.hand_back(lease),
    "destroy": lambda catalogue, lease: catalogue.uws.destroy(lease.job_id),
    "silent": lambda catalogue, lease: catalogue.jobs.give_up_silent(-1.0, 3) == [lease.job_id],
}  # fmt: skip


@BOTH
def test_once_it_is_no_longer_at_work_the_next_may_be(catalogue: Catalogue) -> None:
    for name, end in ENDS.items():
        first, second = started(catalogue, name), started(catalogue, name)
        catalogue.jobs.mark_submitted(first, second)
        lease = claim(catalogue, first)
        assert lease is not None and claim(catalogue, second) is None
        assert end(catalogue, lease), name
        assert second in waiting(catalogue)
        last = claim(catalogue, second)
        assert last is not None and catalogue.jobs.complete(last, "r"), name
        catalogue.jobs.cancel(first)


def asked_for(catalogue: Catalogue, key: str = "k") -> tuple[JobRow, bool]:
    return catalogue.jobs.submit("psf-build", {"key": key}, key, DEFAULT_OWNER)


def test_a_job_that_was_told_to_stop_is_not_shared(catalogue: Catalogue) -> None:
    doomed = asked_for(catalogue)[0].id
    lease = claim(catalogue, doomed)
    assert lease is not None
    catalogue.jobs.cancel(doomed)
    again, new = asked_for(catalogue)
    assert new and again.id != doomed and (again.phase, again.work_key) == (Phase.QUEUED, "k")
    shared, new = asked_for(catalogue)
    assert shared.id == again.id and not new, "requests after it share the new one"
    assert claim(catalogue, again.id) is None and waiting(catalogue) == set(), "one is at work at a time"
    assert catalogue.jobs.abort(lease)
    assert job_row(catalogue, again.id).phase == Phase.QUEUED and waiting(catalogue) == {again.id}
    assert claim(catalogue, again.id) is not None


def test_a_second_cancel_does_not_reach_a_third_request(catalogue: Catalogue) -> None:
    first = asked_for(catalogue)[0].id
    lease = claim(catalogue, first)
    assert lease is not None
    catalogue.jobs.cancel(first)
    second = asked_for(catalogue)[0].id
    catalogue.jobs.cancel(second)
    assert job_row(catalogue, second).phase == Phase.ABORTED
    third, new = asked_for(catalogue)
    assert new and third.phase == Phase.QUEUED
    late = asked_for(catalogue, "late")[0].id
    lease = claim(catalogue, late)
    assert lease is not None
    catalogue.jobs.cancel(late)
    assert catalogue.jobs.complete(lease, "r"), "it was done before it could stop"
    shared, new = asked_for(catalogue, "late")
    assert shared.id == late and not new


@pytest.mark.parametrize("end", ["too long", "destroyed"])
def test_a_job_that_ends_on_terms_is_not_shared(catalogue: Catalogue, end: str) -> None:
    limited = started(catalogue)
    other, new = asked_for(catalogue)
    assert new and other.id != limited and other.work_key == "k"
    assert asked_for(catalogue)[0].id == other.id
    lease = claim(catalogue, limited)
    assert lease is not None and claim(catalogue, other.id) is None
    if end == "too long":
        catalogue.uws.set_terms(limited, execution_duration_s=1)
        change(catalogue, update(JobRow).values(started_at=JobRow.started_at - 1.1))
        assert catalogue.uws.end_by_terms() == [] and catalogue.jobs.abort(lease)
    else:
        catalogue.uws.set_terms(limited, destruction_at=time.time() - 1)
        assert catalogue.uws.end_by_terms() == [limited]
    assert (
        job_row(catalogue, other.id).phase == Phase.QUEUED
        and not job_row(catalogue, other.id).cancel_requested
    )
    assert claim(catalogue, other.id) is not None
    given = asked_for(catalogue, "given")[0].id
    catalogue.uws.set_terms(given, execution_duration_s=1)
    later, new = asked_for(catalogue, "given")
    assert new and later.id != given and asked_for(catalogue, "given")[0].id == later.id
