"""The job kind report: from an archive of a transit to a report as JSON, page and picture; and a PSF that is given."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from psfcore.psf import REACH_GRID_PX
from psfcore.simulate.scatter_truth import total_kernel
from service.client.http import ServiceError
from service.local import LocalService
from tests.html_page import check_stands_alone, read_page
from tests.transit_files import TRUTH, diffraction, write_simulated
from workers.catalogue.tables import DEFAULT_OWNER, ReportRow
from workers.contract.identities import report_identity
from workers.contract.requests import Report
from workers.contract.resolved import ResolvedReport
from workers.settings import Settings
from workers.tasks import report as report_task


@pytest.fixture(scope="module")
def transit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine bright images of 128 px."""
    return write_simulated(tmp_path_factory.mktemp("simulated") / "transit")


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LocalService]:
    folder = tmp_path_factory.mktemp("service")
    local = LocalService(Settings(data_dir=folder / "data", database_url=None, broker_url="filesystem://"))
    yield local
    local.close()


@pytest.fixture(scope="module")
def true_psf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("psf") / "true.fits"
    fits.PrimaryHDU(total_kernel(TRUTH, diffraction(), REACH_GRID_PX)).writeto(path)
    return path


@pytest.fixture(scope="module")
def made(service: LocalService, transit: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """One report of a fit, without the slow dark offsets, and all of its files."""
    out = tmp_path_factory.mktemp("made")
    row = service.report(
        transit, out / "r.json", page=out / "r.html", preview=out / "r.png", seed=3, dark_offsets=False
    )
    return {"row": row, "json": json.loads((out / "r.json").read_text()), "folder": out}


def test_the_report_says_what_was_found_and_what_it_was_made_of(made: dict[str, Any], transit: Path) -> None:
    row, report = made["row"], made["json"]
    assert row["kind"] == "report" and row["html"] == f"/v1/reports/{row['id']}/page"
    assert row["details"]["sentence"] == report["sentence"] and row["details"]["held_out"] is True
    assert report["schema"] == "psf-report/1" and report["seed"] == 3
    assert set(report["inputs"]["sha256"]) >= {"000.fits", "008.fits", "diffraction.fits", "transit.json"}
    assert report["provenance"]["parameters"]["dark_offsets"] is False
    assert {"numpy", "scipy", "numba", "astropy"} <= set(report["provenance"]["libraries"])
    found = report["fit"]["parameters"]["total"]
    assert abs(found["value"] - TRUTH.total) < 4 * found["sigma"]


def test_a_comparison_of_shapes_starts_from_the_fit_and_its_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[object, int]] = []

    def compare(solution: object, *, seed: int, progress: object) -> Any:
        asked.append((solution, seed))
        return SimpleNamespace(to_json=lambda: {"shapes": "compared"})

    monkeypatch.setattr(report_task, "compare_shapes_by_errors", compare)
    request = ResolvedReport(transit_id="0" * 64, shapes=True, seed=7)
    context: Any = SimpleNamespace(report=lambda stage, step, steps: None)
    made: Any = SimpleNamespace(fit=SimpleNamespace(solution="the fit"))
    assert report_task._shapes(context, request, made) == {"shapes": "compared"}
    assert asked == [("the fit", 7)]


def test_its_page_stands_alone_and_shows_every_image(made: dict[str, Any]) -> None:
    html = (made["folder"] / "r.html").read_text("utf-8")
    check_stands_alone(html)
    cells = {t.text for t in read_page(html) if t.name == "td"}
    assert {f["file"] for f in made["json"]["evaluation"]["frames"]} <= cells
    assert set(made["json"]["inputs"]["sha256"].values()) <= cells
    assert "Not shown: the effect of wrong dark levels, because it was not requested" in html
    assert (made["folder"] / "r.png").read_bytes().startswith(b"\x89PNG")


