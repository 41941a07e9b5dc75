"""Whose waiting job comes next, and which place it has: owners take turns, and no job is lost or left without a
message."""

from __future__ import annotations

import random
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import update

from tests.workers.databases import BOTH, change
from tests.workers.jobs import job_row
from workers.catalogue import turns
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.catalogue.tables import JobRow
from workers.contract.jobs import Phase, Queue
from workers.files.store import Store
from workers.run.child import Stopping
from workers.run.runner import Runner
from workers.settings import Settings

HERE = Queue.INTERACTIVE


def submitted(catalogue: Catalogue, owner: str, count: int = 1, queue: Queue = HERE) -> list[str]:
    """The ids of new jobs of an owner, which the broker has received."""
    jobs = [
        catalogue.jobs.submit("psf-build", {}, f"{owner} {queue} {number}", owner, queue=queue)[0].id
        for number in range(count)
    ]
    catalogue.jobs.mark_submitted(*jobs)
    return jobs


def next_one(catalogue: Catalogue, told_id: str, queue: Queue = HERE) -> Lease | None:
    return catalogue.turns.claim_next(told_id, queue, "w")


def owner_of(catalogue: Catalogue, lease: Lease | None) -> str:
    assert lease is not None
    row = job_row(catalogue, lease.job_id)
    return row.owner


def served(catalogue: Catalogue, messages: list[str]) -> list[str]:
    """The owners whose jobs are started and completed one after the other, as these messages arrive."""
    owners = []
    for message in messages:
        lease = next_one(catalogue, message)
        owners.append(owner_of(catalogue, lease))
        assert lease is not None and catalogue.jobs.complete(lease, "r")
    return owners


def test_the_single_job_of_one_owner_comes_before_the_many_of_another(catalogue: Catalogue) -> None:
    messages = [*submitted(catalogue, "many", 10), *submitted(catalogue, "one")]
    assert served(catalogue, messages[:3]) == ["many", "one", "many"]


def test_an_owner_with_a_long_job_gets_its_turn_too(catalogue: Catalogue) -> None:
    (long,) = submitted(catalogue, "long")
    assert owner_of(catalogue, next_one(catalogue, long)) == "long"  # it runs until the end of the test
    many = submitted(catalogue, "many", 10)
    assert served(catalogue, many[:2]) == ["many", "many"]
    more = catalogue.jobs.submit("psf-build", {}, "more", "long")[0].id
    catalogue.jobs.mark_submitted(more)
    assert served(catalogue, many[2:4]) == ["long", "many"]


def test_each_job_is_started_once_and_the_oldest_of_an_owner_first(catalogue: Catalogue) -> None:
    jobs = {owner: submitted(catalogue, owner, 4) for owner in ("a", "b", "c")}
    messages = [job for owner in jobs.values() for job in owner]
    leases = [next_one(catalogue, message) for message in messages]
    started = [lease.job_id for lease in leases if lease is not None]
    assert Counter(started) == Counter(messages)
    for mine in jobs.values():
        assert [job for job in started if job in mine] == mine
    assert next_one(catalogue, messages[0]) is None, "a message that is delivered twice starts nothing"


@BOTH
def test_workers_that_ask_at_one_moment_start_different_jobs(catalogue: Catalogue) -> None:
    messages = [*submitted(catalogue, "many", 12), *submitted(catalogue, "one", 2)]
    with ThreadPoolExecutor(8) as pool:
        leases = list(pool.map(lambda message: next_one(catalogue, message), messages))
    started = [lease.job_id for lease in leases if lease is not None]
    assert Counter(started) == Counter(messages)


def test_the_queues_stay_apart(catalogue: Catalogue) -> None:
    (slow,) = submitted(catalogue, "one", queue=Queue.BULK)
    (quick,) = submitted(catalogue, "many")
    assert next_one(catalogue, slow, HERE) is not None, "a message of a queue starts a job of this queue"
    found = next_one(catalogue, slow, Queue.BULK)
    assert found is not None and found.job_id == slow != quick


def test_a_turn_counts_although_the_job_was_deleted(catalogue: Catalogue) -> None:
    many = submitted(catalogue, "many", 3)
    for message in many[:2]:
        lease = next_one(catalogue, message)
        assert lease is not None and catalogue.uws.destroy(lease.job_id)
    (one,) = submitted(catalogue, "one")
    assert served(catalogue, [many[2]]) == ["one"] and one


def test_a_job_that_was_handed_back_lets_the_owners_other_job_go_first(catalogue: Catalogue) -> None:
    """So two bulk runs of one owner take turns: each turn is handed back after a minute."""
    first, second = submitted(catalogue, "me", 2)
    lease = next_one(catalogue, first)
    assert lease is not None and lease.job_id == first and catalogue.jobs.hand_back(lease)
    catalogue.jobs.mark_submitted(first)
    again = next_one(catalogue, second)
    assert again is not None and again.job_id == second


def test_a_job_waits_after_a_temporary_failure_until_it_is_submitted_again(catalogue: Catalogue) -> None:
    failed, other = submitted(catalogue, "me", 2)
    lease = next_one(catalogue, failed)
    assert lease is not None and catalogue.jobs.requeue(lease)
    found = next_one(catalogue, other)
    assert found is not None and found.job_id == other
    (third,) = submitted(catalogue, "you")
    assert owner_of(catalogue, next_one(catalogue, third)) == "you"
    assert next_one(catalogue, third) is None, "messages of others do not shorten its wait"
    catalogue.jobs.mark_submitted(failed)
    again = next_one(catalogue, failed)
    assert again is not None and again.job_id == failed


