"""Machines whose clocks are wrong: what they compare of each other's times goes by the database's clock."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from sqlalchemy import select, update
from sqlalchemy.orm import InstrumentedAttribute

from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.catalogue.tables import DEFAULT_OWNER, JobRow, PartRow, WorkerRow
from workers.contract.phases import Phase
from workers.run import runner

OFF_S = [600.0, -600.0]
LEASE_S = 30.0
SOON_S = 0.3
TRUE_TIME = time.time


@contextmanager
def clock_off(by_s: float) -> Iterator[None]:
    """While it lasts, this is a machine whose clock is so far ahead."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(time, "time", lambda: TRUE_TIME() + by_s)
        yield


def started(catalogue: Catalogue) -> tuple[str, Lease]:
    job, _ = catalogue.jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)
    lease = catalogue.jobs.claim(job.id, "w")
    assert lease is not None
    return job.id, lease


def row(catalogue: Catalogue, job_id: str) -> JobRow:
    found = catalogue.jobs.get(job_id)
    assert found is not None
    return found


@pytest.mark.parametrize("off_s", OFF_S)
def test_a_worker_that_is_there_keeps_its_lease(catalogue: Catalogue, off_s: float) -> None:
    with clock_off(off_s):
        job_id, lease = started(catalogue)
        assert catalogue.jobs.give_up_silent(LEASE_S, 3) == []
    assert catalogue.jobs.give_up_silent(LEASE_S, 3) == [] and catalogue.census.count_silent(LEASE_S) == 0
    for write in (
        lambda: catalogue.jobs.heartbeat(lease),
        lambda: catalogue.jobs.progress(lease, "s", 1, 2),
    ):
        with clock_off(off_s):
            assert write()
        with clock_off(-off_s):  # of whoever looks
            assert catalogue.jobs.give_up_silent(LEASE_S, 3) == []
            assert catalogue.census.count_silent(LEASE_S) == 0
    with clock_off(off_s):
        assert catalogue.jobs.complete(lease, "r")
    ended = row(catalogue, job_id)
    assert ended.started_at is not None and ended.ended_at is not None
    assert TRUE_TIME() - 60.0 < ended.started_at <= ended.ended_at < TRUE_TIME() + 1.0


@pytest.mark.parametrize("off_s", OFF_S)
def test_a_dead_worker_s_job_is_taken_back_in_time(catalogue: Catalogue, off_s: float) -> None:
    with clock_off(off_s):
        job_id, lease = started(catalogue)
        assert catalogue.jobs.heartbeat(lease)
    time.sleep(SOON_S)
    with clock_off(-off_s):
        assert catalogue.census.count_silent(SOON_S / 2) == 1
        assert catalogue.jobs.give_up_silent(SOON_S / 2, 3) == [job_id]
    assert row(catalogue, job_id).phase == Phase.QUEUED


@pytest.mark.parametrize("off_s", OFF_S)
def test_what_the_broker_has_is_neither_given_again_at_once_nor_forgotten(
    catalogue: Catalogue, off_s: float
) -> None:
    job, _ = catalogue.jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)
    with clock_off(off_s):
        catalogue.jobs.mark_submitted(job.id)
    assert catalogue.jobs.unsubmitted(LEASE_S) == []
    time.sleep(SOON_S)
    assert [one.id for one in catalogue.jobs.unsubmitted(SOON_S / 2)] == [job.id]


@pytest.mark.parametrize("off_s", OFF_S)
def test_a_part_stays_with_who_works_on_it_and_with_nobody_else(catalogue: Catalogue, off_s: float) -> None:
    catalogue.parts.open("o", "k", 1)
    with clock_off(off_s):
        part = catalogue.parts.take("o", "k", LEASE_S)
        assert part is not None
    assert catalogue.parts.take("o", "k", LEASE_S) is None
    with clock_off(off_s):
        assert catalogue.parts.heartbeat(part)
    assert catalogue.parts.take("o", "k", LEASE_S) is None
    time.sleep(SOON_S)
    assert catalogue.parts.take("o", "k", SOON_S / 2) is not None
    assert not catalogue.parts.heartbeat(part)


@pytest.mark.parametrize("off_s", [*OFF_S, 7200.0, -7200.0])
def test_workers_are_there_while_they_say_so(catalogue: Catalogue, off_s: float) -> None:
    with clock_off(off_s):
        for _ in range(2):
            catalogue.census.announce("host:1", time.time(), "1")
    catalogue.census.announce("host:2", time.time(), "2")
    assert [worker.name for worker in catalogue.census.workers(LEASE_S)] == ["host:1", "host:2"]
    time.sleep(SOON_S)
    assert catalogue.census.workers(SOON_S / 2) == []


