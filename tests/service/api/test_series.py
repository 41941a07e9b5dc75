"""Series of PSFs over HTTP: images between two PSFs use a PSF between them."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from astropy.io import fits
from fastapi.testclient import TestClient
from httpx import Response

from tests.conftest import write_image
from tests.fitted_psfs import EARLY, LATE, interpolated_on_a_small_grid, write_fitted
from tests.service.conftest import job_after, refusal, result_of, upload

SEEN = {"TELESCOP": "SOLO/EUI/HRI_EUV", "DETECTOR": "HRI_EUV", "WAVELNTH": 174.0}
TOTAL = "/v1/psfs?kind=total"
SERIES = "/v1/series/hri_euv/174/total"
QUICK = {"name": "richardson-lucy", "steps": 2}


@pytest.fixture(scope="module", autouse=True)
def _small_grid() -> Iterator[None]:
    with interpolated_on_a_small_grid():
        yield


def certify(api: TestClient, psf_id: str, version: str, start: str | None, end: str | None) -> None:
    body = {"status": "certified", "version": version, "valid_from": start, "valid_to": end}
    answer = api.post(f"/v1/psfs/{psf_id}/status", json=body)
    assert answer.status_code == 200, answer.text


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The files of two fitted PSFs."""
    folder = tmp_path_factory.mktemp("fitted")
    return write_fitted(folder / "early.fits", EARLY), write_fitted(folder / "late.fits", LATE)


@pytest.fixture
def ends(api: TestClient, fitted: tuple[Path, Path]) -> tuple[str, str]:
    """Two fitted PSFs, certified until the end of February 2022 and from March 2023."""
    early, late = (upload(api, path, TOTAL) for path in fitted)
    certify(api, early, "1.0.0", None, "2022-03-01")
    certify(api, late, "1.1.0", "2023-03-01", None)
    return early, late


def image_at(api: TestClient, path: Path, date: str, seed: int = 1) -> str:
    write_image(path, seed=seed, **SEEN, **{"DATE-BEG": date})
    return upload(api, path)


def deconvolve(api: TestClient, image_id: str, **more: Any) -> Response:
    parameters = {"image_id": image_id, "method": QUICK, **more}
    return api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": parameters})


def test_an_image_between_two_psfs_is_deconvolved_with_a_psf_between_them(
    api: TestClient, run_jobs: Callable[[], None], ends: tuple[str, str], tmp_path: Path
) -> None:
    image = image_at(api, tmp_path / "i.fits", "2022-08-30T15:00:00")
    detail = refusal(deconvolve(api, image), 404, "no-psf-fits")
    assert "2022-08-30" in detail and "interpolates" not in detail

    said = api.put(SERIES, json={"interpolated": True, "reason": "the mirrors age"}).json()
    assert (said["interpolated"], said["history"][0]["reason"]) == (True, "the mirrors age")
    assert api.get("/v1/series").json()["items"] == [{"series": "hri_euv/174/total", "interpolated": True}]
    body = {"kind": "deconvolve", "parameters": {"image_id": image, "method": QUICK}}
    choice = api.post("/v1/estimates", json=body).json()["psf"]
    assert choice["status"] is None and "the job makes it first" in choice["why"]

    product = result_of(api, run_jobs, "deconvolve", image_id=image, method=QUICK)
    psf = api.get(f"/v1/psfs/{choice['id']}").json()
    assert product["psf_id"] == psf["id"]
    assert (psf["origin"], psf["status"], psf["name"]) == ("interpolated", "draft", "hri_euv-interpolated")
    assert psf["version"] == choice["version"] == product["psf_version"]
    file = io.BytesIO(api.get(product["file"]).content)
    header = fits.getheader(file)
    assert (header["PSFID"], header["PSFNAME"]) == (psf["id"], "hri_euv-interpolated")
    # tests/psfcore/scatter/test_interpolation.py tests the curve
    middle = 0.5 * (EARLY["total"] + LATE["total"])
    assert psf["details"]["fit"]["parameters"]["total"]["value"] == pytest.approx(middle, abs=0.001)

    other = image_at(api, tmp_path / "j.fits", "2022-08-30T13:00:00", seed=2)
    again = api.get(deconvolve(api, other).headers["Location"]).json()
    assert again["parameters"]["psf_id"] == psf["id"], "the same day: the PSF is used again"
    run_jobs()
    assert len(api.get("/v1/psfs").json()["items"]) == 3

    # Lineage names both ends with their weights; a rerun gives the same PSF.
    between = api.get(f"/v1/products/{product['id']}/lineage").json()["parents"][1]
    assert [(one["type"], one["id"]) for one in between["parents"]] == [("psf", one) for one in ends]
    weights = [one["weight"] for one in between["parents"]]
    # The nearest midnight is that of 31 August, 183 of the 365 days after 1 March 2022.
    assert weights == pytest.approx([182 / 365, 183 / 365]) and between["weight"] is None
    parameters = between["made"]["parameters"]
    assert (parameters["before_psf_id"], parameters["time"]) == (ends[0], "2022-08-31T00:00:00Z")
    rerun = api.post(f"/v1/psfs/{psf['id']}/rerun")
    run_jobs()
    details = api.get(api.get(rerun.headers["Location"]).json()["result"]).json()["details"]
    assert details["same"] is True and details["same_file"] is True
    assert api.get(f"/psfs/{psf['id']}", headers={"Accept": "text/html"}).status_code == 200


def between(before: str, after: str) -> dict[str, str]:
    times = {"before_time": "2022-03-01", "after_time": "2023-03-01", "time": "2022-06-01"}
    return {"before_psf_id": before, "after_psf_id": after, **times}


def test_ends_that_do_not_fit_end_the_job_with_the_reason(
    api: TestClient, run_jobs: Callable[[], None], ends: tuple[str, str], tmp_path: Path
) -> None:
    plain = upload(api, write_fitted(tmp_path / "plain.fits", LATE, fitted=None), TOTAL)
    error = job_after(api, run_jobs, "psf-interpolate", **between(ends[0], plain))["error"]
    assert (error["fault"], error["code"]) == ("user", "psf-not-fitted")
    for wrong, status in ((between(ends[0], "0" * 64), 404), (between(*ends) | {"time": "2024-01-01"}, 422)):
        body = {"kind": "psf-interpolate", "parameters": wrong}
        assert api.post("/v1/jobs", json=body).status_code == status

    # A PSF that an interpolated PSF was made from is not deleted.
    draft = upload(api, write_fitted(tmp_path / "draft.fits", LATE | {"c": 2.6}), TOTAL)
    made = result_of(api, run_jobs, "psf-interpolate", **between(ends[0], draft))["id"]
    detail = refusal(api.delete(f"/v1/psfs/{draft}"), 409, "psf-in-use")
    assert made[:12] in detail
    assert api.delete(f"/v1/psfs/{made}").status_code == 200
    assert api.delete(f"/v1/psfs/{draft}").status_code == 200


def test_invalid_changes_of_a_series_are_refused(api: TestClient, ends: tuple[str, str]) -> None:
    for address, body, status, code in (
        ("/v1/series/fsi/174/total", {"interpolated": True}, 404, "no-such-series"),
        ("/v1/series/HRI/174/total", {"interpolated": True}, 422, "invalid-request"),
        (SERIES, {"interpolated": True, "step": 1}, 422, "invalid-request"),
    ):
        refusal(api.put(address, json=body), status, code)
    assert api.get(SERIES).json() == {"series": "hri_euv/174/total", "interpolated": False, "history": []}
