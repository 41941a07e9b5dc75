"""A request for a region of an image."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

from astropy.io import fits
from fastapi.testclient import TestClient
from httpx import Response

from tests.service.conftest import refusal, upload

DEFAULT = {"method": {"name": "linear"}}


def ask(api: TestClient, image_id: str, psf_id: str, **more: Any) -> Response:
    parameters = {"image_id": image_id, "psf_id": psf_id, **DEFAULT, **more}
    return api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": parameters})


def test_the_product_of_a_region_is_the_box(
    api: TestClient, run_jobs: Callable[[], None], image_file: Path, psf_file: Path
) -> None:
    fits.setval(image_file, "CRPIX1", value=1.5)
    image_id, psf_id = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
    whole = ask(api, image_id, psf_id).json()
    same = ask(api, image_id, psf_id, region_error=0.5).json()
    assert same["id"] == whole["id"], "without a region it means nothing"
    job = ask(api, image_id, psf_id, region="10:50,20:60", region_error=0.9).json()
    assert job["id"] != whole["id"]
    run_jobs()
    product, of_whole = (
        api.get(api.get(f"/v1/jobs/{one['id']}").json()["result"]).json() for one in (job, whole)
    )
    told = product["details"]["region"]
    assert told["box"] == "10:50,20:60" and told["rim_px"] > 0 and told["error"] > 0
    assert of_whole["details"]["region"] is None
    found, expected = (fits.open(io.BytesIO(api.get(one["file"]).content))[0] for one in (product, of_whole))
    assert found.data.shape == (40, 40) and found.header["DCNVBERR"] == told["error"]
    assert found.header["CRPIX1"] == 1.5 - 10
    assert abs(found.data - expected.data[20:60, 10:50]).max() <= told["error"]


def test_a_region_that_cannot_be_is_refused(api: TestClient, image_file: Path, psf_file: Path) -> None:
    image_id, psf_id = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
    box = {"region": "0:40,0:40"}
    discrepancy = {"name": "linear", "stop": "discrepancy"}
    cases: list[tuple[dict[str, Any], str, str]] = [
        ({"region": "10-50,20-60"}, "invalid-request", "region"),
        ({"region": "0:5000,0:50"}, "region-outside", "the size of the image"),
        ({"region": "0:40,0:8"}, "region-too-small", "16 px"),
        (box | {"error_draws": 4}, "invalid-request", "error_draws 0 with a region"),
        (box | {"method": discrepancy}, "invalid-request", "stopping rule fixed"),
        (box | {"region_error": 0}, "invalid-request", "region_error"),
    ]
    for parameters, code, said in cases:
        assert said in refusal(ask(api, image_id, psf_id, **parameters), 422, code)
    method = {"name": "linear", "steps": 2}
    whole, part = (
        api.post("/v1/estimates", json={"kind": "deconvolve", "parameters": parameters}).json()["estimate"]
        for parameters in (
            {"image_id": image_id, "psf_id": psf_id, "method": method},
            {"image_id": image_id, "psf_id": psf_id, "method": method, "region": "0:16,0:16"},
        )
    )
    assert part["memory_mib"] <= whole["memory_mib"] and part["seconds"] <= whole["seconds"]
