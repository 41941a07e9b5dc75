"""The job cross-validate: shared and exact folds, folds as parts in the catalogue, workers that are lost."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from service.local import LocalService
from tests.transit_files import write_simulated
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.parts import Part, Parts
from workers.contract.phases import Phase
from workers.run.runner import Runner
from workers.settings import Settings
from workers.tasks import crossval as crossval_task


@pytest.fixture(scope="module")
def transit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_simulated(tmp_path_factory.mktemp("simulated") / "transit")


@pytest.fixture(scope="module")
def settings(tmp_path_factory: pytest.TempPathFactory) -> Settings:
    folder = tmp_path_factory.mktemp("service") / "data"
    return Settings(
        data_dir=folder, database_url=None, broker_url="filesystem://", lease_s=2.0, heartbeat_s=0.3
    )


@pytest.fixture(scope="module")
def service(settings: Settings) -> Iterator[LocalService]:
    local = LocalService(settings)
    yield local
    local.close()


@pytest.fixture(scope="module")
def reports(service: LocalService, transit: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """One report of each scheme, of two runs of three folds."""
    out = tmp_path_factory.mktemp("reports")
    found = {}
    for scheme in ("shared", "exact"):
        row = service.cross_validate(
            transit, out / f"{scheme}.json", preview=out / f"{scheme}.png", scheme=scheme, runs=2
        )
        assert (out / f"{scheme}.png").read_bytes().startswith(b"\x89PNG")
        found[scheme] = json.loads((out / f"{scheme}.json").read_text()) | {"row": row}
    return found


def test_both_schemes_give_the_same_folds(reports: dict[str, Any]) -> None:
    shared, exact = reports["shared"]["folds"], reports["exact"]["folds"]
    assert [(f["run"], f["fold"]) for f in shared] == [(f["run"], f["fold"]) for f in exact]
    assert len(shared) == 6
    band = reports["exact"]["light_beyond_pct"]
    width = max(abs(a - b) for a, b in zip(band["plus_1_sigma"], band["minus_1_sigma"], strict=True))
    for one, other in zip(shared, exact, strict=True):
        # Second order in a fold's step: small beside the spread of the folds.
        assert one["curve_pct"] == pytest.approx(other["curve_pct"], abs=max(0.3 * width, 0.05))
        assert one["held_out_pct"].keys() == other["held_out_pct"].keys()


def test_every_image_is_held_out_once_a_run(reports: dict[str, Any]) -> None:
    for run in (0, 1):
        images = [n for f in reports["exact"]["folds"] if f["run"] == run for n in f["held_out_pct"]]
        assert sorted(map(int, images)) == list(range(9))


def test_the_report_says_what_was_done(reports: dict[str, Any]) -> None:
    for scheme, report in reports.items():
        assert report["scheme"] == scheme and report["row"]["kind"] == "cross-validation"
        assert report["row"]["details"]["sentence"] == report["sentence"]
        assert report["held_out"]["rms_pct"] >= abs(report["held_out"]["mean_pct"])
        assert len(report["totals"]) == 6 and report["inputs_sha256"]


def test_both_schemes_compare_with_a_fit_without_a_formula(reports: dict[str, Any]) -> None:
    for report in reports.values():
        shells = report["shells"]
        beyond = shells["diffuse_light_beyond_inner_edge_pct"]
        assert set(beyond) == {"free", "formula"} == set(shells["weight"])
        assert len(beyond["free"]["median"]) == len(shells["edges_px"]) - 1
        near = shells["excess_near_centre"]
        assert abs(near["points"]) < 3 * near["sigma"]  # the truth is a power law
        assert f"{near['points']:+.1f} ± {near['sigma']:.1f}" in report["sentence"]
        json.dumps(report["folds"][0]["shells"], allow_nan=False)


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Folds that take no time: these tests are about which worker does them."""

    def fold(solution: Any, draw: Any, **_: Any) -> crossval_task.FoldFit:
        curve = tuple(50.0 - k for k in range(7))
        held_out = dict.fromkeys(draw.held_out, 1.0)
        return crossval_task.FoldFit(draw.run, draw.fold, (1.0,), {"total": 0.4}, curve, held_out)

    monkeypatch.setattr(crossval_task, "exact_fit", fold)
    monkeypatch.setattr(crossval_task, "_solution", lambda *_: None)


def submit(service: LocalService, transit: Path, seed: int) -> str:
    transit_id = service.upload_transit(transit)["id"]
    job = service.submit("cross-validate", transit_id=transit_id, scheme="exact", runs=3, seed=seed)
    return str(job["id"])


def test_a_killed_worker_loses_no_fold_and_no_fold_counts_twice(
    service: LocalService, settings: Settings, transit: Path, quick: None, monkeypatch: pytest.MonkeyPatch
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
    job_id = submit(service, transit, seed=11)
    catalogue = Catalogue(settings.catalogue_url)
    runner = Runner(settings, catalogue, service._store)
    with pytest.raises(Killed):
        runner.run(job_id)
    threading.Event().wait(settings.lease_s + 0.2)
    assert catalogue.jobs.give_up_silent(settings.lease_s, settings.max_attempts) == [job_id]
    runner.run(job_id)
    row = catalogue.jobs.get(job_id)
    assert row is not None and row.phase == Phase.COMPLETED and row.attempt == 2
    finished = [fold for fold in done if fold != (-1, -1)]
    assert sorted(finished) == [(run, fold) for run in range(3) for fold in range(3)]  # each once
    catalogue.close()


def test_another_worker_shares_the_folds(
    service: LocalService, settings: Settings, transit: Path, quick: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    cheap = crossval_task.exact_fit
    by_thread: dict[str, list[tuple[int, int]]] = {}
    helping = threading.Event()

    def slow(solution: Any, draw: Any, **options: Any) -> Any:
        by_thread.setdefault(threading.current_thread().name, []).append((draw.run, draw.fold))
        helping.wait(10)
        threading.Event().wait(0.05)
        return cheap(solution, draw, **options)

    monkeypatch.setattr(crossval_task, "exact_fit", slow)
    helpers: list[threading.Thread] = []
    asked: list[int] = []

    def call_for_help(job_id: str, workers: int) -> None:
        asked.append(workers)

        def help_out() -> None:
            helping.set()
            Runner(settings, Catalogue(settings.catalogue_url), service._store).assist(job_id)

        helpers.append(threading.Thread(target=help_out, name="helper"))
        helpers[-1].start()

    job_id = submit(service, transit, seed=12)
    catalogue = Catalogue(settings.catalogue_url)
    Runner(settings, catalogue, service._store, call_for_help).run(job_id)
    helpers[0].join()
    row = catalogue.jobs.get(job_id)
    assert row is not None and row.phase == Phase.COMPLETED
    assert asked == [8] and "helper" in by_thread and len(by_thread) == 2
    assert sorted(fold for folds in by_thread.values() for fold in folds) == [
        (run, fold) for run in range(3) for fold in range(3)
    ]
    Runner(settings, catalogue, service._store).assist(job_id)  # too late: nothing to do
    catalogue.close()


def test_a_part_gets_one_result_from_several_workers(service: LocalService, settings: Settings) -> None:
    catalogue = Catalogue(settings.catalogue_url)  # with the tables that the local service made
    catalogue.parts.open("o", "k" * 64, 2)
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
    assert catalogue.parts.finish(Part("o", "k" * 64, 9, "x"), {}) is False
    catalogue.close()
