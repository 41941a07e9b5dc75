"""The main job over HTTP: upload, submit, wait, download; existing results are not computed again."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np
from astropy.io import fits
from fastapi.testclient import TestClient

from psfcore.instruments.files import instrument_names
from tests.conftest import SMALL_INSTRUMENT, write_image
from tests.service.conftest import upload
from workers.settings import Settings


def test_an_image_in_and_a_product_out(
    api: TestClient, run_jobs: Callable[[], None], image_file: Path, psf_file: Path
) -> None:
    image_id, psf_id = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
    assert image_id == hashlib.sha256(image_file.read_bytes()).hexdigest()
    body = {"kind": "deconvolve", "parameters": {"image_id": image_id, "psf_id": psf_id}}
    asked = api.post("/v1/jobs", json=body)
    assert asked.status_code == 202
    job = api.get(asked.headers["Location"]).json()
    assert job["phase"] == "QUEUED" and job["result"] is None
    method = job["parameters"]["method"]
    assert (method["name"], method["steps"], method["stop"]) == ("richardson-lucy", 20, "fixed")

    run_jobs()
    job = api.get(asked.headers["Location"]).json()
    assert job["phase"] == "COMPLETED" and job["progress"]["step"] == job["progress"]["steps"]

    product = api.get(job["result"]).json()
    file = api.get(product["file"])
    assert file.headers["content-type"] == "application/fits"
    assert hashlib.sha256(file.content).hexdigest() == product["sha256"]
    with fits.open(io.BytesIO(file.content)) as hdus:
        assert hdus[0].header["PSFID"] == psf_id
    assert api.get(product["preview"]).content.startswith(b"\x89PNG")

    again = api.post("/v1/jobs", json=body)
    assert again.status_code == 200
    assert again.json()["id"] == job["id"] and again.json()["phase"] == "COMPLETED"
    for key in ("image_id", "psf_id"):
        listed = api.get("/v1/products", params={key: product[key]}).json()
        assert [item["id"] for item in listed["items"]] == [product["id"]]
        assert api.get("/v1/products", params={key: "0" * 64}).json()["items"] == []


def test_a_form_is_taken_as_well_as_a_body(api: TestClient, image_file: Path) -> None:
    raw = upload(api, image_file)
    form = api.post(
        "/v1/images",
        files={"note": (None, "hello"), "file": ("../../evil\\name.fits", image_file.read_bytes())},
    )
    assert form.status_code == 200, "the same bytes are the same image"
    assert form.json()["id"] == raw
    assert api.get(f"/v1/images/{raw}").json()["header"]["shape"] == [96, 128]


def test_a_client_file_name_is_a_label_and_no_path(
    api: TestClient, image_file: Path, settings: Settings
) -> None:
    form = api.post("/v1/images", files={"file": ("../../evil\\name.fits", image_file.read_bytes())})
    assert form.json()["filename"] == "name.fits"
    assert not [p for p in settings.data_dir.rglob("*") if "evil" in p.name or "name.fits" in p.name]


def test_downloads_answer_to_etags(api: TestClient, psf_file: Path) -> None:
    address = f"/v1/psfs/{upload(api, psf_file, '/v1/psfs')}/file"
    first = api.get(address)
    assert first.content == psf_file.read_bytes()
    unchanged = api.get(address, headers={"If-None-Match": first.headers["ETag"]})
    assert unchanged.status_code == 304 and not unchanged.content
    assert api.get(address, headers={"If-None-Match": '"other"'}).status_code == 200
    part = api.get(address, headers={"Range": "bytes=0-8"})
    assert part.status_code == 206 and part.content == b"SIMPLE  ="


def test_a_psf_is_built_and_listed(api: TestClient, run_jobs: Callable[[], None]) -> None:
    body = {"kind": "psf-build", "parameters": {"instrument_file": SMALL_INSTRUMENT, "size": 128}}
    job = api.post("/v1/jobs", json=body).json()
    run_jobs()
    psf = api.get(api.get(f"/v1/jobs/{job['id']}").json()["result"]).json()
    assert psf["status"] == "draft" and psf["details"]["shape"] == [128, 128]
    listed = api.get("/v1/psfs", params={"instrument": "small"}).json()["items"]
    assert [item["id"] for item in listed] == [psf["id"]]
    assert api.get("/v1/psfs", params={"instrument": "aia"}).json()["items"] == []
    assert api.get(psf["preview"]).content.startswith(b"\x89PNG")


def test_an_image_of_a_known_instrument_needs_no_psf_id(api: TestClient, tmp_path: Path) -> None:
    write_image(tmp_path / "hri.fits", DETECTOR="HRI_EUV", TELESCOP="SOLO/EUI/HRI_EUV")
    image_id = upload(api, tmp_path / "hri.fits")
    job = api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": {"image_id": image_id}})
    assert job.status_code == 202
    recipe = job.json()["parameters"]["psf_recipe"]
    assert {key: value for key, value in recipe.items() if value is not None} == {
        "instrument": "hri_euv",
        "size": 2048,
    }


def test_an_image_without_a_known_psf_gets_a_problem_with_the_ways_on(
    api: TestClient, image_file: Path
) -> None:
    body = {"kind": "deconvolve", "parameters": {"image_id": upload(api, image_file)}}
    answer = api.post("/v1/jobs", json=body)
    problem = answer.json()
    assert answer.status_code == 409 and problem["type"] == "urn:heliopsf:no-psf-for-instrument"
    assert {one["name"] for one in problem["instruments"]} == set(instrument_names())
    assert problem["psfs"] == [] and [way["way"] for way in problem["ways"]] == ["name", "upload", "fit"]


def test_a_psf_of_another_channel_is_refused_unless_the_request_says_so(
    api: TestClient, run_jobs: Callable[[], None], psf_file: Path, tmp_path: Path
) -> None:
    write_image(tmp_path / "193.fits", TELESCOP="SDO/AIA", WAVELNTH=193)
    fits.setval(psf_file, "WAVELNTH", value=171)
    parameters = {"image_id": upload(api, tmp_path / "193.fits"), "psf_id": upload(api, psf_file, "/v1/psfs")}
    refused = api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": parameters})
    assert (refused.status_code, refused.json()["type"]) == (409, "urn:heliopsf:channel-mismatch")
    allowed = {"kind": "deconvolve", "parameters": parameters | {"other_channel": True}}
    job = api.post("/v1/jobs", json=allowed).json()
    run_jobs()
    found = api.get(f"/v1/jobs/{job['id']}").json()
    assert found["phase"] == "COMPLETED"
    warnings = api.get(found["result"]).json()["details"]["warnings"]
    assert [warning["code"] for warning in warnings] == ["channel"]


def test_cancel_before_the_start(
    api: TestClient, run_jobs: Callable[[], None], image_file: Path, psf_file: Path
) -> None:
    body = {
        "kind": "deconvolve",
        "parameters": {"image_id": upload(api, image_file), "psf_id": upload(api, psf_file, "/v1/psfs")},
    }
    job = api.post("/v1/jobs", json=body).json()
    assert api.delete(f"/v1/jobs/{job['id']}").json()["phase"] == "ABORTED"
    run_jobs()
    assert api.get(f"/v1/jobs/{job['id']}").json()["phase"] == "ABORTED"
    assert api.get("/v1/products").json()["items"] == []
    assert api.post("/v1/jobs", json=body).json()["id"] != job["id"]


def test_a_failed_job_says_why(
    api: TestClient, run_jobs: Callable[[], None], psf_file: Path, tmp_path: Path
) -> None:
    fits.PrimaryHDU(fits.getdata(psf_file) * float("nan")).writeto(tmp_path / "nan.fits")
    body = {
        "kind": "deconvolve",
        "parameters": {
            "image_id": upload(api, tmp_path / "nan.fits"),
            "psf_id": upload(api, psf_file, "/v1/psfs"),
        },
    }
    job = api.post("/v1/jobs", json=body).json()
    run_jobs()
    error = api.get(f"/v1/jobs/{job['id']}").json()["error"]
    assert error["fault"] == "user" and error["code"] == "all-nan" and "expected" in error["message"]


def test_lists_come_in_pages(api: TestClient, tmp_path: Path) -> None:
    for seed in range(5):
        write_image(tmp_path / f"{seed}.fits", seed=seed)
        upload(api, tmp_path / f"{seed}.fits")
    seen: list[str] = []
    address = "/v1/images?limit=2"
    while address:
        page = api.get(address).json()
        seen += [item["id"] for item in page["items"]]
        address = page["next"]
    assert len(seen) == len(set(seen)) == 5


def test_health(api: TestClient) -> None:
    assert api.get("/healthz").json()["status"] == "ok"


def test_a_database_that_is_away_is_503(api: TestClient, settings: Settings) -> None:
    for file in settings.data_dir.glob("catalogue.sqlite*"):
        file.unlink()
    (settings.data_dir / "catalogue.sqlite").mkdir()  # cannot be opened as a file
    api.app.state.heliopsf.catalogue.close()  # connections that are open would still see the old file
    answer = api.get("/v1/jobs")
    assert answer.status_code == 503
    assert answer.json()["type"] == "urn:heliopsf:database-away"


MASKED_INSTRUMENT = (
    SMALL_INSTRUMENT
    + """
