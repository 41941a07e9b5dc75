"""Nothing stays of a PSF upload that is refused, and a draft that nothing uses can be deleted."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from astropy.io import fits
from fastapi.testclient import TestClient
from httpx import Response

from tests.conftest import SMALL_INSTRUMENT, write_image, write_psf
from tests.service.conftest import upload
from tests.service.keyed import keyed
from workers.catalogue.access.keys import Scope
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.owners import OverQuota, counted_bytes
from workers.catalogue.tables import DEFAULT_OWNER
from workers.settings import Settings

FEW = {"method": {"name": "richardson-lucy", "steps": 1}}


def catalogue_of(api: TestClient) -> Catalogue:
    catalogue: Catalogue = api.app.state.heliopsf.catalogue  # type: ignore[attr-defined]
    return catalogue


def used_bytes(api: TestClient) -> int:
    return catalogue_of(api).owners.usage(DEFAULT_OWNER, 0).used_bytes


def blobs(settings: Settings) -> set[str]:
    return {path.name for path in (settings.data_dir / "blobs").rglob("*") if path.is_file()}


def refused(answer: Response, status: int) -> str:
    assert answer.status_code == status, answer.text
    return str(answer.json()["type"]).removeprefix("urn:heliopsf:")


def test_an_image_is_refused_as_a_psf_and_nothing_of_it_stays(
    api: TestClient, settings: Settings, tmp_path: Path
) -> None:
    write_image(tmp_path / "plain.fits")
    packed = fits.CompImageHDU(fits.getdata(tmp_path / "plain.fits"), fits.Header({"XPOSURE": 2.0}))
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(tmp_path / "packed.fits")
    for name, code in (("plain", "psf-sum"), ("packed", "image-as-psf")):
        content = (tmp_path / f"{name}.fits").read_bytes()
        answer = api.post("/v1/psfs", content=content, headers={"Content-Type": "application/fits"})
        assert refused(answer, 422) == code and "expected" in answer.json()["detail"]
    assert api.get("/v1/psfs").json()["items"] == []
    assert blobs(settings) == set() and used_bytes(api) == 0
    assert list((settings.data_dir / "tmp").iterdir()) == []


def test_the_file_of_an_upload_whose_row_is_refused_goes(
    api: TestClient, settings: Settings, psf_file: Path, image_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another upload has filled the quota between the first check and the row."""
    kept = upload(api, psf_file, "/v1/psfs")
    real = Catalogue.add

    def full(catalogue: Catalogue, row: Any, quota_mib: int | None = None) -> Any:
        raise OverQuota(catalogue.owners.usage(row.owner, 1))

    monkeypatch.setattr(Catalogue, "add", full)
    for path, where in ((image_file, "/v1/images"), (psf_file, "/v1/psfs")):
        answer = api.post(where, content=path.read_bytes(), headers={"Content-Type": "application/fits"})
        assert refused(answer, 413) == "quota-exceeded"
    assert blobs(settings) == {kept}, "a file that another row names stays"
    monkeypatch.setattr(Catalogue, "add", real)


def test_a_draft_is_deleted_with_its_files_and_its_bytes(
    api: TestClient, settings: Settings, psf_file: Path, run_jobs: Callable[[], None]
) -> None:
    psf_id = upload(api, psf_file, "/v1/psfs")
    body = {"kind": "psf-tables", "parameters": {"psf_id": psf_id}}
    job = catalogue_of(api).jobs.get(api.post("/v1/jobs", json=body).json()["id"])
    assert job is not None
    run_jobs()
    assert api.get(f"/v1/psfs/{psf_id}/preview").status_code == 200 and len(blobs(settings)) == 3
    deleted = api.delete(f"/v1/psfs/{psf_id}")
    assert deleted.status_code == 200 and deleted.json()["id"] == psf_id
    assert refused(api.get(f"/v1/psfs/{psf_id}"), 404) == "no-such-psf"
    assert refused(api.delete(f"/v1/psfs/{psf_id}"), 404) == "no-such-psf"
    assert blobs(settings) == set() and used_bytes(api) == counted_bytes(job), "the row of the job stays"
    assert upload(api, psf_file, "/v1/psfs") == psf_id
    again = api.post("/v1/jobs", json=body).json()
    assert again["phase"] == "QUEUED", "the tables are made again"


