"""What a job would cost, which PSF it would use, and where it waits."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from fastapi.testclient import TestClient

from tests.conftest import write_image, write_psf
from tests.service.conftest import refusal, upload
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import PsfRow

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
    for place, size in enumerate((64, 66, 68)):
        told = asked(api, "psf-build", instrument="hri_euv", size=size)
        assert told["waiting_before"] == place and told["psf"] is None
        body = {"kind": "psf-build", "parameters": {"instrument": "hri_euv", "size": size}}
        job = api.post("/v1/jobs", json=body).json()
        assert job["waiting_before"] == place
        assert api.get(f"/v1/jobs/{job['id']}").json()["waiting_before"] == place
    bulk = asked(api, "psf-build", queue="bulk", instrument="hri_euv", size=70)
    assert (bulk["queue"], bulk["waiting_before"]) == ("bulk", 3)
    assert {one["waiting_before"] for one in api.get("/v1/jobs").json()["items"]} == {None}


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


def test_a_psf_that_was_built_before_is_told_with_its_status(
    api: TestClient, catalogue: Catalogue, tmp_path: Path
) -> None:
    write_image(tmp_path / "i.fits", **HEADER)
    image_id = upload(api, tmp_path / "i.fits")
    psf_id = asked(api, image_id=image_id)["psf"]["id"]
    catalogue.add(
        PsfRow(
            owner="local", id=psf_id, created_at=0.0, name="hri_euv", version="1.0.0+abc", instrument="hri_euv", kind="total",
            series="hri_euv/174/total", status="draft", origin="built", file_sha256="0" * 64, bytes=1,
            details={"shape": [2048, 2048]},
        )
    )  # fmt: skip
    found = asked(api, image_id=image_id)["psf"]
    assert (found["version"], found["status"]) == ("1.0.0+abc", "draft")
    assert found["why"].endswith("the instrument file that heliopsf ships.")


def test_errors_are_those_of_a_job(api: TestClient, image_file: Path) -> None:
    image_id = upload(api, image_file)
    bodies: list[dict[str, Any]] = [
        {"kind": "deconvolve", "parameters": {"image_id": image_id}},  # no PSF for this instrument
        {"kind": "deconvolve", "parameters": {"image_id": "f" * 64}},
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


BUILD = {"instrument": "hri_euv", "size": 64}


def submitted(api: TestClient, **more: Any) -> dict[str, Any]:
    answer = api.post("/v1/jobs", json={"kind": "psf-build", "parameters": BUILD, **more})
    assert answer.status_code in (200, 202), answer.text
    return dict(answer.json())


def test_a_job_that_can_wait_goes_up_once_somebody_asks_for_it_at_once(api: TestClient) -> None:
    later = submitted(api, queue="bulk")
    assert later["queue"] == "bulk"
    now = submitted(api)
    assert (now["id"], now["queue"]) == (later["id"], "interactive")
    assert submitted(api, queue="bulk")["queue"] == "interactive"
    assert api.get(f"/v1/jobs/{now['id']}").json()["queue"] == "interactive"
    for queue in ("interactive", "crossval", "soon", "", 1):
        body = {"kind": "psf-build", "parameters": BUILD, "queue": queue}
        refusal(api.post("/v1/jobs", json=body), 422, "invalid-request")  # nobody asks to be before others
