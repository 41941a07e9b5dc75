"""The phases of a job's row: who may change it, when, and what happens if the worker is lost."""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import Double, literal_column, update

from service.views.jobs import time_left_s
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.catalogue.tables import DEFAULT_OWNER, JobRow, ProductRow
from workers.contract.phases import Fault, JobError, Phase

BROKEN = JobError(fault=Fault.INTERNAL, code="broken", message="broken")


def submitted(catalogue: Catalogue, key: str = "k") -> JobRow:
    return catalogue.jobs.submit("psf-build", {"instrument": "hri_euv"}, key, DEFAULT_OWNER)[0]


def claimed(catalogue: Catalogue, key: str = "k") -> tuple[JobRow, Lease]:
    job = submitted(catalogue, key)
    lease = catalogue.jobs.claim(job.id, "me")
    assert lease is not None
    return job, lease


def phase(catalogue: Catalogue, job: JobRow) -> Phase:
    row = catalogue.jobs.get(job.id)
    assert row is not None
    return Phase(row.phase)


def test_an_equal_request_shares_the_live_job(catalogue: Catalogue) -> None:
    first, new = catalogue.jobs.submit("psf-build", {}, "same", DEFAULT_OWNER)
    second, again = catalogue.jobs.submit("psf-build", {}, "same", DEFAULT_OWNER)
    assert (new, again) == (True, False)
    assert first.id == second.id


def test_an_equal_request_after_a_failure_is_a_new_job(catalogue: Catalogue) -> None:
    job, lease = claimed(catalogue)
    assert catalogue.jobs.fail(lease, BROKEN)
    assert submitted(catalogue).id != job.id


def test_many_equal_requests_at_once_make_one_job(catalogue: Catalogue) -> None:
    with ThreadPoolExecutor(8) as pool:
        answers = list(
            pool.map(lambda _: catalogue.jobs.submit("psf-build", {}, "same", DEFAULT_OWNER), range(24))
        )
    assert len({row.id for row, _ in answers}) == 1
    assert sum(new for _, new in answers) == 1


def test_of_many_that_claim_one_succeeds(catalogue: Catalogue) -> None:
    job = submitted(catalogue)
    with ThreadPoolExecutor(8) as pool:
        leases = list(pool.map(lambda n: catalogue.jobs.claim(job.id, str(n)), range(24)))
    assert sum(lease is not None for lease in leases) == 1
    row = catalogue.jobs.get(job.id)
    assert row is not None and row.attempt == 1


def test_a_lost_lease_changes_nothing(catalogue: Catalogue) -> None:
    job, lease = claimed(catalogue)
    stranger = Lease(job.id, "0" * 32)
    assert not catalogue.jobs.complete(stranger, "r")
    assert not catalogue.jobs.progress(stranger, "s", 1, 2)
    assert not catalogue.jobs.fail(stranger, BROKEN)
    assert not catalogue.jobs.requeue(stranger)
    assert phase(catalogue, job) == Phase.EXECUTING
    assert catalogue.jobs.complete(lease, "r")
    assert not catalogue.jobs.fail(lease, BROKEN)
    assert phase(catalogue, job) == Phase.COMPLETED


def test_cancelling_in_each_phase(catalogue: Catalogue) -> None:
    queued = submitted(catalogue, "a")
    catalogue.jobs.cancel(queued.id)
    assert phase(catalogue, queued) == Phase.ABORTED
    assert catalogue.jobs.claim(queued.id, "me") is None

    running, lease = claimed(catalogue, "b")
    catalogue.jobs.cancel(running.id)
    assert phase(catalogue, running) == Phase.EXECUTING
    assert not catalogue.jobs.heartbeat(lease)
    assert catalogue.jobs.abort(lease)
    assert phase(catalogue, running) == Phase.ABORTED

    done, lease = claimed(catalogue, "c")
    catalogue.jobs.complete(lease, "r")
    catalogue.jobs.cancel(done.id)
    assert phase(catalogue, done) == Phase.COMPLETED


