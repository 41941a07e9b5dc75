"""Fit, cross-validation, report and gap of one transit: one inversion for all, and the results that each has alone."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from psfcore.fits.header import FitsLimits
from psfcore.fits.psfs import read_psf
from psfcore.scatter.inversion import invert
from service.local import LocalService
from tests.gap_files import quick_diagnosis
from tests.transit_files import write_simulated
from workers.settings import Settings
from workers.tasks.data import solutions

Results = dict[str, Any]
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def transit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_simulated(tmp_path_factory.mktemp("simulated") / "transit")


@pytest.fixture(scope="module")
def inversions() -> Iterator[list[str]]:
    """The shape of each inversion that a task made."""
    made: list[str] = []

    def counted(transit: Any, shape: Any, **how: Any) -> Any:
        made.append(shape.name)
        return invert(transit, shape, **how)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(solutions, "invert", counted)
        yield made


def run_all(service: LocalService, transit: Path, out: Path, inversions: list[str]) -> Results:
    """The results of all kinds of jobs on the transit, and the number of inversions after each."""
    out.mkdir()
    counts = []
    psf = service.fit_psf(transit, out / "psf.fits", report=out / "fit.json")
    counts.append(len(inversions))
    for scheme in ("shared", "exact"):
        service.cross_validate(transit, out / f"{scheme}.json", scheme=scheme, runs=1)
        counts.append(len(inversions))
    service.report(transit, out / "report.json", page=out / "report.html", dark_offsets=False)
    counts.append(len(inversions))
    with quick_diagnosis():
        service.diagnose_gap(transit, out / "gap.json", correct=False)
    counts.append(len(inversions))
    return {"folder": out, "psf_id": psf["id"], "counts": counts}


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LocalService]:
    folder = tmp_path_factory.mktemp("service") / "data"
    local = LocalService(Settings(data_dir=folder, database_url=None, broker_url="filesystem://"))
    yield local
    local.close()


@pytest.fixture(scope="module")
def together(
    service: LocalService, transit: Path, inversions: list[str], tmp_path_factory: pytest.TempPathFactory
) -> Results:
    before = len(inversions)
    results = run_all(service, transit, tmp_path_factory.mktemp("together") / "out", inversions)
    return results | {"counts": [n - before for n in results["counts"]]}


@pytest.fixture(scope="module")
def alone(transit: Path, inversions: list[str], tmp_path_factory: pytest.TempPathFactory) -> Results:
    """The same without kept solutions."""
    folder = tmp_path_factory.mktemp("alone")
    local = LocalService(Settings(data_dir=folder / "data", database_url=None, broker_url="filesystem://"))
    before = len(inversions)
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(solutions, "_kept", lambda *_: None)
        results = run_all(local, transit, folder / "out", inversions)
    local.close()
    return results | {"counts": [n - before for n in results["counts"]]}


def without_job(text: str) -> str:
    """A report without the ids of jobs, which differ."""
    return re.sub(r"[0-9a-f]{32}\b(?<![0-9a-f]{33})", "JOB", text)


def test_one_inversion_serves_all_jobs(together: Results, alone: Results) -> None:
    assert together["counts"] == [1, 1, 1, 1, 1]
    assert alone["counts"] == [1, 2, 3, 4, 5]


def test_all_results_are_the_same_bit_for_bit(together: Results, alone: Results) -> None:
    assert together["psf_id"] == alone["psf_id"]
    for name in ("fit.json", "shared.json", "exact.json", "report.json", "report.html", "gap.json"):
        one, other = (without_job((of["folder"] / name).read_text("utf-8")) for of in (together, alone))
        assert one == other, name
    limits = FitsLimits(max_pixels=2**24)
    one, other = (read_psf(of["folder"] / "psf.fits", limits) for of in (together, alone))
    assert one.kernel.tobytes() == other.kernel.tobytes()
    assert one.fitted == other.fitted
    assert one.components.keys() == other.components.keys()
    assert all(plane.tobytes() == other.components[name].tobytes() for name, plane in one.components.items())


def test_a_rerun_inverts_anew_and_finds_the_same_psf(
    service: LocalService, together: Results, inversions: list[str]
) -> None:
    before = len(inversions)
    made = service.get(service.wait(service.submit("rerun", of="psf", id=together["psf_id"]))["result"])
    assert len(inversions) == before + 1
    assert made["details"]["same"] is True


def test_another_shape_is_another_solution(
    service: LocalService, transit: Path, together: Results, inversions: list[str]
) -> None:
    before = len(inversions)
    service.cross_validate(transit, shape="stretched", runs=1)
    service.cross_validate(transit, shape="stretched", runs=1, seed=2)
    assert inversions[before:] == ["stretched"]
