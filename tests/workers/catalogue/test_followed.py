"""What streams read of an owner's jobs and bulk runs, and that the database reads few rows for it."""

from __future__ import annotations

import time

import pytest
from sqlalchemy import insert, text

from tests.whole.many_rows import plan, statements
from tests.workers.databases import BOTH, change, database
from tests.workers.jobs import bulk_row
from workers.catalogue import followed
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.followed import Place
from workers.catalogue.tables import JobRow

ANY = "0" * 32


def job(number: int, owner: str = "ann", **values: object) -> dict[str, object]:
    key = f"{number:064x}"
    return {
        "id": f"{number:032x}", "owner": owner, "kind": "psf-build", "parameters": {}, "request_key": key, "work_key": key,
        "phase": "COMPLETED", "created_at": float(number), "ended_at": float(number), **values,
    }  # fmt: skip


def add_jobs(catalogue: Catalogue, *jobs: dict[str, object]) -> None:
    change(catalogue, *(insert(JobRow).values(**one) for one in jobs))


def test_rows_are_read_by_owner_phase_and_end(catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(followed, "MOST", 2)
    add_jobs(
        catalogue,
        *(job(number) for number in (1, 2, 3, 4)),
        *(job(number, phase="QUEUED", ended_at=None) for number in (5, 6, 7)),
        job(8, phase="EXECUTING", ended_at=None),
        job(9, "bob"),
        job(10, "bob", phase="EXECUTING", ended_at=None),
        job(11, kind="bulk", phase="EXECUTING", ended_at=None),
        job(12, phase="PENDING", ended_at=None),
    )
    jobs = catalogue.followed_jobs
    assert [int(one.id, 16) for one in jobs.open("ann")] == [8, 7, 6], "two of each phase, newest first"
    assert [int(one.id, 16) for one in jobs.ended("ann", Place(2.0))] == [2, 3]
    assert [int(one.id, 16) for one in jobs.ended("ann", Place(3.0, f"{3:032x}"))] == [4]
    asked = [f"{number:032x}" for number in (1, 9, 11, 12, 99)]
    assert sorted(int(one.id, 16) for one in jobs.among("ann", asked)) == [1, 12]
    assert jobs.among("ann", []) == [] and jobs.rows("ann", []) == {}
    found = jobs.rows("ann", asked)
    assert {one: state for one, (state, _) in found.items()} == {
        state.id: state for state in jobs.among("ann", asked)
    }
    assert jobs.now() == pytest.approx(time.time(), abs=5)


def test_open_bulk_runs_are_followed_also_when_paused(catalogue: Catalogue) -> None:
    ids = []
    for number in range(3):
        row = bulk_row("ann", str(number), created_at=float(number))
        ids.append(catalogue.bulks.create(row, ["a" * 64])[0].id)
    catalogue.bulks.pause(ids[0])
    catalogue.bulks.cancel(ids[1])
    bulks = catalogue.followed_bulks
    assert [one.id for one in bulks.open("ann")] == [ids[2], ids[0]] and bulks.open("bob") == []
    assert [one.id for one in bulks.ended("ann", Place(time.time() - 60))] == [ids[1]]


@BOTH
def test_every_query_uses_an_index_on_what_it_asks_for(catalogue: Catalogue) -> None:
    """With many ended jobs, and the statistics of PostgreSQL: no query reads all jobs of the owner."""
    with database(catalogue).engine.begin() as connection:
        connection.execute(insert(JobRow), [job(number) for number in range(2000)])
    with database(catalogue).engine.execution_options(isolation_level="AUTOCOMMIT").connect() as connection:
        connection.execute(text("ANALYZE"))
    jobs = catalogue.followed_jobs
    with statements() as sent:
        jobs.ended("ann", Place(1990.0)), jobs.open("ann"), jobs.among("ann", [ANY]), jobs.rows("ann", [ANY])
    plans = [
        "\n".join(plan(database(catalogue), *one, forced=False))
        for one in sent
        if one[0].startswith("SELECT")
    ]
    ended, executing, queued, among, read = plans
    assert "jobs_ended" in ended and "ended_at" in ended
    assert all("USING INDEX jobs_" in one or "Index Scan" in one for one in (executing, queued)), plans
    assert not any("SCAN jobs" in one or "Seq Scan" in one for one in plans), plans
    assert all("id" in one for one in (among, read))