def test_a_silent_worker_loses_its_job_and_the_third_loss_ends_it(
    catalogue: Catalogue, caplog: pytest.LogCaptureFixture
) -> None:
    job, lease = claimed(catalogue)
    assert catalogue.jobs.give_up_silent(60, 3) == []
    for attempt in (1, 2):
        time.sleep(0.02)
        assert catalogue.jobs.give_up_silent(0.01, 3) == [job.id], attempt
        assert not catalogue.jobs.complete(lease, "r"), "the silent worker came back and must not be heard"
        again = catalogue.jobs.claim(job.id, "other")
        assert again is not None
        lease = again
    time.sleep(0.02)
    assert catalogue.jobs.give_up_silent(0.01, 3) == []
    row = catalogue.jobs.get(job.id)
    assert row is not None and row.phase == Phase.ERROR
    assert row.error is not None and row.error["code"] == "worker-lost"
    (said,) = [record for record in caplog.records if record.levelname == "ERROR"]
    assert f"job {job.id}: the worker was lost 3 times" in said.getMessage()


def test_a_silent_worker_of_a_cancelled_job_aborts_it(catalogue: Catalogue) -> None:
    job, _ = claimed(catalogue)
    catalogue.jobs.cancel(job.id)
    time.sleep(0.02)
    assert catalogue.jobs.give_up_silent(0.01, 3) == []
    assert phase(catalogue, job) == Phase.ABORTED


WAIT_S = (
    1000.0  # a test moves the recorded time back and does not wait, so that a slow machine changes nothing
)


def waiting(catalogue: Catalogue) -> list[str]:
    return [job.id for job in catalogue.jobs.unsubmitted(WAIT_S)]


def age(catalogue: Catalogue, job: JobRow) -> None:
    """Move the job's submission back by 1.1 waits."""
    earlier = update(JobRow).values(submitted_at=JobRow.submitted_at - 1.1 * WAIT_S)
    with catalogue._engine.begin() as connection:
        connection.execute(earlier.where(JobRow.id == job.id))


def test_a_lost_message_is_submitted_again_after_a_wait(catalogue: Catalogue) -> None:
    job = submitted(catalogue)
    assert waiting(catalogue) == [job.id]
    catalogue.jobs.mark_submitted(job.id)
    assert waiting(catalogue) == []
    age(catalogue, job)
    assert waiting(catalogue) == [job.id]
    catalogue.jobs.mark_submitted(job.id)
    age(catalogue, job)
    assert waiting(catalogue) == [], "the wait doubles"
    age(catalogue, job)
    assert waiting(catalogue) == [job.id]


def product(identity: str) -> ProductRow:
    digest = "0" * 64
    return ProductRow(
        owner="local",
        id=identity,
        created_at=time.time(),
        kind="deconvolved-image",
        image_id=digest,
        psf_id=digest,
        psf_version="1",
        file_sha256=digest,
        bytes=1,
        preview_sha256=digest,
        details={},
    )


def test_a_product_is_kept_once(catalogue: Catalogue) -> None:
    first, new = catalogue.add(product("a" * 64))
    second, again = catalogue.add(product("a" * 64))
    assert (new, again) == (True, False)
    assert first.created_at == second.created_at


def test_pages_hold_every_row_once_newest_first(catalogue: Catalogue) -> None:
    for n in range(7):
        catalogue.add(product(f"{n:064x}"))
    seen: list[str] = []
    after = None
    while rows := catalogue.page(ProductRow, owner=DEFAULT_OWNER, limit=3, after=after):
        seen += [row.id for row in rows]
        after = (rows[-1].created_at, rows[-1].id)
    assert len(seen) == len(set(seen)) == 7
    assert seen == sorted(seen, reverse=True)


def meanwhile(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch, transactions: int, act: Callable[[], object]
) -> None:
    """Have somebody act once that many of the transactions that follow are over."""
    writing = catalogue.jobs._database.writing
    left = transactions

    class Slow:
        def begin(self) -> object:
            nonlocal left
            left -= 1
            if left == -1:
                act()
            return writing.begin()

    monkeypatch.setattr(catalogue.jobs._database, "writing", Slow())


