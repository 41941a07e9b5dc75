"""Folds of a cross-validation as parts in the catalogue: which worker computes them, and workers that are lost."""

from __future__ import annotations

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from sqlalchemy import update

from tests.in_process import InProcess
from tests.transit_files import write_transit
from tests.workers.databases import change
from tests.workers.jobs import job_row, run_job
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Parts
from workers.catalogue.tables import JobRow, PartRow
from workers.contract.jobs import Phase
from workers.run.runner import Runner
from workers.tasks import catalogue_workspace
from workers.tasks import crossval as crossval_task

ALL = [(run, fold) for run in range(3) for fold in range(3)]
FRAMES = [SimpleNamespace(file=f"{n:03d}.fits", pointing=1 + n // 3) for n in range(9)]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Folds that take no time: these tests are about which worker does them."""

    def fold(solution: Any, draw: Any, **_: Any) -> crossval_task.FoldFit:
        curve = tuple(50.0 - k for k in range(7))
        held_out = dict.fromkeys(draw.held_out, 1.0)
        return crossval_task.FoldFit(draw.run, draw.fold, (1.0,), {"total": 0.4}, curve, held_out)

    monkeypatch.setattr(crossval_task, "exact_fit", fold)
    transit = SimpleNamespace(frames=FRAMES, sha256={})
    monkeypatch.setattr(crossval_task, "load_transit", lambda *_: (transit, None))
    solution = SimpleNamespace(transit=transit)
    monkeypatch.setattr(crossval_task, "solution_of", lambda *_, **__: solution)
    monkeypatch.setattr(catalogue_workspace, "WAIT_S", 0.01)


@pytest.fixture
def job_id(local: InProcess, tmp_path: Path) -> str:
    """A cross-validation of three runs of three folds that waits."""
    transit_id = local.upload_transit(write_transit(tmp_path / "transit"))["id"]
    return str(local.submit("cross-validate", transit_id=transit_id, scheme="exact", runs=3)["id"])


def test_a_killed_worker_loses_no_fold_and_no_fold_counts_twice(
    local: InProcess, job_id: str, quick: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[tuple[int, int]] = []
    cheap = crossval_task.exact_fit

    class Killed(BaseException):
        """What stops a process without its doing anything more."""

    def counted(solution: Any, draw: Any, **options: Any) -> Any:
        if len(done) == 4:
            done.append((-1, -1))
            raise Killed
        done.append((draw.run, draw.fold))
        return cheap(solution, draw, **options)

    monkeypatch.setattr(crossval_task, "exact_fit", counted)
    # A killed process gives nothing back: the fold stays taken until its lease is over.
    monkeypatch.setattr(Parts, "release", lambda self, part: None)
    runner = Runner(local.settings, local.catalogue, local.store)
    with pytest.raises(Killed):
        run_job(runner, local.catalogue, job_id)
    long_s = 2 * local.settings.lease_s
    for table in (JobRow, PartRow):
        change(local.catalogue, update(table).values(heartbeat_at=table.heartbeat_at - long_s))
    assert local.catalogue.jobs.give_up_silent(local.settings.lease_s, local.settings.max_attempts) == [
        job_id
    ]
    run_job(runner, local.catalogue, job_id)
    row = job_row(local.catalogue, job_id)
    assert (row.phase, row.attempt) == (Phase.COMPLETED, 2)
    assert sorted(fold for fold in done if fold != (-1, -1)) == ALL, "each once"


def test_another_worker_shares_the_folds(
    local: InProcess, job_id: str, quick: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    cheap = crossval_task.exact_fit
    by_thread: dict[str, list[tuple[int, int]]] = {}
    both_at_work = threading.Barrier(2, timeout=60)  # neither may do all folds before the other begins

    def slow(solution: Any, draw: Any, **options: Any) -> Any:
        name = threading.current_thread().name
        by_thread.setdefault(name, []).append((draw.run, draw.fold))
        if len(by_thread[name]) == 1:
            both_at_work.wait()
        return cheap(solution, draw, **options)

    monkeypatch.setattr(crossval_task, "exact_fit", slow)
    helpers: list[threading.Thread] = []
    calls: list[int] = []

    def call_for_help(job_id: str, workers: int) -> None:
        def help_out() -> None:
            Runner(local.settings, Catalogue(local.settings.catalogue_url), local.store).assist(job_id)

        calls.append(workers)
        helpers.append(threading.Thread(target=help_out, name="helper"))
        helpers[-1].start()

    runner = Runner(local.settings, local.catalogue, local.store, call_for_help)
    run_job(runner, local.catalogue, job_id)
    helpers[0].join()
    row = job_row(local.catalogue, job_id)
    assert row.phase == Phase.COMPLETED
    assert calls == [len(ALL) - 1] and len(by_thread) == 2
    assert sorted(fold for folds in by_thread.values() for fold in folds) == ALL
    Runner(local.settings, local.catalogue, local.store).assist(job_id)  # too late: nothing to do


def test_a_part_gets_one_result_from_several_workers(catalogue: Catalogue) -> None:
    for _ in range(2):
        catalogue.parts.open("o", "k" * 64, 2)
    first, second = (catalogue.parts.take("o", "k" * 64, 60.0) for _ in range(2))
    assert first is not None and second is not None and (first.number, second.number) == (0, 1)
    assert catalogue.parts.take("o", "k" * 64, 60.0) is None
    stolen = catalogue.parts.take("o", "k" * 64, -1.0)  # every lease is over
    assert stolen is not None and stolen.number == 0
    assert not catalogue.parts.heartbeat(first)
    catalogue.parts.release(first)
    assert catalogue.parts.heartbeat(stolen), "who lost a part gives nothing back"
    # Whoever is the first counts: a result follows from the request alone, and one that is there is there sooner.
    assert catalogue.parts.finish(first, {"a": 1})
    assert not catalogue.parts.finish(stolen, {"a": 2}) and not catalogue.parts.finish(first, {"a": 3})
    assert not catalogue.parts.heartbeat(stolen)
    catalogue.parts.release(stolen)
    assert catalogue.parts.take("o", "k" * 64, 60.0) is None, "it is done"
    catalogue.parts.release(second)
    again = catalogue.parts.take("o", "k" * 64, 60.0)
    assert again is not None and again.number == 1 and catalogue.parts.finish(again, {"a": 4})
    assert catalogue.parts.results("o", "k" * 64) == [{"a": 1}, {"a": 4}]
    assert catalogue.parts.finish(PartRow(owner="o", request_key="k" * 64, number=9, token="x"), {}) is False