def test_a_built_draft_is_built_again_after_its_deletion(
    api: TestClient, run_jobs: Callable[[], None]
) -> None:
    body = {"kind": "psf-build", "parameters": {"instrument_file": SMALL_INSTRUMENT, "size": 64}}
    job = api.post("/v1/jobs", json=body).json()
    run_jobs()
    address = api.get(f"/v1/jobs/{job['id']}").json()["result"]
    assert api.delete(address).status_code == 200
    again = api.post("/v1/jobs", json=body)
    assert again.status_code == 202
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
        answer = api.delete(f"/v1/psfs/{psf_id}")
        assert refused(answer, 409) == code and word in answer.json()["detail"]
        assert api.get(f"/v1/psfs/{psf_id}").status_code == 200
    run_jobs()  # the job waits no longer, but its product uses the PSF
    assert refused(api.delete(f"/v1/psfs/{waiting}"), 409) == "psf-in-use"


def test_a_draft_of_a_failed_job_can_be_deleted(
    api: TestClient, run_jobs: Callable[[], None], image_file: Path, tmp_path: Path
) -> None:
    packed = fits.CompImageHDU(fits.getdata(image_file))
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(tmp_path / "packed.fits")
    psf_id = upload(api, tmp_path / "packed.fits", "/v1/psfs")
    body = {"kind": "deconvolve", "parameters": {"image_id": upload(api, image_file), "psf_id": psf_id}}
    job = api.post("/v1/jobs", json=body).json()
    run_jobs()
    assert api.get(f"/v1/jobs/{job['id']}").json()["error"]["code"] == "psf-sum"
    assert api.delete(f"/v1/psfs/{psf_id}").status_code == 200


def test_only_the_owner_deletes_and_only_with_the_scope(settings: Settings, psf_file: Path) -> None:
    with keyed(settings) as known:
        ada, bob = known.client("ada"), known.client("bob")
        psf_id = upload(ada, psf_file, "/v1/psfs")
        assert upload(bob, psf_file, "/v1/psfs") == psf_id
        reader = known.client("ada", Scope.READ)
        assert refused(reader.delete(f"/v1/psfs/{psf_id}"), 403) == "scope-missing"
        assert known.api.delete(f"/v1/psfs/{psf_id}").status_code == 401
        assert ada.delete(f"/v1/psfs/{psf_id}").status_code == 200
        assert ada.get(f"/v1/psfs/{psf_id}").status_code == 404
        kept = bob.get(f"/v1/psfs/{psf_id}/file")
        assert kept.status_code == 200 and kept.content == psf_file.read_bytes()
        assert bob.delete(f"/v1/psfs/{psf_id}").status_code == 200
        assert blobs(settings) == set()


def test_a_psf_that_was_built_here_and_is_sent_again_keeps_its_id(
    api: TestClient, run_jobs: Callable[[], None]
) -> None:
    body = {"kind": "psf-build", "parameters": {"instrument_file": SMALL_INSTRUMENT, "size": 64}}
    job = api.post("/v1/jobs", json=body).json()
    run_jobs()
    built = api.get(api.get(f"/v1/jobs/{job['id']}").json()["result"]).json()
    file = api.get(f"/v1/psfs/{built['id']}/file").content
    again = api.post("/v1/psfs", content=file)
    assert again.status_code == 200 and again.json()["id"] == built["id"]
    renamed = api.post("/v1/psfs", params={"name": "mine"}, content=file)
    assert renamed.status_code == 201 and renamed.json()["id"] != built["id"]
