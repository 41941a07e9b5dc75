"""Machines whose clocks are wrong: what they compare of each other's times goes by the database's clock."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from sqlalchemy import select, update

from tests.workers.databases import BOTH, change, database
from tests.workers.jobs import claimed, job_row
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.catalogue.tables import DEFAULT_OWNER, JobRow, PartRow, WorkerRow
from workers.contract.jobs import Phase

pytestmark = BOTH
OFF_S = (600.0, -600.0)
LEASE_S = 30.0
BACK_S = 3600.0
TRUE_TIME = time.time
# The times that the database's clock has written.
TIMES = (
    JobRow.heartbeat_at, JobRow.started_at, JobRow.submitted_at, PartRow.heartbeat_at, WorkerRow.heartbeat_at,
)  # fmt: skip


@contextmanager
def clock_off(by_s: float) -> Iterator[None]:
    """While it lasts, this is a machine whose clock is so far ahead."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(time, "time", lambda: TRUE_TIME() + by_s)
        yield


def move_times(catalogue: Catalogue, by_s: float) -> None:
    """Move all written times: back, as if so much time had passed; or ahead, as if the database's clock were set
    back."""
    change(catalogue, *(update(one.class_).values({one.key: one + by_s}) for one in TIMES))


def started(catalogue: Catalogue, key: str = "k") -> tuple[str, Lease]:
    job, _ = catalogue.jobs.submit("psf-build", {}, key, DEFAULT_OWNER)
    lease = claimed(catalogue, job.id)
    return job.id, lease


@pytest.mark.parametrize("off_s", OFF_S)
def test_a_worker_keeps_its_lease_while_it_is_there_and_no_longer(catalogue: Catalogue, off_s: float) -> None:
    with clock_off(off_s):
        job_id, lease = started(catalogue)
        assert catalogue.jobs.give_up_silent(LEASE_S, 3) == []
    assert catalogue.jobs.give_up_silent(LEASE_S, 3) == [] and catalogue.census.count_silent(LEASE_S) == 0
    for write in (
        lambda: catalogue.jobs.heartbeat(lease),
        lambda: catalogue.jobs.progress(lease, "s", 1, 2),
    ):
        move_times(catalogue, 10.0 - LEASE_S)
        with clock_off(off_s):
            assert write()
        move_times(catalogue, 10.0 - LEASE_S)
        with clock_off(-off_s):  # of whoever looks
            assert catalogue.jobs.give_up_silent(LEASE_S, 3) == []
            assert catalogue.census.count_silent(LEASE_S) == 0
    with clock_off(off_s):
        assert catalogue.jobs.complete(lease, "r")
    ended = job_row(catalogue, job_id)
    assert ended.started_at is not None and ended.ended_at is not None
    assert TRUE_TIME() - 120.0 < ended.started_at <= ended.ended_at < TRUE_TIME() + 1.0
    with clock_off(off_s):
        dead_id, lease = started(catalogue, "dead")
        assert catalogue.jobs.heartbeat(lease)
    move_times(catalogue, -2 * LEASE_S)
    with clock_off(-off_s):
        assert catalogue.census.count_silent(LEASE_S) == 1
        assert catalogue.jobs.give_up_silent(LEASE_S, 3) == [dead_id]
    assert job_row(catalogue, dead_id).phase == Phase.QUEUED


