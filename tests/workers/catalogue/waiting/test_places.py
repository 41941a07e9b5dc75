"""A job's place in the queue is the number of jobs that really start before it."""

from __future__ import annotations

import random

import pytest

from tests.workers.catalogue.waiting.test_turns import HERE, submitted
from tests.workers.jobs import job_row
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.waiting import places
from workers.contract.queues import Queue


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


def test_a_new_job_has_the_place_that_it_is_told_beforehand(catalogue: Catalogue) -> None:
    submitted(catalogue, "many", 5)
    submitted(catalogue, "urgent", 2)
    submitted(catalogue, "late", 3, Queue.BULK)
    for owner, queue in (("new", HERE), ("many", HERE), ("new", Queue.BULK), ("late", Queue.BULK)):
        told = catalogue.places.before_new(owner, queue)
        row, _ = catalogue.jobs.submit("psf-build", {}, f"{owner} {queue} new", owner, queue=queue)
        assert catalogue.places.before(row) == told
    assert catalogue.places.before_new("nobody", Queue.CROSSVAL) == 9, "the nine of the more urgent queue"


def test_only_a_waiting_job_has_a_place(catalogue: Catalogue) -> None:
    first, second = submitted(catalogue, "ann", 2)
    assert (before(catalogue, first), before(catalogue, second)) == (0, 1)
    assert catalogue.turns.claim_next(first, HERE, "w") is not None
    assert (before(catalogue, first), before(catalogue, second)) == (None, 0)


def test_no_more_than_the_limit_is_counted(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places, "MOST_COUNTED", 3)
    jobs = submitted(catalogue, "ann", 6)
    assert [before(catalogue, job) for job in jobs] == [0, 1, 2, 3, 3, 3]
    assert catalogue.places.before_new("bob", Queue.BULK) == 3