def test_an_identical_request_gets_the_existing_report(
    service: LocalService, made: dict[str, Any], transit: Path
) -> None:
    again = service.report(transit, seed=3, dark_offsets=False)
    assert again["id"] == made["row"]["id"] and again["created_at"] == made["row"]["created_at"]


def test_a_given_psf_is_evaluated_without_a_fit(
    service: LocalService, transit: Path, true_psf: Path, tmp_path: Path
) -> None:
    psf_id = service.upload_psf(true_psf)["id"]
    row = service.report(transit, tmp_path / "r.json", page=tmp_path / "r.html", psf_id=psf_id)
    report = json.loads((tmp_path / "r.json").read_text())
    assert "fit" not in report and report["psf"]["given"] and row["details"]["psf_id"] == psf_id
    whole = report["evaluation"]["all"]
    assert abs(whole["mean_pct"]) < 4 * whole["mean_noise_pct"]
    assert any("no fit was made" in missing["why"] for missing in report["not_shown"])
    check_stands_alone((tmp_path / "r.html").read_text("utf-8"))
    # Dark offsets are of fits: asking for them or not is the same request here.
    again = service.report(transit, psf_id=psf_id, dark_offsets=False)
    assert again["created_at"] == row["created_at"]


@pytest.mark.slow
def test_a_given_psf_needs_no_diffraction(
    service: LocalService, transit: Path, true_psf: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "t"
    shutil.copytree(transit, folder)
    manifest = json.loads((folder / "transit.json").read_text())
    (folder / "transit.json").write_text(json.dumps(manifest | {"known_psf": None, "instrument": None}))
    psf_id = service.upload_psf(true_psf)["id"]
    with_it = service.report(transit, psf_id=psf_id)
    without = service.report(folder, psf_id=psf_id)
    assert without["details"]["residuals"] == pytest.approx(with_it["details"]["residuals"])
    with pytest.raises(Exception) as caught:
        service.report(folder)
    assert getattr(caught.value, "code", None) == "no-known-psf"


def test_invalid_requests_are_refused(service: LocalService, transit: Path, tmp_path: Path) -> None:
    with pytest.raises(Exception) as caught:
        service.report(transit, psf_id="0" * 64)
    assert getattr(caught.value, "code", None) == "no-such-psf"
    with pytest.raises(ServiceError, match="seed"):
        service.report(transit, seed=-1)
    # A PSF file whose scale is not that of the images.
    kernel = np.zeros((33, 33))
    kernel[16, 16] = 1.0
    header = fits.Header({"CDELT1": 5.0, "CDELT2": 5.0, "CUNIT1": "arcsec", "CUNIT2": "arcsec"})
    fits.PrimaryHDU(kernel, header).writeto(tmp_path / "coarse.fits")
    with pytest.raises(ServiceError) as refused:
        service.report(transit, psf_id=service.upload_psf(tmp_path / "coarse.fits")["id"])
    assert refused.value.code == "plate-scale-mismatch"


def test_reports_of_other_parameters_are_other_reports() -> None:
    first = ResolvedReport(transit_id="a" * 64)
    others = (
        {"seed": 2},
        {"psf_id": "b" * 64},
        {"dark_offsets": False},
        {"saturation_dn": 9.0},
        {"noise": {"photon_gain_dn": 1.0, "read_noise_dn": 2.0}},
        {"transit_id": "c" * 64},
    )
    identities = {report_identity(ResolvedReport(**({"transit_id": "a" * 64} | other))) for other in others}
    assert len(identities | {report_identity(first)}) == len(others) + 1
    assert Report(transit_id="a" * 64).dark_offsets


def test_the_row_is_in_the_catalogue_once(service: LocalService, made: dict[str, Any]) -> None:
    rows = service._catalogue.page(
        ReportRow, owner=DEFAULT_OWNER, limit=100, transit_id=made["row"]["transit_id"]
    )
    assert [row.id for row in rows].count(made["row"]["id"]) == 1
