"""The jobs psf-fit, cross-validate and report on one transit: one inversion for all, and the files that each makes."""

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

from psfcore.fits.blocks import FitsLimits
from psfcore.fits.images import read_planes
from psfcore.fits.psfs import read_psf
from psfcore.psf import REACH_GRID_PX, cumulative_curve
from psfcore.scatter.validation.cross_validation import FoldFit
from psfcore.simulate.scatter_truth import total_kernel
from service.client.http import ServiceError
from tests.conftest import write_image
from tests.fitted_transit import copied_data, counted_inversions, fitted_transit
from tests.html_page import check_stands_alone, read_page
from tests.in_process import InProcess
from tests.transit_files import TRUTH, diffraction
from workers.tasks import crossval as crossval_task
from workers.tasks import report as report_task

LIMITS = FitsLimits(max_pixels=2**24)
FILES = {f"{k:03d}.fits" for k in range(9)}
LIBRARIES = {"numpy", "scipy", "numba", "astropy"}
PNG = b"\x89PNG"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the fit and of its first cross-validation."""
    return fitted_transit(tmp_path_factory)


@pytest.fixture(scope="module")
def transit(made: Path) -> Path:
    """Nine bright images of 128 px."""
    return made / "transit"


@pytest.fixture(scope="module")
def service(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[InProcess]:
    local = InProcess(copied_data(made, tmp_path_factory.mktemp("service") / "data"))
    yield local
    local.close()


@pytest.fixture(scope="module")
def inversions() -> Iterator[list[int]]:
    """The number of images of each transit that a task inverted after the fit."""
    images: list[int] = []
    with counted_inversions(images):
        yield images


@pytest.fixture(scope="module")
def fitted(made: Path) -> dict[str, Any]:
    """The fit, all of its files, the steps that its progress told, and what was inverted."""
    rows = json.loads((made / "made.json").read_text())
    return rows | {"report": json.loads((made / "psf.json").read_text()), "folder": made}


@pytest.fixture(scope="module")
def folds(
    service: InProcess,
    transit: Path,
    fitted: dict[str, Any],
    inversions: list[int],
    tmp_path_factory: pytest.TempPathFactory,
) -> dict[str, Any]:
    """A report of each scheme of cross-validation, of one run of three folds, with the same fits of the folds."""
    shared, file = fitted["folder"], tmp_path_factory.mktemp("folds") / "exact.json"
    picture = file.with_suffix(".png")
    fits = {
        (fold["run"], fold["fold"]): FoldFit.from_json(fold)
        for fold in json.loads((shared / "folds.json").read_text())["folds"]
    }
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(crossval_task, "exact_fit", lambda _, draw, **__: fits[draw.run, draw.fold])
        row = service.cross_validate(transit, file, preview=picture, scheme="exact", runs=1)
    assert picture.read_bytes().startswith(PNG) and (shared / "folds.png").read_bytes().startswith(PNG)
    return {
        "shared": json.loads((shared / "folds.json").read_text()) | {"row": fitted["folds"]},
        "exact": json.loads(file.read_text()) | {"row": row},
    }


@pytest.fixture(scope="module")
def report(
    service: InProcess, transit: Path, inversions: list[int], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Any]:
    """One report of a fit without the slow dark offsets, all of its files, and what the comparison of shapes was
    given."""
    out, given = tmp_path_factory.mktemp("report"), []

    def compare(solution: Any, *, seed: int, progress: object) -> Any:
        given.append((type(solution).__name__, seed))
        return SimpleNamespace(to_json=lambda: {"shapes": "compared"})

    files = {"page": out / "r.html", "preview": out / "r.png"}
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(report_task, "compare_shapes_by_errors", compare)
        row = service.report(transit, out / "r.json", **files, seed=3, dark_offsets=False, shapes=True)
    return {"row": row, "json": json.loads((out / "r.json").read_text()), "given": given, "folder": out}


def test_one_inversion_serves_all_jobs(
    fitted: dict[str, Any], folds: dict[str, Any], report: dict[str, Any], inversions: list[int]
) -> None:
    assert fitted["inversions"] == [len(FILES)] and inversions.count(len(FILES)) == 0


# The fit ----------------------------------------------------------------------------------------------


def test_the_curve_is_that_of_the_truth_within_its_errors(fitted: dict[str, Any]) -> None:
    psf = read_psf(fitted["folder"] / "psf.fits", LIMITS)
    assert psf.fitted is not None and psf.fitted.parameters == ("b_px", "c", "total")
    curve = fitted["report"]["curve"]
    radii, found = np.array(curve["radii_px"]), np.array(curve["light_beyond_pct"])
    assert cumulative_curve(psf.kernel, radii) == pytest.approx(found, abs=1e-3)
    truth = cumulative_curve(total_kernel(TRUTH, diffraction(), REACH_GRID_PX), radii)
    assert np.abs((found - truth) / np.array(curve["sigma"])).max() < 4
    assert np.abs(found - truth)[radii <= 50].max() < 2


def test_a_fit_with_terms_of_the_field_has_errors_and_a_test(
    service: InProcess, transit: Path, fitted: dict[str, Any], inversions: list[int], tmp_path: Path
) -> None:
    """The scatter of this transit is constant."""
    row = service.fit_psf(transit, tmp_path / "psf.fits", report=tmp_path / "psf.json", field=1)
    told, report = row["details"]["fit"]["field"], json.loads((tmp_path / "psf.json").read_text())
    assert row["id"] != fitted["psf"]["id"] and report["field"] == told
    assert set(told["parameters"]) == {"x", "y"} and 0 < told["p_value"] <= 1
    pulls = [one["value"] / one["sigma"] for one in told["parameters"].values()]
    assert max(map(abs, pulls)) < 4, "there is no change"
    psf = read_psf(tmp_path / "psf.fits", LIMITS)
    assert [(term.x_power, term.y_power) for term in psf.field_terms] == [(1, 0), (0, 1)]
    assert psf.place is not None and psf.place.detector == (128, 128)
    assert row["details"]["field"]["detector_px"] == [128, 128]


def test_the_product_says_what_it_was_made_of(fitted: dict[str, Any]) -> None:
    psf, report = fitted["psf"], fitted["report"]
    assert psf["origin"] == "fitted" and psf["report"] == f"/v1/psfs/{psf['id']}/report"
    assert set(report["inputs_sha256"]) >= {"000.fits", "008.fits", "diffraction.fits", "transit.json"}
    provenance = psf["details"]["provenance"]
    assert provenance["inputs_sha256"] == report["inputs_sha256"]
    assert provenance["parameters"]["shape"] == "softened-power-law"
    assert set(provenance["libraries"]) >= LIBRARIES
    assert {frame["file"] for frame in report["frames"]} | set(report["left_out"]) == FILES
    assert psf["details"]["fit"]["sentence"] == report["sentence"]
    with fits.open(fitted["folder"] / "psf.fits") as hdus:
        assert {"DIFFRACTION", "SCATTER", "PROFILE", "FIT"} <= {hdu.name for hdu in hdus}
    assert (fitted["folder"] / "psf.png").read_bytes().startswith(PNG)
    shares = [
        step / steps for stage, step, steps in fitted["steps"] if stage not in ("reading", "building the PSF")
    ]
    assert len(shares) > 3 and min(shares) >= 0 and max(shares) <= 1
    # The test of the fit shows that its progress increases. On a busy machine a step of the job comes after it now and
    # then.


def test_an_identical_request_gets_the_existing_result(
    service: InProcess, fitted: dict[str, Any], report: dict[str, Any], transit: Path
) -> None:
    again = service.fit_psf(transit)
    assert again["id"] == fitted["psf"]["id"] and again["created_at"] == fitted["psf"]["created_at"]
    again = service.report(transit, seed=3, dark_offsets=False, shapes=True)
    assert again["id"] == report["row"]["id"] and again["created_at"] == report["row"]["created_at"]


@pytest.mark.slow
def test_a_rerun_inverts_anew(service: InProcess, fitted: dict[str, Any], inversions: list[int]) -> None:
    before, psf_id = list(inversions), fitted["psf"]["id"]
    row = service.get(service.wait(service.submit("rerun", of="psf", id=psf_id))["result"])
    assert len(inversions) == len(before) + 1
    inversions[:] = before
    assert row["details"]["same"] is True, row["details"]["sentence"]
    assert service.get(f"/v1/psfs/{psf_id}")["created_at"] == fitted["psf"]["created_at"]


def test_a_product_has_the_error_of_its_psf(
    service: InProcess, fitted: dict[str, Any], tmp_path: Path
) -> None:
    image = tmp_path / "image.fits"
    write_image(image, shape=(64, 64), CDELT1=0.492, CDELT2=0.492, DETECTOR="HRI_EUV")
    options = {"psf_id": fitted["psf"]["id"], "noise": (6.0, 2.0), "error_draws": 4, "steps": 2}
    service.deconvolve(image, tmp_path / "o.fits", **options)
    planes = read_planes(tmp_path / "o.fits")
    assert planes["PSF_ERROR"].shape == planes["ERROR"].shape
    assert np.isfinite(planes["PSF_ERROR"]).all()
    assert 0 < np.median(planes["PSF_ERROR"]) < np.median(planes["ERROR"])


def changed(transit: Path, folder: Path, **changes: Any) -> Path:
    """A copy of a transit with other values in its transit.json."""
    shutil.copytree(transit, folder)
    manifest = json.loads((folder / "transit.json").read_text())
    (folder / "transit.json").write_text(json.dumps(manifest | changes))
    return folder


def test_a_transit_that_cannot_be_fitted(service: InProcess, transit: Path, tmp_path: Path) -> None:
    images = json.loads((transit / "transit.json").read_text())["images"]
    elsewhere = [image | {"x": 64.0, "y": 110.0} for image in images]
    with pytest.raises(ServiceError) as caught:
        service.fit_psf(changed(transit, tmp_path / "elsewhere", images=elsewhere))
    assert caught.value.code == "too-few-frames" and "(64, 110)" in str(caught.value)


@pytest.mark.slow
def test_a_transit_of_one_pointing_states_a_limit(service: InProcess, transit: Path, tmp_path: Path) -> None:
    images = json.loads((transit / "transit.json").read_text())["images"]
    two = [image for image in images if image["fov"] < 3]
    psf = service.fit_psf(changed(transit, tmp_path / "t", images=two))
    assert any(limit.startswith("with 2 pointings") for limit in psf["details"]["fit"]["limits"])


# Cross-validation -------------------------------------------------------------------------------------


def test_a_cross_validation_compares_with_a_fit_without_a_formula(folds: dict[str, Any]) -> None:
    assert folds["exact"]["folds"] == folds["shared"]["folds"]
    for scheme, report in folds.items():
        assert sorted(int(n) for fold in report["folds"] for n in fold["held_out_pct"]) == list(range(9))
        assert report["scheme"] == scheme and report["row"]["kind"] == "cross-validation"
        assert report["row"]["details"]["sentence"] == report["sentence"]
        assert report["held_out"]["rms_pct"] >= abs(report["held_out"]["mean_pct"])
        assert len(report["totals"]) == 3 and report["inputs_sha256"]
        shells = report["shells"]
        beyond = shells["diffuse_light_beyond_inner_edge_pct"]
        assert set(beyond) == {"free", "formula"} == set(shells["weight"])
        assert len(beyond["free"]["median"]) == len(shells["edges_px"]) - 1
        near = shells["excess_near_centre"]
        assert abs(near["points"]) < 3 * near["sigma"]  # the truth is a power law
        assert f"{near['points']:+.1f} ± {near['sigma']:.1f}" in report["sentence"]
        json.dumps(report["folds"][0]["shells"], allow_nan=False)


# The report -------------------------------------------------------------------------------------------


def test_the_report_says_what_was_found_and_what_it_was_made_of(report: dict[str, Any]) -> None:
    row, content = report["row"], report["json"]
    assert row["kind"] == "report" and row["html"] == f"/v1/reports/{row['id']}/page"
    assert row["details"]["sentence"] == content["sentence"] and row["details"]["held_out"] is True
    assert content["schema"] == "psf-report/1" and content["seed"] == 3
    assert set(content["inputs"]["sha256"]) >= {"000.fits", "008.fits", "diffraction.fits", "transit.json"}
    assert content["provenance"]["parameters"]["dark_offsets"] is False
    assert set(content["provenance"]["libraries"]) >= LIBRARIES
    total = content["fit"]["parameters"]["total"]
    assert abs(total["value"] - TRUTH.total) < 4 * total["sigma"]
    assert content["shapes"] == {"shapes": "compared"}
    assert report["given"] == [("Solution", 3)], "the comparison starts from the fit and its seed"
    html = (report["folder"] / "r.html").read_text("utf-8")
    check_stands_alone(html)
    cells = {tag.text for tag in read_page(html) if tag.name == "td"}
    assert {frame["file"] for frame in content["evaluation"]["frames"]} <= cells
    assert (report["folder"] / "r.png").read_bytes().startswith(PNG)


def test_a_given_psf_is_evaluated_without_a_fit(service: InProcess, transit: Path, tmp_path: Path) -> None:
    folder = changed(transit, tmp_path / "t", known_psf=None, instrument=None)
    fits.PrimaryHDU(total_kernel(TRUTH, diffraction(), REACH_GRID_PX)).writeto(tmp_path / "true.fits")
    psf_id = service.upload_psf(tmp_path / "true.fits")["id"]
    row = service.report(folder, tmp_path / "r.json", page=tmp_path / "r.html", psf_id=psf_id)
    content = json.loads((tmp_path / "r.json").read_text())
    assert "fit" not in content and content["psf"]["given"] and row["details"]["psf_id"] == psf_id
    whole = content["evaluation"]["all"]
    assert abs(whole["mean_pct"]) < 4 * whole["mean_noise_pct"]
    assert any("no fit was made" in missing["why"] for missing in content["not_shown"])
    check_stands_alone((tmp_path / "r.html").read_text("utf-8"))
    # Dark offsets are of fits: asking for them or not is the same request here.
    again = service.report(folder, psf_id=psf_id, dark_offsets=False)
    assert again["created_at"] == row["created_at"]
