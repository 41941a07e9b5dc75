"""The main job over HTTP: upload, submit, wait, download; existing results are not computed again.
What a job would cost, which PSF it would use, and where it waits."""

from __future__ import annotations

import gzip
import hashlib
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

from astropy.io import fits
from fastapi.testclient import TestClient

from tests.conftest import write_image, write_psf
from tests.service.conftest import refusal, upload
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


def test_the_file_of_an_upload_is_what_was_sent(api: TestClient, image_file: Path, psf_file: Path) -> None:
    plain = image_file.read_bytes()
    raw = {"content": gzip.compress(plain), "headers": {"Content-Type": "application/fits"}}
    form = {"files": {"file": ("solar image.fits", plain, "application/fits")}}
    for options, content, media_type, name in (
        (form, plain, "application/fits", "solar%20image.fits"),
        (raw, raw["content"], "application/gzip", ".fits.gz"),
    ):
        image_id = api.post("/v1/images", **options).json()["id"]
        file = api.get(f"/v1/images/{image_id}/file")
        assert file.content == content and file.headers["content-type"] == media_type
        assert file.headers["etag"] == f'"{hashlib.sha256(content).hexdigest()}"'
        assert name in file.headers["content-disposition"]
    again = api.post("/v1/images", content=plain)
    assert again.status_code == 200 and again.json()["header"]["shape"] == [96, 128], "the same bytes"
    refusal(api.get(f"/v1/images/{'f' * 64}/file"), 404, "no-such-image")

    address = f"/v1/psfs/{upload(api, psf_file, '/v1/psfs')}/file"
    first = api.get(address)
    assert first.content == psf_file.read_bytes()
    unchanged = api.get(address, headers={"If-None-Match": first.headers["ETag"]})
    assert unchanged.status_code == 304 and not unchanged.content
    assert api.get(address, headers={"If-None-Match": '"other"'}).status_code == 200
    part = api.get(address, headers={"Range": "bytes=0-8"})
    assert part.status_code == 206 and part.content == b"SIMPLE  ="


def test_a_form_with_several_files_is_refused_and_none_is_kept(api: TestClient, image_file: Path) -> None:
    content = image_file.read_bytes()
    for parts, count in (
        ([("file", ("a.fits", content)), ("file", ("a.fits", content))], 2),
        ([("file", ("a.fits", content)), ("other", ("b.fits", content))], 2),
        ([("image", ("a.fits", content))], 1),
        ([("file", ("a.fits", content)), ("file", ("b.fits", b"x")), ("file", ("c.fits", b""))], 3),
    ):
        told = refusal(api.post("/v1/images", files=parts), 400, "bad-form")
        assert f"got {count} part" in told, told
    assert api.get("/v1/images").json()["items"] == []


def test_a_file_sent_as_curl_d_does_gets_the_right_option(api: TestClient, image_file: Path) -> None:
    content = image_file.read_bytes()
    headers = {"Content-Type": "application/x-www-form-urlencoded"}
    stripped = content.translate(None, b"\0\r\n")
    for body, status, code in (
        (stripped, 422, "truncated-data"),
        (gzip.compress(content, mtime=0).translate(None, b"\0\r\n"), 422, "bad-gzip"),
        (b"file=@image.fits", 415, "not-fits"),
    ):
        told = refusal(api.post("/v1/images", content=body, headers=headers), status, code)
        assert "-F file=@" in told and "--data-binary @" in told
    assert "curl" not in refusal(api.post("/v1/images", content=stripped), 422, "truncated-data")
    assert api.post("/v1/images", content=content, headers=headers).status_code == 201, "--data-binary"


def test_an_image_of_a_known_instrument_needs_no_psf_id(api: TestClient, tmp_path: Path) -> None:
    write_image(tmp_path / "hri.fits", DETECTOR="HRI_EUV", TELESCOP="SOLO/EUI/HRI_EUV")
    image_id = upload(api, tmp_path / "hri.fits")
    job = api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": {"image_id": image_id}})
    assert job.status_code == 202
    recipe = job.json()["parameters"]["psf_recipe"]
    known = {key: value for key, value in recipe.items() if value is not None}
    assert known == {"instrument": "hri_euv", "size": 2048}
    turned = {"CDELT1": 0.492, "CDELT2": 0.492, "CROTA2": 30.0, "CROTA": 10.0}
    write_image(tmp_path / "turned.fits", DETECTOR="HRI_EUV", TELESCOP="SOLO/EUI/HRI_EUV", **turned)
    parameters = {"image_id": upload(api, tmp_path / "turned.fits")}
    job = api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": parameters})
    recipe = job.json()["parameters"]["psf_recipe"]
    assert recipe["instrument"] is None and recipe["instrument_file"].startswith("turn_deg = 20.00\n")
    estimate = api.post("/v1/estimates", json={"kind": "deconvolve", "parameters": parameters})
    assert estimate.json()["psf"]["name"] == "hri_euv" and estimate.json()["psf"]["status"] is None


def test_a_database_that_is_away_is_503(api: TestClient, settings: Settings) -> None:
    assert api.get("/healthz").json()["status"] == "ok"
    for file in settings.data_dir.glob("catalogue.sqlite*"):
        file.unlink()
    (settings.data_dir / "catalogue.sqlite").mkdir()  # cannot be opened as a file
    api.app.state.heliopsf.catalogue.close()  # connections that are open would still see the old file
    refusal(api.get("/v1/jobs"), 503, "database-away")


