"""The job psf-fit: from an archive of a transit to a PSF version, its report, its picture, and errors made of it."""

from __future__ import annotations

import itertools
import json
import shutil
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from psfcore.fits.header import FitsLimits
from psfcore.fits.product.planes import read_planes
from psfcore.fits.psfs import read_psf
from psfcore.psf import REACH_GRID_PX, cumulative_curve
from psfcore.scatter.samples import possible_psfs
from psfcore.simulate.scatter_truth import total_kernel
from service.client.http import ServiceError
from service.local import LocalService
from tests.conftest import write_image
from tests.transit_files import TRUTH, diffraction, write_simulated
from workers.settings import Settings

LIMITS = FitsLimits(max_pixels=2**24)


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
def fitted(service: LocalService, transit: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """One fit, all of its files, and the steps that its progress told."""
    out = tmp_path_factory.mktemp("fitted")
    told: list[tuple[str, int, int]] = []
    psf = service.fit_psf(
        transit,
        out / "psf.fits",
        report=out / "r.json",
        preview=out / "p.png",
        progress=lambda *step: told.append(step),
    )
    report = json.loads((out / "r.json").read_text())
    return {"psf": psf, "report": report, "folder": out, "told": told}


def test_the_curve_is_that_of_the_truth_within_its_errors(fitted: dict[str, Any]) -> None:
    psf = read_psf(fitted["folder"] / "psf.fits", LIMITS)
    curve = fitted["report"]["curve"]
    radii = np.array(curve["radii_px"])
    found = np.array(curve["light_beyond_pct"])
    assert cumulative_curve(psf.kernel, radii) == pytest.approx(found, abs=1e-3)
    truth = cumulative_curve(total_kernel(TRUTH, diffraction(), REACH_GRID_PX), radii)
    assert np.abs((found - truth) / np.array(curve["sigma"])).max() < 4
    assert np.abs(found - truth)[radii <= 50].max() < 2


def test_the_product_says_what_it_was_made_of(fitted: dict[str, Any], transit: Path) -> None:
    psf, report = fitted["psf"], fitted["report"]
    assert psf["origin"] == "fitted" and psf["report"] == f"/v1/psfs/{psf['id']}/report"
    assert set(report["inputs_sha256"]) >= {"000.fits", "008.fits", "diffraction.fits", "transit.json"}
    provenance = psf["details"]["provenance"]
    assert provenance["inputs_sha256"] == report["inputs_sha256"]
    assert provenance["parameters"]["shape"] == "softened-power-law"
    assert {"numpy", "scipy", "numba", "astropy"} <= set(provenance["libraries"])
    assert {f["file"] for f in report["frames"]} | set(report["left_out"]) == {
        f"{k:03d}.fits" for k in range(9)
    }
    assert psf["details"]["fit"]["sentence"] == report["sentence"]
    with fits.open(fitted["folder"] / "psf.fits") as hdus:
        assert {"DIFFRACTION", "SCATTER", "PROFILE", "FIT"} <= {hdu.name for hdu in hdus}
    assert (fitted["folder"] / "p.png").read_bytes().startswith(b"\x89PNG")


def test_psfs_sampled_from_the_covariance_spread_as_the_band_of_the_curve(fitted: dict[str, Any]) -> None:
    psf = read_psf(fitted["folder"] / "psf.fits", LIMITS)
    assert psf.fitted is not None and psf.fitted.parameters == ("b_px", "c", "total")
    radii = np.array([2.0, 20.0, 100.0])
    curves = np.array([cumulative_curve(one.kernel, radii) for one in possible_psfs(psf)])
    assert len(curves) == 6
    sigma = dict(zip(fitted["report"]["curve"]["radii_px"], fitted["report"]["curve"]["sigma"], strict=True))
    # Sigma points have the covariance as it stands; the curve is not quite linear over them.
    assert curves.std(axis=0) == pytest.approx([sigma[r] for r in radii], rel=0.15)


def test_progress_never_decreases(fitted: dict[str, Any]) -> None:
    shares = [
        step / steps for stage, step, steps in fitted["told"] if stage not in ("reading", "building the PSF")
    ]
    assert len(shares) > 3
    assert all(later >= earlier - 0.02 for earlier, later in itertools.pairwise(shares))
    assert min(shares) >= 0 and max(shares) <= 1


def test_an_identical_request_gets_the_existing_psf(
    service: LocalService, fitted: dict[str, Any], transit: Path
) -> None:
    again = service.fit_psf(transit)
    assert again["id"] == fitted["psf"]["id"] and again["created_at"] == fitted["psf"]["created_at"]


@pytest.mark.slow
def test_a_rerun_of_a_fit_is_the_same_bit_for_bit(service: LocalService, fitted: dict[str, Any]) -> None:
    psf_id = fitted["psf"]["id"]
    report = service.get(service.wait(service.submit("rerun", of="psf", id=psf_id))["result"])
    assert report["details"]["same"] is True, report["details"]["sentence"]
    assert service.get(f"/v1/psfs/{psf_id}")["created_at"] == fitted["psf"]["created_at"]


def test_a_deconvolution_with_it_carries_the_psfs_own_error(
    service: LocalService, fitted: dict[str, Any], tmp_path: Path
) -> None:
    image = tmp_path / "image.fits"
    write_image(image, CDELT1=0.492, CDELT2=0.492, DETECTOR="HRI_EUV")
    wanted = {"psf_id": fitted["psf"]["id"], "noise": (6.0, 2.0), "error_draws": 4, "steps": 3}
    service.deconvolve(image, tmp_path / "o.fits", **wanted)
    planes = read_planes(tmp_path / "o.fits")
    assert planes["PSF_ERROR"].shape == planes["ERROR"].shape
    assert np.isfinite(planes["PSF_ERROR"]).all() and 0 < np.median(planes["PSF_ERROR"]) < np.median(
        planes["ERROR"]
    )


def changed(transit: Path, folder: Path, **changes: Any) -> Path:
    """A copy of a transit with other values in its transit.json."""
    shutil.copytree(transit, folder)
    manifest = json.loads((folder / "transit.json").read_text())
    (folder / "transit.json").write_text(json.dumps(manifest | changes))
    return folder


def images_of(transit: Path) -> list[dict[str, Any]]:
    images: list[dict[str, Any]] = json.loads((transit / "transit.json").read_text())["images"]
    return images


def test_images_without_an_occulter_are_refused(service: LocalService, transit: Path, tmp_path: Path) -> None:
    elsewhere = [image | {"x": 64.0, "y": 110.0} for image in images_of(transit)]
    with pytest.raises(ServiceError) as caught:
        service.fit_psf(changed(transit, tmp_path / "t", images=elsewhere))
    assert caught.value.code == "too-few-frames" and "expected an occulter at (64, 110)" in str(caught.value)


@pytest.mark.slow
def test_a_transit_of_one_pointing_states_a_limit(
    service: LocalService, transit: Path, tmp_path: Path
) -> None:
    two = [image for image in images_of(transit) if image["fov"] < 3]
    psf = service.fit_psf(changed(transit, tmp_path / "t", images=two))
    assert any(limit.startswith("with 2 pointings") for limit in psf["details"]["fit"]["limits"])


def test_too_few_images(service: LocalService, transit: Path, tmp_path: Path) -> None:
    with pytest.raises(ServiceError, match="at least 3 images"):
        service.fit_psf(changed(transit, tmp_path / "t", images=images_of(transit)[:2]))


def test_everything_saturated(service: LocalService, transit: Path) -> None:
    with pytest.raises(ServiceError) as caught:
        service.fit_psf(transit, saturation_dn=1e-3)
    assert caught.value.code == "all-saturated"


def test_a_known_psf_of_the_wrong_kind(service: LocalService, transit: Path, tmp_path: Path) -> None:
    folder = changed(transit, tmp_path / "t")
    fits.writeto(folder / "diffraction.fits", np.ones((8, 8), np.float32) / 64, overwrite=True)
    with pytest.raises(ServiceError) as caught:
        service.fit_psf(folder)
    assert caught.value.code == "too-small" or (caught.value.code or "").startswith("known-psf-")


def test_an_archive_with_paths_outside_or_a_missing_file_is_refused(
    service: LocalService, transit: Path, tmp_path: Path
) -> None:
    climbs, lacks = tmp_path / "climbs.zip", tmp_path / "lacks.zip"
    with zipfile.ZipFile(climbs, "w") as archive:
        archive.write(transit / "transit.json", "transit.json")
        archive.writestr("../000.fits", b"")
    with zipfile.ZipFile(lacks, "w") as archive:
        archive.write(transit / "transit.json", "transit.json")
    for path, code in ((climbs, "archive-climbs"), (lacks, "missing-file")):
        with pytest.raises(Exception) as caught:
            service.fit_psf(path)
        assert getattr(caught.value, "code", None) == code


def test_a_fit_needs_noise_figures(service: LocalService, transit: Path, tmp_path: Path) -> None:
    folder = changed(transit, tmp_path / "t", noise=None)
    with pytest.raises(Exception) as caught:
        service.fit_psf(folder)
    assert getattr(caught.value, "code", None) == "no-noise-figures"
