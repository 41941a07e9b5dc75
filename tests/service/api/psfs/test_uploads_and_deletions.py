"""Nothing stays of a PSF upload that is refused, and a draft that nothing uses can be deleted."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from astropy.io import fits
from fastapi.testclient import TestClient

from tests.conftest import SMALL_INSTRUMENT, write_image, write_psf
from tests.service.conftest import job_after, refusal, result_of, upload
from tests.service.keyed import Keyed
from workers.catalogue.access import Scope
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER
from workers.settings import Settings

FEW = {"method": {"name": "richardson-lucy", "steps": 1}}


def used_bytes(catalogue: Catalogue) -> int:
    return catalogue.owners.usage(DEFAULT_OWNER, 0).used_bytes


def blobs(settings: Settings) -> set[str]:
    return {path.name for path in (settings.data_dir / "blobs").rglob("*") if path.is_file()}


def test_an_image_is_refused_as_a_psf_and_nothing_of_it_stays(
    api: TestClient, catalogue: Catalogue, settings: Settings, tmp_path: Path
) -> None:
    write_image(tmp_path / "plain.fits")
    packed = fits.CompImageHDU(fits.getdata(tmp_path / "plain.fits"), fits.Header({"XPOSURE": 2.0}))
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(tmp_path / "packed.fits")
    for name in ("plain", "packed"):
        content = (tmp_path / f"{name}.fits").read_bytes()
        answer = api.post("/v1/psfs", content=content, headers={"Content-Type": "application/fits"})
        assert "expected" in refusal(answer, 422, "psf-sum")
    assert api.get("/v1/psfs").json()["items"] == []
    assert blobs(settings) == set() and used_bytes(catalogue) == 0
    assert list((settings.data_dir / "tmp").iterdir()) == []


def test_a_draft_is_deleted_with_its_files_and_its_bytes(
    api: TestClient, catalogue: Catalogue, settings: Settings, psf_file: Path, run_jobs: Callable[[], None]
) -> None:
    psf_id = upload(api, psf_file, "/v1/psfs")
    body = {"kind": "psf-tables", "parameters": {"psf_id": psf_id}}
    job = catalogue.jobs.get(job_after(api, run_jobs, "psf-tables", psf_id=psf_id)["id"])
    assert job is not None
    assert api.get(f"/v1/psfs/{psf_id}/preview").status_code == 200 and len(blobs(settings)) == 3
    deleted = api.delete(f"/v1/psfs/{psf_id}")
    assert deleted.status_code == 200 and deleted.json()["id"] == psf_id
    refusal(api.get(f"/v1/psfs/{psf_id}"), 404, "no-such-psf")
    refusal(api.delete(f"/v1/psfs/{psf_id}"), 404, "no-such-psf")
    assert blobs(settings) == set() and used_bytes(catalogue) == 0
    assert upload(api, psf_file, "/v1/psfs") == psf_id
    again = api.post("/v1/jobs", json=body).json()
    assert again["phase"] == "QUEUED", "the tables are made again"


def test_a_psf_that_was_built_here(api: TestClient, run_jobs: Callable[[], None]) -> None:
    """Sent again it keeps its id; deleted, it is built again."""
    body = {"kind": "psf-build", "parameters": {"instrument_file": SMALL_INSTRUMENT, "size": 64}}
    built = result_of(api, run_jobs, "psf-build", instrument_file=SMALL_INSTRUMENT, size=64)
    address = f"/v1/psfs/{built['id']}"
    file = api.get(f"{address}/file").content
    again = api.post("/v1/psfs", content=file)
    assert again.status_code == 200 and again.json()["id"] == built["id"]
    renamed = api.post("/v1/psfs", params={"name": "mine"}, content=file)
    assert renamed.status_code == 201 and renamed.json()["id"] != built["id"]
    assert api.delete(address).status_code == 200
    assert api.post("/v1/jobs", json=body).status_code == 202
    run_jobs()
    assert api.get(address).status_code == 200


def test_a_psf_in_use_is_not_deleted(
    api: TestClient, run_jobs: Callable[[], None], image_file: Path, tmp_path: Path
) -> None:
    image_id = upload(api, image_file)
    ids = []
    for size in (16, 24, 32, 48, 64):
        write_psf(tmp_path / f"{size}.fits", size=size)
        series = {"instrument": "small", "channel": "171", "kind": "total"}
        content = (tmp_path / f"{size}.fits").read_bytes()
        ids.append(api.post("/v1/psfs", params=series, content=content).json()["id"])
    product, waiting, bulk, pinned, certified = ids

    def deconvolve(psf_id: str) -> None:
        body = {"kind": "deconvolve", "parameters": {"image_id": image_id, "psf_id": psf_id, **FEW}}
        assert api.post("/v1/jobs", json=body).status_code == 202

    deconvolve(product)
    run_jobs()
    deconvolve(waiting)
    assert api.post("/v1/bulk", json={"images": [image_id], "psf_id": bulk}).status_code == 202
    assert api.post("/v1/contexts", json={"name": "c", "pins": [{"psf_id": pinned}]}).status_code == 201
    status = {"status": "certified", "version": "1.0.0"}
    assert api.post(f"/v1/psfs/{certified}/status", json=status).status_code == 200
    for psf_id, code, word in (
        (product, "psf-in-use", "product "),
        (waiting, "psf-in-use", "job "),
        (bulk, "psf-in-use", "bulk run "),
        (pinned, "psf-in-use", "context "),
        (certified, "not-a-draft", "certified"),
    ):
        assert word in refusal(api.delete(f"/v1/psfs/{psf_id}"), 409, code)
        assert api.get(f"/v1/psfs/{psf_id}").status_code == 200
    run_jobs()  # the job waits no longer, but its product uses the PSF
    refusal(api.delete(f"/v1/psfs/{waiting}"), 409, "psf-in-use")

    # A draft that only a failed job names can be deleted.
    fits.PrimaryHDU(np.zeros((64, 64), "f4")).writeto(tmp_path / "dark.fits")
    dark = upload(api, tmp_path / "dark.fits")
    write_psf(tmp_path / "20.fits", size=20)
    psf_id = upload(api, tmp_path / "20.fits", "/v1/psfs")
    failed = job_after(api, run_jobs, "deconvolve", image_id=dark, psf_id=psf_id)
    assert failed["error"]["code"] == "no-signal"
    assert api.delete(f"/v1/psfs/{psf_id}").status_code == 200


def test_only_the_owner_deletes_and_only_with_the_scope(
    service: Keyed, settings: Settings, psf_file: Path
) -> None:
    ada, bob = service.client("ada"), service.client("bob")
    psf_id = upload(ada, psf_file, "/v1/psfs")
    assert upload(bob, psf_file, "/v1/psfs") == psf_id
    refusal(service.client("ada", Scope.READ).delete(f"/v1/psfs/{psf_id}"), 403, "scope-missing")
    assert service.api.delete(f"/v1/psfs/{psf_id}").status_code == 401
    assert ada.delete(f"/v1/psfs/{psf_id}").status_code == 200
    assert ada.get(f"/v1/psfs/{psf_id}").status_code == 404
    kept = bob.get(f"/v1/psfs/{psf_id}/file")
    assert kept.status_code == 200 and kept.content == psf_file.read_bytes()
    assert bob.delete(f"/v1/psfs/{psf_id}").status_code == 200
    assert blobs(settings) == set()
