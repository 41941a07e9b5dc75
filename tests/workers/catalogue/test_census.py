"""Counts of files and jobs, and stage times: sums over attempts; a failure to store them changes no job's outcome."""

from __future__ import annotations

import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from sqlalchemy import text

from psfcore.errors import DataError
from tests.workers.databases import BOTH, change
from tests.workers.jobs import Bench, claimed
from tests.workers.psf_examples import psf
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.census import FileTally
from workers.catalogue.tables import DEFAULT_OWNER, ImageRow
from workers.contract.jobs import Phase
from workers.stage_timer import Spent
from workers.tasks.context import Context


def test_the_counts_of_files_and_jobs(catalogue: Catalogue) -> None:
    for name in "ab":
        catalogue.add(ImageRow(owner="o", id=name, created_at=1.0, bytes=2**40, filename=None, summary={}))
    for name, origin in (("a", "built"), ("b", "uploaded"), ("c", "uploaded")):
        catalogue.add(psf(name, origin=origin, bytes=3))
    counts = set(catalogue.census.tally_files())
    assert FileTally("image", "uploaded", 2, 2**41) in counts
    assert {FileTally("psf", "built", 1, 3), FileTally("psf", "uploaded", 2, 6)} <= counts
    assert FileTally("transit", "uploaded", 0, 0) in counts
    assert catalogue.census.tally() == [] and catalogue.census.oldest_queued_at() is None
    job, _ = catalogue.jobs.submit("psf-build", {}, "a", DEFAULT_OWNER)
    catalogue.jobs.submit("deconvolve", {}, "b", DEFAULT_OWNER)
    lease = claimed(catalogue, job.id)
    assert catalogue.jobs.complete(lease, "r")
    (waiting, done) = sorted(catalogue.census.tally(), key=lambda tally: tally.kind)
    assert (waiting.phase, waiting.jobs, waiting.attempts, waiting.run_s) == (Phase.QUEUED, 1, 0, 0.0)
    assert (done.phase, done.jobs, done.attempts, done.retries) == (Phase.COMPLETED, 1, 1, 0)
    assert abs(catalogue.census.clock() - time.time()) < 1.0


@BOTH
def test_times_of_many_attempts_are_summed(catalogue: Catalogue) -> None:
    def add(_: int) -> None:
        for _ in range(10):
            catalogue.stage_times.add("deconvolve", {"b": Spent(0.5, 2), "a": Spent(0.25, 1)})

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(add, range(4)))
    catalogue.stage_times.add("bulk", {"a": Spent(1.0, 0)})
    catalogue.stage_times.add("bulk", {})
    assert catalogue.stage_times.all() == {
        ("bulk", "a"): Spent(1.0, 0),
        ("deconvolve", "a"): Spent(10.0, 40),
        ("deconvolve", "b"): Spent(20.0, 80),
    }


def fails(context: Context, _: Mapping[str, Any]) -> str:
    context.report("at work", 1, 2)
    raise DataError("bad", "no good")


def passing(context: Context, _: Mapping[str, Any]) -> str:
    context.report("at work", 1, 2)
    raise ConnectionError


def works(context: Context, _: Mapping[str, Any]) -> str:
    context.report("at work", 1, 2)
    return "result"


def test_the_stages_of_every_attempt_count_also_after_its_job_was_deleted(
    catalogue: Catalogue, bench: Bench
) -> None:
    for number, (task, phase) in enumerate(
        ((works, Phase.COMPLETED), (fails, Phase.ERROR), (passing, Phase.QUEUED)), 1
    ):
        job = bench.run(task)
        assert job.phase == phase
        catalogue.uws.destroy(job.id)
        assert catalogue.stage_times.all()["psf-build", "at work"].steps == number


def test_a_job_ends_normally_if_its_times_cannot_be_stored(
    catalogue: Catalogue, bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    change(catalogue, text("ALTER TABLE stage_times RENAME TO elsewhere"))
    job = bench.run(works)
    assert (job.phase, job.result_id) == (Phase.COMPLETED, "result")
    assert "could not keep its stage times" in caplog.text
