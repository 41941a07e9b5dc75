"""A fit over HTTP: upload, job, PSF version, report; and requests that cannot be."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from httpx import Response

from psfcore.transit.archive import pack
from tests.service.conftest import job_after, refusal, upload
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
    job = job_after(api, run_jobs, "psf-fit", transit_id=transit_id)
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


def test_requests_that_cannot_be(api: TestClient, psf_file: Path, tmp_path: Path) -> None:
    psf_id = upload(api, psf_file, "/v1/psfs")
    assert api.get(f"/v1/psfs/{psf_id}").json()["report"] is None, "it was not fitted"
    refusal(api.get(f"/v1/psfs/{psf_id}/report"), 404, "no-report")

    def answer(**parameters: object) -> Response:
        return api.post("/v1/jobs", json={"kind": "psf-fit", "parameters": parameters})

    pack(write_transit(tmp_path / "silent", noise=None), tmp_path / "t.tar")
    refusal(answer(transit_id=upload(api, tmp_path / "t.tar", "/v1/transits")), 422, "no-noise-figures")
    noise = {"photon_gain_dn": -1, "read_noise_dn": 1}
    for wrong in ({"shape": "round"}, {"seed": -1}, {"noise": noise}, {"a": 1}):
        refusal(answer(transit_id="0" * 64, **wrong), 422, "invalid-request")