@pytest.mark.parametrize("off_s", OFF_S)
def test_a_job_executes_as_long_as_its_terms_say(catalogue: Catalogue, off_s: float) -> None:
    draft = catalogue.uws.draft("psf-build", {}, owner=DEFAULT_OWNER, execution_duration_s=60)
    assert catalogue.uws.start(draft.id, {}, {}, "k")
    with clock_off(off_s):
        assert catalogue.jobs.claim(draft.id, "w") is not None
    catalogue.uws.end_by_terms()
    assert not row(catalogue, draft.id).cancel_requested
    catalogue.uws.set_terms(draft.id, execution_duration_s=1)
    time.sleep(1.1)
    with clock_off(off_s):
        catalogue.uws.end_by_terms()
    assert row(catalogue, draft.id).cancel_requested


def test_the_database_s_clock_goes_on_within_a_transaction_of_many_statements(catalogue: Catalogue) -> None:
    database = catalogue._database
    with database.reading() as session:
        first = session.scalars(select(database.now)).one()
        time.sleep(0.05)
        second = session.scalars(select(database.now)).one()
    assert 0.03 < second - first < 10.0 and abs(second - TRUE_TIME()) < 5.0


BACK_S = 3600.0


def clock_back(catalogue: Catalogue, *columns: InstrumentedAttribute[float | None]) -> None:
    """Set the database's clock back by an hour: the times that it wrote now lie in the future."""
    with catalogue._engine.begin() as connection:
        for column in columns:
            values = {column.key: column + BACK_S}
            connection.execute(update(column.class_).where(column.is_not(None)).values(values))


def test_a_lost_job_is_not_held_until_the_clock_has_caught_up(catalogue: Catalogue) -> None:
    job_id, _ = started(catalogue)
    clock_back(catalogue, JobRow.heartbeat_at, JobRow.started_at)
    assert catalogue.census.count_silent(LEASE_S) == 1
    assert catalogue.jobs.give_up_silent(SOON_S / 2, 3) == [], "it has another lease to give a sign of life"
    time.sleep(SOON_S)
    assert catalogue.jobs.give_up_silent(SOON_S / 2, 3) == [job_id]


def test_a_running_job_survives_a_clock_that_is_set_back(catalogue: Catalogue) -> None:
    job_id, lease = started(catalogue)
    clock_back(catalogue, JobRow.heartbeat_at, JobRow.started_at)
    assert catalogue.jobs.give_up_silent(LEASE_S, 3) == []
    assert catalogue.jobs.heartbeat(lease)
    assert catalogue.jobs.give_up_silent(LEASE_S, 3) == [] and catalogue.census.count_silent(LEASE_S) == 0
    found = row(catalogue, job_id)
    assert found.phase == Phase.EXECUTING and found.started_at is not None
    assert found.started_at < TRUE_TIME() + 5.0, "its time limit counts from now"


def test_a_message_that_was_lost_is_repeated_although_the_clock_was_set_back(catalogue: Catalogue) -> None:
    job, _ = catalogue.jobs.submit("psf-build", {}, "k", DEFAULT_OWNER)
    catalogue.jobs.mark_submitted(job.id)
    clock_back(catalogue, JobRow.submitted_at)
    assert [one.id for one in catalogue.jobs.unsubmitted(LEASE_S)] == [job.id]
    catalogue.jobs.mark_submitted(job.id)
    assert catalogue.jobs.unsubmitted(LEASE_S) == [], "once"


def test_a_worker_that_is_gone_does_not_count_until_the_clock_has_caught_up(catalogue: Catalogue) -> None:
    catalogue.census.announce("gone", TRUE_TIME(), "1")
    clock_back(catalogue, WorkerRow.heartbeat_at)
    catalogue.census.announce("here", TRUE_TIME(), "1")
    assert [worker.name for worker in catalogue.census.workers(LEASE_S)] == ["here"]


def test_a_part_of_a_lost_worker_is_not_held_until_the_clock_has_caught_up(catalogue: Catalogue) -> None:
    catalogue.parts.open("o", "k", 1)
    assert catalogue.parts.take("o", "k", LEASE_S) is not None
    clock_back(catalogue, PartRow.heartbeat_at)
    assert catalogue.parts.take("o", "k", SOON_S / 2) is None
    time.sleep(SOON_S)
    assert catalogue.parts.take("o", "k", SOON_S / 2) is not None


def test_workers_of_one_host_name_and_process_id_have_different_names(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As in containers: each has its own process ids, and may have the host name of another."""
    monkeypatch.setattr(os, "getpid", lambda: 1)
    monkeypatch.setattr("socket.gethostname", lambda: "worker")
    names = set()
    for _container in range(2):
        runner._name.cache_clear()
        names.add(runner.worker_name())
        assert runner.worker_name() in names, "one process keeps its name"
    assert len(names) == 2 and all(name.startswith("worker:1:") for name in names)