def test_a_job_whose_message_comes_before_its_submission_is_recorded_starts(catalogue: Catalogue) -> None:
    job = catalogue.jobs.submit("psf-build", {}, "k", "me")[0].id
    assert next_one(catalogue, "0" * 32) is None
    lease = next_one(catalogue, job)
    assert lease is not None and lease.job_id == job


def test_a_job_that_waits_for_an_equal_one_gets_another_message(catalogue: Catalogue) -> None:
    (first,) = submitted(catalogue, "me")
    draft = catalogue.uws.draft("psf-build", {}, owner="me")
    assert catalogue.uws.start(draft.id, {}, {}, f"me {HERE} 0")
    catalogue.jobs.mark_submitted(draft.id)
    lease = next_one(catalogue, first)
    assert lease is not None
    assert next_one(catalogue, draft.id) is None
    assert catalogue.jobs.unsubmitted(3600.0) == [], "not while the equal job runs"
    assert catalogue.jobs.complete(lease, "r")
    assert [job_id for job_id, _ in catalogue.jobs.unsubmitted(3600.0)] == [draft.id]


def test_a_job_that_a_stopping_worker_leaves(catalogue: Catalogue, settings: Settings) -> None:
    jobs = submitted(catalogue, "me", 2)
    assert next_one(catalogue, jobs[1]) is not None
    stopping = Stopping()
    stopping.ask(60.0)
    runner = Runner(settings, catalogue, Store(settings.data_dir), stopping=stopping)
    runner.run_next(jobs[0], HERE)  # the message of the job that runs already
    assert [job_id for job_id, _ in catalogue.jobs.unsubmitted(3600.0)] == [jobs[1]]
    row = job_row(catalogue, jobs[1])
    assert row.phase == Phase.QUEUED


@BOTH
def test_turns_do_not_depend_on_the_database_s_clock(catalogue: Catalogue) -> None:
    """An owner who was served before the clock was set back does not wait until the clock has caught up."""
    for back_s in (0.0, 3600.0):
        a, b = (submitted(catalogue, f"{name} {back_s}", 5) for name in "ab")
        assert served(catalogue, [a[0]]) == [f"a {back_s}"]
        ended = update(JobRow).where(JobRow.phase == Phase.COMPLETED)
        change(catalogue, ended.values(started_at=JobRow.started_at + back_s))
        assert [owner[0] for owner in served(catalogue, [*b[:2], *a[1:3]])] == ["b", "a", "b", "a"]
        for job_id in (*a, *b):
            catalogue.jobs.cancel(job_id)


def before(catalogue: Catalogue, job_id: str) -> int | None:
    row = job_row(catalogue, job_id)
    return catalogue.places.before(row)


def started(catalogue: Catalogue, count: int) -> list[str]:
    """The jobs in the order in which workers start them, the most urgent queue first."""
    order: list[str] = []
    for queue in Queue:
        while len(order) < count:
            lease = catalogue.turns.claim_next("", queue, "w")
            if lease is None:
                break
            assert catalogue.jobs.complete(lease, "r")
            order.append(lease.job_id)
    return order


@pytest.mark.parametrize("seed", range(2))
def test_places_are_those_in_which_the_jobs_start(catalogue: Catalogue, seed: int) -> None:
    chance = random.Random(seed)
    # Some owners were served before, in some order.
    for owner in chance.sample(["a", "b", "c", "d"], 3):
        submitted(catalogue, owner)
        started(catalogue, 1)
    jobs = []
    for number in range(12):
        owner, queue = chance.choice("abcde"), chance.choice(list(Queue))
        row, _ = catalogue.jobs.submit("psf-build", {}, f"{seed} {number}", owner, queue=queue)
        jobs.append(row.id)
    catalogue.jobs.mark_submitted(*jobs)
    told = {job: before(catalogue, job) for job in jobs}
    order = started(catalogue, len(jobs))
    assert len(order) == 12 and told == {job: place for place, job in enumerate(order)}
    assert before(catalogue, order[0]) is None, "only a waiting job has a place"


def test_a_new_job_has_the_place_that_it_is_told_beforehand(catalogue: Catalogue) -> None:
    submitted(catalogue, "many", 5)
    submitted(catalogue, "urgent", 2)
    submitted(catalogue, "late", 3, Queue.BULK)
    for owner, queue in (("new", HERE), ("many", HERE), ("new", Queue.BULK), ("late", Queue.BULK)):
        told = catalogue.places.before_new(owner, queue)
        row, _ = catalogue.jobs.submit("psf-build", {}, f"{owner} {queue} new", owner, queue=queue)
        assert catalogue.places.before(row) == told
    assert catalogue.places.before_new("nobody", Queue.CROSSVAL) == 9, "the nine of the more urgent queue"


def test_no_more_than_the_limit_is_counted(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(turns, "MOST_COUNTED", 3)
    jobs = submitted(catalogue, "ann", 6)
    assert [before(catalogue, job) for job in jobs] == [0, 1, 2, 3, 3, 3]
    assert catalogue.places.before_new("bob", Queue.BULK) == 3
