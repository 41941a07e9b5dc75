"""Counts of files and jobs, stage times, and what streams read of an owner's jobs and bulk runs."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
from sqlalchemy import insert, text, update

from psfcore.errors import DataError
from tests.whole.many_rows import plan, statements
from tests.workers.databases import BOTH, change, database
from tests.workers.jobs import Bench, bulk_row, claimed
from tests.workers.psf_examples import psf
from workers.catalogue import changes
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.census import FileTally
from workers.catalogue.changes import Moment
from workers.catalogue.tables import DEFAULT_OWNER, ImageRow, JobRow
from workers.contract.jobs import Phase
from workers.stage_timer import StageTime
from workers.tasks.catalogue_workspace import CatalogueWorkspace


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
    assert abs(catalogue.clock() - time.time()) < 1.0


@BOTH
def test_times_of_many_attempts_are_summed(catalogue: Catalogue) -> None:
    def add(_: int) -> None:
        for _ in range(10):
            catalogue.stage_times.add("deconvolve", {"b": StageTime(0.5, 2), "a": StageTime(0.25, 1)})

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(add, range(4)))
    catalogue.stage_times.add("bulk", {"a": StageTime(1.0, 0)})
    catalogue.stage_times.add("bulk", {})
    assert catalogue.stage_times.all() == {
        ("bulk", "a"): StageTime(1.0, 0),
        ("deconvolve", "a"): StageTime(10.0, 40),
        ("deconvolve", "b"): StageTime(20.0, 80),
    }


def fails(context: CatalogueWorkspace, _: Mapping[str, Any]) -> str:
    context.report("at work", 1, 2)
    raise DataError("bad", "no good")


def passing(context: CatalogueWorkspace, _: Mapping[str, Any]) -> str:
    context.report("at work", 1, 2)
    raise ConnectionError


def works(context: CatalogueWorkspace, _: Mapping[str, Any]) -> str:
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


# What streams read ----------------------------------------------------------------------------------


ANY = "0" * 32


def job(number: int, owner: str = "ann", **values: object) -> dict[str, object]:
    key = f"{number:064x}"
    return {
        "id": f"{number:032x}",
        "owner": owner,
        "kind": "psf-build",
        "parameters": {},
        "request_key": key,
        "work_key": key,
        "phase": "COMPLETED",
        "created_at": float(number),
        "changed_at": float(number),
        **values,
    }


def add_jobs(catalogue: Catalogue, *jobs: dict[str, object]) -> None:
    change(catalogue, *(insert(JobRow).values(**one) for one in jobs))


def numbers(found: Sequence[Moment]) -> list[int]:
    return [int(identity, 16) for _, identity in found]


def test_rows_are_read_by_owner_phase_and_change(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(changes, "MOST", 2)
    add_jobs(
        catalogue,
        *(job(number) for number in (1, 2, 3, 4)),
        *(job(number, phase="QUEUED") for number in (5, 6, 7)),
        job(0, phase="EXECUTING"),
        job(9, "bob"),
        job(10, "bob", phase="EXECUTING"),
        job(11, kind="bulk", phase="EXECUTING"),
        job(12, phase="PENDING"),
    )
    jobs = catalogue.job_changes
    assert numbers(jobs.open("ann")) == [0, 7], "those at work, and then the newest"
    assert numbers(jobs.since("ann", (2.0, ""))) == [2, 3] and numbers(jobs.since("ann", (7.0, ""))) == [7]
    assert numbers(jobs.since("ann", (3.0, f"{3:032x}"))) == [4, 5]
    ids = [f"{number:032x}" for number in (1, 9, 12, 99)]
    assert sorted(numbers(jobs.among("ann", ids))) == [1, 12]
    assert jobs.among("ann", []) == [] == jobs.rows([])
    assert {row.id for row in jobs.rows(ids)} == set(ids[:3])


@BOTH
def test_every_change_that_a_reader_can_see_has_a_later_time(catalogue: Catalogue) -> None:
    """Also if the clock does not move, or was set back."""
    job, _ = catalogue.jobs.submit("psf-build", {}, "a", DEFAULT_OWNER)
    times = [job.changed_at]

    def changed() -> bool:
        times.append(catalogue.job_changes.among(DEFAULT_OWNER, [job.id])[0][0])
        return times[-1] > times[-2]

    assert times[0] == pytest.approx(catalogue.clock(), abs=5) and not changed()
    ahead = catalogue.clock() + 3600.0
    change(catalogue, update(JobRow).values(changed_at=ahead))
    assert changed()
    catalogue.jobs.mark_submitted(job.id)
    assert not changed()
    lease = claimed(catalogue, job.id)
    assert changed()
    catalogue.jobs.heartbeat(lease)
    assert not changed()
    catalogue.jobs.progress(lease, "building", 1, 2)
    assert changed() and times[-1] == pytest.approx(ahead, abs=1)


def test_open_bulk_runs_are_followed_also_when_paused(catalogue: Catalogue) -> None:
    ids = []
    for number in range(3):
        row = bulk_row("ann", str(number), created_at=float(number))
        ids.append(catalogue.bulks.create(row, ["a" * 64])[0].id)
    catalogue.bulks.pause(ids[0])
    catalogue.bulks.cancel(ids[1])
    bulks = catalogue.bulk_changes
    assert [one for _, one in bulks.open("ann")] == [ids[2], ids[0]] and bulks.open("bob") == []
    changed = [one for _, one in bulks.since("ann", (catalogue.clock() - 60, ""))]
    assert changed == [ids[2], ids[0], ids[1]]


@BOTH
def test_every_query_uses_an_index_on_what_it_asks_for(catalogue: Catalogue) -> None:
    """With many ended jobs, and the statistics of PostgreSQL: no query reads all jobs of the owner."""
    with database(catalogue).engine.begin() as connection:
        connection.execute(insert(JobRow), [job(number) for number in range(2000)])
    with database(catalogue).engine.execution_options(isolation_level="AUTOCOMMIT").connect() as connection:
        connection.execute(text("ANALYZE"))
    jobs = catalogue.job_changes
    with statements() as sent:
        jobs.since("ann", (1990.0, "")), jobs.open("ann"), jobs.among("ann", [ANY]), jobs.rows([ANY])
    plans = [
        "\n".join(plan(database(catalogue), *one, forced=False))
        for one in sent
        if one[0].startswith("SELECT")
    ]
    since, still_open, among, read = plans
    assert "jobs_changed" in since and "changed_at" in since
    assert "USING INDEX jobs_" in still_open or "Index Scan" in still_open, plans
    assert not any("SCAN jobs" in one or "Seq Scan" in one for one in plans), plans
    assert all("id" in one for one in (among, read))