@pytest.mark.parametrize("off_s", OFF_S)
def test_messages_parts_and_workers_go_by_the_database_s_clock(catalogue: Catalogue, off_s: float) -> None:
    job, _ = catalogue.jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)
    catalogue.parts.open("o", "k", 1)
    with clock_off(off_s):
        catalogue.jobs.mark_submitted(job.id)
        part = catalogue.parts.take("o", "k", LEASE_S)
        assert part is not None
    with clock_off(12 * off_s):
        for _ in range(2):
            catalogue.census.announce("host:1", time.time(), "1")
    catalogue.census.announce("host:2", time.time(), "2")
    assert [worker.name for worker in catalogue.census.workers(LEASE_S)] == ["host:1", "host:2"]
    assert catalogue.jobs.unsubmitted(LEASE_S) == [], "the broker has it"
    assert catalogue.parts.take("o", "k", LEASE_S) is None, "somebody works on it"
    move_times(catalogue, 10.0 - LEASE_S)
    with clock_off(off_s):
        assert catalogue.parts.heartbeat(part)
    move_times(catalogue, 10.0 - LEASE_S)
    assert catalogue.parts.take("o", "k", LEASE_S) is None
    move_times(catalogue, -LEASE_S)
    assert [one for one, _ in catalogue.jobs.unsubmitted(LEASE_S)] == [job.id]
    assert catalogue.parts.take("o", "k", LEASE_S) is not None
    assert not catalogue.parts.heartbeat(part) and catalogue.census.workers(LEASE_S) == []


@pytest.mark.parametrize("off_s", OFF_S)
def test_a_job_executes_as_long_as_its_terms_say(catalogue: Catalogue, off_s: float) -> None:
    draft = catalogue.uws.draft("psf-build", {}, owner=DEFAULT_OWNER, execution_duration_s=60)
    assert catalogue.uws.start(draft.id, {}, {}, "k")
    with clock_off(off_s):
        assert catalogue.jobs.claim(draft.id, "w") is not None
    for passed_s, cancelled in ((50.0, False), (20.0, True)):
        move_times(catalogue, -passed_s)
        with clock_off(off_s):
            catalogue.uws.end_by_terms()
        assert job_row(catalogue, draft.id).cancel_requested is cancelled


def test_the_database_s_clock_goes_on_within_a_transaction_of_many_statements(catalogue: Catalogue) -> None:
    now = database(catalogue).now
    with database(catalogue).reading() as session:
        first = session.scalars(select(now)).one()
        time.sleep(0.05)
        second = session.scalars(select(now)).one()
    assert 0.03 < second - first < 10.0 and abs(second - TRUE_TIME()) < 5.0


def test_what_is_lost_is_given_up_after_the_clock_was_set_back(catalogue: Catalogue) -> None:
    job_id, _ = started(catalogue)
    catalogue.parts.open("o", "k", 1)
    assert catalogue.parts.take("o", "k", LEASE_S) is not None
    catalogue.census.announce("gone", TRUE_TIME(), "1")
    move_times(catalogue, BACK_S)
    catalogue.census.announce("here", TRUE_TIME(), "1")
    assert [worker.name for worker in catalogue.census.workers(LEASE_S)] == ["here"]
    assert catalogue.census.count_silent(LEASE_S) == 1
    assert catalogue.jobs.give_up_silent(LEASE_S, 3) == [], "it has another lease to give a sign of life"
    assert catalogue.parts.take("o", "k", LEASE_S) is None
    move_times(catalogue, -2 * LEASE_S)
    assert catalogue.jobs.give_up_silent(LEASE_S, 3) == [job_id]
    assert catalogue.parts.take("o", "k", LEASE_S) is not None


def test_a_running_job_survives_a_clock_that_is_set_back(catalogue: Catalogue) -> None:
    job_id, lease = started(catalogue)
    waiting, _ = catalogue.jobs.submit("psf-build", {}, "waiting", DEFAULT_OWNER)
    catalogue.jobs.mark_submitted(waiting.id)
    move_times(catalogue, BACK_S)
    assert [one for one, _ in catalogue.jobs.unsubmitted(LEASE_S)] == [waiting.id]
    catalogue.jobs.mark_submitted(waiting.id)
    assert catalogue.jobs.unsubmitted(LEASE_S) == [], "once"
    assert catalogue.jobs.give_up_silent(LEASE_S, 3) == []
    assert catalogue.jobs.heartbeat(lease)
    assert catalogue.jobs.give_up_silent(LEASE_S, 3) == [] and catalogue.census.count_silent(LEASE_S) == 0
    job = job_row(catalogue, job_id)
    assert job.phase == Phase.EXECUTING and job.started_at is not None
    assert job.started_at < TRUE_TIME() + 5.0, "its time limit counts from now"
