"""The phases of a job's row: who may change it, when, if the worker is lost, and jobs that make the same."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import pytest
from sqlalchemy import Double, literal_column, update

from service.views import share_of_time, time_left_s
from tests.workers.databases import BOTH, change, database
from tests.workers.jobs import claimed, job_row
from tests.workers.psf_examples import product
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.database import Database
from workers.catalogue.jobs import Lease
from workers.catalogue.tables import DEFAULT_OWNER, JobRow, ProductRow
from workers.contract.jobs import Fault, JobError, Phase

BROKEN = JobError(fault=Fault.INTERNAL, code="broken", message="broken")


def asked_for(catalogue: Catalogue, key: str = "k") -> tuple[JobRow, bool]:
    return catalogue.jobs.submit("psf-build", {"key": key}, key, DEFAULT_OWNER)


def submitted(catalogue: Catalogue, key: str = "k") -> JobRow:
    return asked_for(catalogue, key)[0]


def at_work(catalogue: Catalogue, key: str = "k") -> tuple[JobRow, Lease]:
    job = submitted(catalogue, key)
    return job, claimed(catalogue, job.id)


def test_an_equal_request_shares_a_live_job_and_no_failed_one(catalogue: Catalogue) -> None:
    job, lease = at_work(catalogue)
    second, new = asked_for(catalogue)
    assert second.id == job.id and not new
    assert catalogue.jobs.fail(lease, BROKEN)
    assert submitted(catalogue).id != job.id


@BOTH
def test_many_equal_requests_at_once_make_one_job(catalogue: Catalogue) -> None:
    made: set[str] = set()
    for jobs in (1, 2):
        with ThreadPoolExecutor(8) as pool:
            answers = list(pool.map(lambda _: catalogue.jobs.submit("psf-build", {}, "k", "o"), range(16)))
        assert len({row.id for row, _ in answers}) == sum(new for _, new in answers) == 1
        made.add(answers[0][0].id)
        assert len(made) == jobs, "a job that was told to stop is not shared"
        catalogue.jobs.claim(answers[0][0].id, "w")
        catalogue.jobs.cancel(answers[0][0].id)


@BOTH
def test_of_many_that_claim_one_succeeds(catalogue: Catalogue) -> None:
    job = submitted(catalogue)
    with ThreadPoolExecutor(8) as pool:
        leases = list(pool.map(lambda n: catalogue.jobs.claim(job.id, str(n)), range(16)))
    assert sum(lease is not None for lease in leases) == 1
    row = job_row(catalogue, job.id)
    assert row.attempt == 1


def test_a_lost_lease_changes_nothing(catalogue: Catalogue) -> None:
    job, lease = at_work(catalogue)
    stranger = Lease(job.id, "0" * 32)
    assert not catalogue.jobs.complete(stranger, "r")
    assert not catalogue.jobs.progress(stranger, "s", 1, 2)
    assert not catalogue.jobs.fail(stranger, BROKEN)
    assert not catalogue.jobs.requeue(stranger)
    assert job_row(catalogue, job.id).phase == Phase.EXECUTING
    assert catalogue.jobs.complete(lease, "r")
    assert not catalogue.jobs.fail(lease, BROKEN)
    assert job_row(catalogue, job.id).phase == Phase.COMPLETED


def test_cancelling_in_each_phase(catalogue: Catalogue) -> None:
    queued = submitted(catalogue, "a")
    catalogue.jobs.cancel(queued.id)
    assert job_row(catalogue, queued.id).phase == Phase.ABORTED
    assert catalogue.jobs.claim(queued.id, "me") is None

    running, lease = at_work(catalogue, "b")
    catalogue.jobs.cancel(running.id)
    assert job_row(catalogue, running.id).phase == Phase.EXECUTING
    assert not catalogue.jobs.heartbeat(lease)
    assert catalogue.jobs.abort(lease)
    assert job_row(catalogue, running.id).phase == Phase.ABORTED

    done, lease = at_work(catalogue, "c")
    catalogue.jobs.complete(lease, "r")
    catalogue.jobs.cancel(done.id)
    assert job_row(catalogue, done.id).phase == Phase.COMPLETED


@BOTH
def test_the_third_silent_worker_ends_a_job(catalogue: Catalogue, caplog: pytest.LogCaptureFixture) -> None:
    job, lease = at_work(catalogue)
    assert catalogue.jobs.give_up_silent(60, 3) == []
    for attempt in (1, 2):
        assert catalogue.jobs.give_up_silent(-1.0, 3) == [job.id], attempt
        assert not catalogue.jobs.complete(lease, "r"), "the silent worker came back and must not be heard"
        again = claimed(catalogue, job.id, "other")
        lease = again
    assert catalogue.jobs.give_up_silent(-1.0, 3) == []
    row = job_row(catalogue, job.id)
    assert row.phase == Phase.ERROR
    assert row.error is not None and row.error["code"] == "worker-lost"
    (line,) = [record for record in caplog.records if record.levelname == "ERROR"]
    assert job.id in line.getMessage() and "lost 3 times" in line.getMessage()


def test_a_product_is_kept_once_and_pages_hold_every_row_newest_first(catalogue: Catalogue) -> None:
    first, new = catalogue.add(product("0", "p"))
    second, again = catalogue.add(product("0", "p"))
    assert (new, again) == (True, False)
    assert first.created_at == second.created_at
    for n in range(1, 7):
        catalogue.add(product(str(n), "p", created_at=first.created_at))
    seen: list[str] = []
    after = None
    while page := catalogue.page(ProductRow, owner=DEFAULT_OWNER, limit=3, after=after):
        seen += [row.id for row in page]
        after = (page[-1].created_at, page[-1].id)
    assert len(seen) == len(set(seen)) == 7
    assert seen == sorted(seen, reverse=True)


def meanwhile(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch, transactions: int, act: Callable[[], object]
) -> None:
    """Have somebody act once that many of the transactions that follow are over."""
    writing = database(catalogue).writing
    left = transactions

    class Slow:
        def begin(self) -> object:
            nonlocal left
            left -= 1
            if left == -1:
                act()
            return writing.begin()

    monkeypatch.setattr(database(catalogue), "writing", Slow())


ENDS_OF_AN_ATTEMPT: dict[str, Callable[[Catalogue, Lease], object]] = {
    "passing failure": lambda catalogue, lease: catalogue.jobs.requeue(lease),
    "worker stops": lambda catalogue, lease: (
        catalogue.jobs.hand_back(lease) or catalogue.jobs.abort(lease)  # as the runner does
    ),
    "worker silent": lambda catalogue, lease: catalogue.jobs.give_up_silent(-1.0, 3),
}


def test_a_cancel_while_an_attempt_ends(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    for end, act in ENDS_OF_AN_ATTEMPT.items():
        for transactions in (0, 1):
            job, lease = at_work(catalogue, f"{end} {transactions}")
            with monkeypatch.context() as patched:
                meanwhile(catalogue, patched, transactions, partial(act, catalogue, lease))
                catalogue.jobs.cancel(job.id)
            if job_row(catalogue, job.id).phase == Phase.EXECUTING:  # the cancel was the first
                act(catalogue, lease)
            row = job_row(catalogue, job.id)
            assert row.phase == Phase.ABORTED, (end, transactions)
            assert row.ended_at is not None and row.cancel_requested and row.lease is None
    assert catalogue.jobs.unsubmitted(0.0) == [] and catalogue.jobs.claim(job.id, "other") is None


def test_a_cancel_while_workers_are_given_up(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    for transactions in (0, 1, 2):
        job, _ = at_work(catalogue, str(transactions))
        with monkeypatch.context() as patched:
            meanwhile(catalogue, patched, transactions, partial(catalogue.jobs.cancel, job.id))
            back = catalogue.jobs.give_up_silent(-1.0, 3)
        if job_row(catalogue, job.id).phase == Phase.QUEUED:
            assert back == [job.id] and transactions == 2, "nobody has cancelled it yet"
            catalogue.jobs.cancel(job.id)
        else:
            assert back == []
        assert job_row(catalogue, job.id).phase == Phase.ABORTED


def test_a_job_that_counts_several_times_is_told_by_its_estimated_time() -> None:
    row = JobRow(
        kind="gap-diagnose", phase="EXECUTING", started_at=1000.0, estimate={"seconds": 60.0}, step=3, steps=9
    )
    for now, share, left_s in ((1015.0, 0.25, 45.0), (1045.0, 0.75, 15.0), (1060.0, None, None)):
        assert (share_of_time(row, now), time_left_s(row, now)) == (share, left_s)
    row.steps = 0
    assert share_of_time(row, 1015.0) is None, "compiling"
    row.steps, row.estimate = 9, None
    assert share_of_time(row, 1015.0) is None and time_left_s(row, 1015.0) is None
    counted = JobRow(kind="psf-fit", phase="EXECUTING", started_at=1000.0, estimate={"seconds": 60.0})
    assert share_of_time(counted, 1015.0) is None


def test_each_count_of_steps_has_its_own_pace(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reading 5 images takes 250 s; then each of 11 steps takes 1 s."""
    now = [1000.0]
    monkeypatch.setattr(Database, "now", property(lambda _: literal_column(f"{now[0]!r}", Double)))
    _job, lease = at_work(catalogue)

    def left_s(stage: str, step: int, steps: int, at_s: float) -> float | None:
        now[0] = 1000.0 + at_s
        assert catalogue.jobs.progress(lease, stage, step, steps)
        row = job_row(catalogue, lease.job_id)
        return time_left_s(row, now[0])

    assert left_s("reading", 0, 5, 0.0) is None
    assert left_s("reading", 4, 5, 240.0) == pytest.approx(60.0)
    assert left_s("reading", 5, 5, 250.0) == 0.0
    assert left_s("fitting", 1, 11, 251.0) is None, "one report of a count has no pace"
    assert left_s("fitting", 2, 11, 252.0) == pytest.approx(9.0)
    assert left_s("errors", 5, 11, 255.0) == pytest.approx(6.0), "the same count goes on"
    assert left_s("errors", 1, 11, 256.0) is None, "a new count of as many steps"
    assert catalogue.jobs.hand_back(lease)
    assert catalogue.jobs.claim(lease.job_id, "other") is not None
    row = job_row(catalogue, lease.job_id)
    assert row.count_at is None and time_left_s(row, now[0]) is None


# Jobs that make the same: one is at work at a time --------------------------------------------------


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
    "fail": lambda catalogue, lease: catalogue.jobs.fail(lease, BROKEN),
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


def test_a_job_that_was_told_to_stop_is_not_shared(catalogue: Catalogue) -> None:
    doomed, lease = at_work(catalogue)
    for _ in range(2):  # the second cancel does not reach a third request
        catalogue.jobs.cancel(doomed.id)
        again, new = asked_for(catalogue)
        assert new and again.id != doomed.id and (again.phase, again.work_key) == (Phase.QUEUED, "k")
        doomed = again
    shared, new = asked_for(catalogue)
    assert shared.id == again.id and not new, "requests after it share the new one"
    assert claim(catalogue, again.id) is None and waiting(catalogue) == set(), "one is at work at a time"
    assert catalogue.jobs.abort(lease)
    assert job_row(catalogue, again.id).phase == Phase.QUEUED and waiting(catalogue) == {again.id}
    late, lease = at_work(catalogue, "late")
    catalogue.jobs.cancel(late.id)
    assert catalogue.jobs.complete(lease, "r"), "it was done before it could stop"
    shared, new = asked_for(catalogue, "late")
    assert shared.id == late.id and not new


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
