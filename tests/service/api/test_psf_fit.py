"""A fit over HTTP: upload, job, PSF version, report; and requests that cannot be."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from psfcore.transit.archive import pack
from tests.service.conftest import upload
from tests.transit_files import write_simulated, write_transit


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    folder, path = write_simulated(tmp_path / "transit"), tmp_path / "transit.tar"
    pack(folder, path)
    return path


def test_a_transit_becomes_a_psf_version_with_a_report(
    api: TestClient, run_jobs: Callable[[], None], archive: Path
) -> None:
    transit_id = upload(api, archive, "/v1/transits")
    job = api.post("/v1/jobs", json={"kind": "psf-fit", "parameters": {"transit_id": transit_id}}).json()
    run_jobs()
    job = api.get(f"/v1/jobs/{job['id']}").json()
    assert job["phase"] == "COMPLETED", job["error"]
    psf = api.get(job["result"]).json()
    assert psf["origin"] == "fitted" and psf["details"]["transit_id"] == transit_id
    answer = api.get(psf["report"])
    assert answer.headers["content-type"] == "application/json"
    report = json.loads(answer.content)
    assert report["schema"] == "psf-fit/1" and report["provenance"]["job_id"] == job["id"]
    assert api.get(psf["report"], headers={"If-None-Match": answer.headers["etag"]}).status_code == 304
    assert api.get(psf["preview"]).content.startswith(b"\x89PNG")
    assert api.get(psf["file"]).content.startswith(b"SIMPLE")


def test_a_psf_that_was_not_fitted_has_no_report(api: TestClient, psf_file: Path) -> None:
    psf_id = upload(api, psf_file, "/v1/psfs")
    assert api.get(f"/v1/psfs/{psf_id}").json()["report"] is None
    answer = api.get(f"/v1/psfs/{psf_id}/report")
    assert answer.status_code == 404 and answer.json()["type"].endswith("no-report")


def test_requests_that_cannot_be(api: TestClient, tmp_path: Path) -> None:
    missing = api.post("/v1/jobs", json={"kind": "psf-fit", "parameters": {"transit_id": "0" * 64}})
    assert missing.status_code == 404 and missing.json()["type"].endswith("no-such-transit")
    path = tmp_path / "t.tar"
    pack(write_transit(tmp_path / "silent", noise=None), path)
    silent = upload(api, path, "/v1/transits")
    refused = api.post("/v1/jobs", json={"kind": "psf-fit", "parameters": {"transit_id": silent}})
    assert refused.status_code == 422 and refused.json()["type"].endswith("no-noise-figures")
    for wrong in (
        {"shape": "round"},
        {"seed": -1},
        {"noise": {"photon_gain_dn": -1, "read_noise_dn": 1}},
        {"a": 1},
    ):
        parameters = {"transit_id": "0" * 64} | wrong
        answer = api.post("/v1/jobs", json={"kind": "psf-fit", "parameters": parameters})
        assert answer.status_code == 422, wrong
