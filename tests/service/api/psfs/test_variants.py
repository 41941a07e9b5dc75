"""Variants of a channel over HTTP: the filter and the plate scale in the header of an image choose the PSF."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from fastapi.testclient import TestClient

from tests.conftest import write_image
from tests.fitted_psfs import EARLY, LATE, write_fitted
from tests.service.conftest import upload

SEEN = {"TELESCOP": "SOLO/EUI/HRI_EUV", "DETECTOR": "HRI_EUV", "WAVELNTH": 174.0, "DATE-BEG": "2022-08-30"}


def certified(api: TestClient, path: Path, total: float, version: str, **range_and_channel: Any) -> str:
    """Upload a fitted PSF and certify it; returns its id."""
    write_fitted(path, EARLY | {"total": total})
    psf_id: str = api.post("/v1/psfs", params={"kind": "total"}, content=path.read_bytes()).json()["id"]
    body = {"status": "certified", "version": version, **range_and_channel}
    answer = api.post(f"/v1/psfs/{psf_id}/status", json=body)
    assert answer.status_code == 200, answer.text
    return psf_id


def psf_of(api: TestClient, path: Path, **cards: Any) -> dict[str, Any]:
    """The parameters of the deconvolution of an image with these cards."""
    write_image(path, **SEEN, **cards)
    wanted = {"image_id": upload(api, path), "method": {"name": "linear", "steps": 1}}
    answer = api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": wanted})
    assert answer.status_code == 202, answer.text
    parameters: dict[str, Any] = answer.json()["parameters"]
    return parameters


def test_filter_and_plate_scale_choose_the_psf(
    api: TestClient, run_jobs: Callable[[], None], tmp_path: Path
) -> None:
    plain = certified(api, tmp_path / "1.fits", 0.40, "1.0.0")
    filtered = certified(api, tmp_path / "2.fits", 0.41, "1.0.0", channel="174-open_2")
    scaled = certified(api, tmp_path / "3.fits", 0.42, "1.0.0", channel="174-0.492arcsec")
    assert psf_of(api, tmp_path / "a.fits", FILTER="Open 1")["psf_id"] == plain
    assert psf_of(api, tmp_path / "b.fits", FILTER="Open 2")["psf_id"] == filtered
    scale = {"CDELT1": 0.492, "CDELT2": 0.492}
    assert psf_of(api, tmp_path / "c.fits", **scale)["psf_id"] == scaled
    found = api.get("/v1/images/" + upload(api, tmp_path / "b.fits") + "/psf").json()
    assert (found["psf"]["id"], found["channel"]) == (filtered, "174-open_2")
    binned = {"CDELT1": 0.984, "CDELT2": 0.984}
    assert psf_of(api, tmp_path / "d.fits", **binned)["psf_id"] == plain, "rebinned for a binned image"
    write_image(tmp_path / "e.fits", **SEEN, FILTER="Open 2", **scale)
    body = {"kind": "deconvolve", "parameters": {"image_id": upload(api, tmp_path / "e.fits")}}
    refused = api.post("/v1/jobs", json=body)
    assert refused.status_code == 409 and "174-0.492arcsec, 174-open_2" in refused.json()["detail"]
    run_jobs()
    assert {job["phase"] for job in api.get("/v1/jobs").json()["items"]} == {"COMPLETED"}


def test_the_psfs_of_a_variant_are_interpolated(
    api: TestClient, run_jobs: Callable[[], None], tmp_path: Path
) -> None:
    line = {"channel": "174-open_2"}
    first = certified(api, tmp_path / "1.fits", 0.41, "1.0.0", valid_to="2022-03-01", **line)
    last = certified(api, tmp_path / "2.fits", LATE["total"], "1.1.0", valid_from="2023-03-01", **line)
    address = "/v1/series/hri_euv/174-open_2/total"
    assert api.put(address, json={"interpolated": True}).status_code == 200
    wanted = psf_of(api, tmp_path / "i.fits", FILTER="Open 2")
    between = wanted["psf_interpolation"]
    assert (between["before_psf_id"], between["after_psf_id"]) == (first, last)
    run_jobs()
    psf = api.get(f"/v1/psfs/{wanted['psf_id']}").json()
    assert (psf["origin"], psf["channel"]) == ("interpolated", "174-open_2")
    status = api.get(f"/v1/psfs/{psf['id']}/status").json()
    assert (status["series"], status["next_version"]) == ("hri_euv/174-open_2/total", "1.2.0")
    page = api.get(f"/psfs/{psf['id']}", headers={"Accept": "text/html"})
    assert "174 angstrom, variant open_2" in page.text