# --- estimates -------------------------------------------------------------------------------------------


HEADER = {
    "TELESCOP": "SOLO/EUI/HRI_EUV",
    "DETECTOR": "HRI_EUV",
    "WAVELNTH": 174,
    "DATE-BEG": "2022-04-01T10:30:05",
}


def asked(
    api: TestClient, kind: str = "deconvolve", queue: str | None = None, **given: Any
) -> dict[str, Any]:
    """The estimate of a job. Nothing is submitted by it."""
    before = len(api.get("/v1/jobs").json()["items"])
    answer = api.post("/v1/estimates", json={"kind": kind, "parameters": given, "queue": queue})
    assert answer.status_code == 200, answer.text
    assert len(api.get("/v1/jobs").json()["items"]) == before
    return dict(answer.json())


def test_an_estimate_is_what_the_job_then_gets(
    api: TestClient, image_file: Path, psf_file: Path, run_jobs: Callable[[], None]
) -> None:
    parameters = {"image_id": upload(api, image_file), "psf_id": upload(api, psf_file, "/v1/psfs")}
    told = asked(api, **parameters)
    assert told["existing"] is None and told["waiting_before"] == 0 and told["queue"] == "interactive"
    psf = api.get(f"/v1/psfs/{parameters['psf_id']}").json()
    assert told["psf"] == {
        "id": psf["id"], "name": psf["name"], "version": psf["version"], "status": "draft",
        "why": "The request names this PSF.",
    }  # fmt: skip
    job = api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": parameters}).json()
    assert job["waiting_before"] == 0
    assert (told["parameters"], told["estimate"]) == (job["parameters"], job["estimate"])
    run_jobs()
    done = api.get(f"/v1/jobs/{job['id']}").json()
    assert done["result"] == f"/v1/products/{told['result_id']}" and done["waiting_before"] is None
    assert asked(api, **parameters)["existing"] == done["result"]
    first, second = (asked(api, "rerun", of="product", id=told["result_id"]) for _ in range(2))
    assert first["result_id"] != second["result_id"] and first["existing"] is None, "always a new result"
    api.delete(done["result"])
    assert asked(api, **parameters)["existing"] is None


def test_the_place_in_the_queue(api: TestClient) -> None:
    for place, size in enumerate((64, 66)):
        told = asked(api, "psf-build", instrument="hri_euv", size=size)
        assert told["waiting_before"] == place and told["psf"] is None
        body = {"kind": "psf-build", "parameters": {"instrument": "hri_euv", "size": size}}
        job = api.post("/v1/jobs", json=body).json()
        assert job["waiting_before"] == api.get(f"/v1/jobs/{job['id']}").json()["waiting_before"] == place
    bulk = asked(api, "psf-build", queue="bulk", instrument="hri_euv", size=70)
    assert (bulk["queue"], bulk["waiting_before"]) == ("bulk", 2)
    assert {one["waiting_before"] for one in api.get("/v1/jobs").json()["items"]} == {None}
    for queue in ("interactive", "crossval", ""):  # nobody asks to be before others
        refusal(api.post("/v1/jobs", json=body | {"queue": queue}), 422, "invalid-request")


def test_why_a_psf_is_chosen(api: TestClient, tmp_path: Path) -> None:
    write_image(tmp_path / "i.fits", **HEADER)
    image_id = upload(api, tmp_path / "i.fits")
    built = asked(api, image_id=image_id)["psf"]
    assert (built["name"], built["status"]) == ("hri_euv", None)
    assert "No PSF of hri_euv/174/total is certified" in built["why"] and "builds it first" in built["why"]
    write_psf(tmp_path / "p.fits")
    where = "/v1/psfs?name=fitted&instrument=hri_euv&channel=174&kind=total"
    psf_id = upload(api, tmp_path / "p.fits", where)
    certified = {"status": "certified", "version": "1.0.0"}
    assert api.post(f"/v1/psfs/{psf_id}/status", json=certified).status_code == 200
    choice = asked(api, image_id=image_id)["psf"]
    assert "is certified for the images of hri_euv/174/total" in choice.pop("why")
    assert choice == {"id": psf_id, "name": "fitted", "version": "1.0.0", "status": "certified"}
    assert api.post("/v1/contexts", json={"name": "release", "reason": "x"}).status_code == 201
    pinned = asked(api, image_id=image_id, context="release")["psf"]
    assert "Context release pins this PSF" in pinned["why"]


def test_errors_are_those_of_a_job(api: TestClient, image_file: Path) -> None:
    image_id = upload(api, image_file)
    bodies: list[dict[str, Any]] = [
        {"kind": "deconvolve", "parameters": {"image_id": image_id}},  # no PSF for this instrument
        {"kind": "deconvolve", "parameters": {"image_id": image_id, "psf_id": "f" * 64}},
        {"kind": "deconvolve", "parameters": {"image_id": image_id, "context": "none"}},
        {"kind": "deconvolve", "parameters": {}},
        {"kind": "unknown", "parameters": {}},
    ]
    for body in bodies:
        estimate, job = (api.post(f"/v1/{where}", json=body) for where in ("estimates", "jobs"))
        assert estimate.status_code == job.status_code >= 400
        assert estimate.json() == job.json()
    assert "psfs" in api.post("/v1/estimates", json=bodies[0]).json(), "with the fields of the error"