ENDS_OF_AN_ATTEMPT: dict[str, Callable[[Catalogue, Lease], object]] = {
    "passing failure": lambda catalogue, lease: catalogue.jobs.requeue(lease),
    "worker stops": lambda catalogue, lease: (
        catalogue.jobs.hand_back(lease) or catalogue.jobs.abort(lease)  # as the runner does
    ),
    "worker silent": lambda catalogue, lease: catalogue.jobs.give_up_silent(-1.0, 3),
}


@pytest.mark.parametrize("end", sorted(ENDS_OF_AN_ATTEMPT))
@pytest.mark.parametrize("transactions", [0, 1])
def test_a_cancel_is_not_lost_where_the_attempt_ends_meanwhile(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch, end: str, transactions: int
) -> None:
    job, lease = claimed(catalogue)
    with monkeypatch.context() as patched:
        meanwhile(catalogue, patched, transactions, lambda: ENDS_OF_AN_ATTEMPT[end](catalogue, lease))
        catalogue.jobs.cancel(job.id)
    if phase(catalogue, job) == Phase.EXECUTING:  # the cancel was the first
        ENDS_OF_AN_ATTEMPT[end](catalogue, lease)
    assert phase(catalogue, job) == Phase.ABORTED
    row = catalogue.jobs.get(job.id)
    assert row is not None and row.ended_at is not None and row.cancel_requested


@pytest.mark.parametrize("transactions", [0, 1, 2])
def test_a_cancel_is_not_lost_while_silent_workers_are_given_up(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch, transactions: int
) -> None:
    job, _ = claimed(catalogue)
    with monkeypatch.context() as patched:
        meanwhile(catalogue, patched, transactions, lambda: catalogue.jobs.cancel(job.id))
        back = catalogue.jobs.give_up_silent(-1.0, 3)
    if phase(catalogue, job) == Phase.QUEUED:
        assert back == [job.id] and transactions == 2, "nobody has cancelled it yet"
        catalogue.jobs.cancel(job.id)
    else:
        assert back == []
    assert phase(catalogue, job) == Phase.ABORTED


def test_a_cancelled_job_after_the_last_attempt_is_aborted(catalogue: Catalogue) -> None:
    job, _ = claimed(catalogue)
    catalogue.jobs.cancel(job.id)
    assert catalogue.jobs.give_up_silent(-1.0, 1) == []
    assert phase(catalogue, job) == Phase.ABORTED


def test_a_cancelled_job_is_not_tried_again_after_a_passing_failure(catalogue: Catalogue) -> None:
    job, lease = claimed(catalogue)
    catalogue.jobs.cancel(job.id)
    assert catalogue.jobs.requeue(lease), "the attempt's end is written"
    row = catalogue.jobs.get(job.id)
    assert row is not None and row.phase == Phase.ABORTED
    assert row.ended_at is not None and row.lease is None
    assert waiting(catalogue) == [] and catalogue.jobs.claim(job.id, "other") is None


def test_a_job_that_is_queued_again_has_not_ended(catalogue: Catalogue) -> None:
    job, lease = claimed(catalogue)
    assert catalogue.jobs.requeue(lease)
    row = catalogue.jobs.get(job.id)
    assert row is not None and (row.phase, row.ended_at, row.lease) == (Phase.QUEUED, None, None)


def test_the_beginning_of_each_count_of_steps_is_kept(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading 5 images takes 250 s; then each of 11 steps takes 1 s."""
    now = [1000.0]
    monkeypatch.setattr(
        type(catalogue.jobs._database), "now", property(lambda _: literal_column(f"{now[0]!r}", Double))
    )
    _job, lease = claimed(catalogue)

    def left_s(stage: str, step: int, steps: int, at_s: float) -> float | None:
        now[0] = 1000.0 + at_s
        assert catalogue.jobs.progress(lease, stage, step, steps)
        row = catalogue.jobs.get(lease.job_id)
        assert row is not None
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
    row = catalogue.jobs.get(lease.job_id)
    assert row is not None and row.count_at is None and time_left_s(row, now[0]) is None