[mount]
basis = "drawing"
mask_image = { file = "mask.png", width_mm = 4.0 }
"""
)


def test_a_psf_of_an_instrument_file_and_a_mask_of_the_users(
    api: TestClient, run_jobs: Callable[[], None], tmp_path: Path
) -> None:
    y, x = np.indices((64, 64)) - 31.5
    open_ring = ((np.hypot(x, y) < 30) & (np.hypot(x, y) > 12)).astype("f4")
    fits.PrimaryHDU(open_ring).writeto(tmp_path / "mask.fits")
    parameters = {"instrument_file": MASKED_INSTRUMENT, "size": 128}
    missing = api.post("/v1/jobs", json={"kind": "psf-build", "parameters": parameters}).json()
    parameters["mask_id"] = upload(api, tmp_path / "mask.fits")
    whole = api.post("/v1/jobs", json={"kind": "psf-build", "parameters": parameters}).json()
    run_jobs()
    error = api.get(f"/v1/jobs/{missing['id']}").json()["error"]
    assert error["code"] == "mask-missing" and "mask.png" in error["message"]
    psf = api.get(api.get(f"/v1/jobs/{whole['id']}").json()["result"]).json()
    assert psf["name"] == "small" and psf["details"]["shape"] == [128, 128]
    assert psf["details"]["provenance"]["parameters"]["mask_id"] == parameters["mask_id"]
    with fits.open(io.BytesIO(api.get(psf["file"]).content)) as hdus:
        text = bytes(np.asarray(hdus["INSTRUMENT"].data["TOML"][0]))
    assert text.decode() == MASKED_INSTRUMENT
