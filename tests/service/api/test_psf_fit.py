"""A fit over HTTP: upload, job, PSF version, report; and requests that cannot be."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from httpx import Response

from psfcore.transit.archive import pack
from tests.service.conftest import refusal, result_of, upload
from tests.transit_files import write_simulated, write_transit
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import PsfRow
from workers.files.store import Store
from workers.settings import Settings


@pytest.mark.slow
def test_a_transit_becomes_a_psf_version_with_a_report(
    api: TestClient, run_jobs: Callable[[], None], tmp_path: Path
) -> None:
    pack(write_simulated(tmp_path / "transit"), tmp_path / "transit.tar")
    transit_id = upload(api, tmp_path / "transit.tar", "/v1/transits")
    psf = result_of(api, run_jobs, "psf-fit", transit_id=transit_id)
    assert psf["origin"] == "fitted" and psf["details"]["transit_id"] == transit_id
    report = api.get(psf["report"]).json()
    assert report["schema"] == "psf-fit/1" and report["provenance"]["job_id"]
    assert api.get(psf["preview"]).content.startswith(b"\x89PNG")
    assert api.get(psf["file"]).content.startswith(b"SIMPLE")


def test_the_report_of_a_fitted_psf(
    api: TestClient, catalogue: Catalogue, settings: Settings, tmp_path: Path
) -> None:
    (tmp_path / "report.json").write_text('{"schema": "psf-fit/1"}')
    digest = Store(settings.data_dir).keep(tmp_path / "report.json")
    files = {"file_sha256": digest, "preview_sha256": digest, "bytes": 1}
    known = {"details": {"report_sha256": digest, "transit_id": "3" * 64}, "created_at": 1.0}
    fitted = {"origin": "fitted", "name": "p", "version": "1", "status": "draft"}
    catalogue.add(PsfRow(owner="local", id="4" * 64, **files, **known, **fitted))
    answer = api.get(api.get(f"/v1/psfs/{'4' * 64}").json()["report"])
    assert answer.headers["content-type"] == "application/json" and answer.json()["schema"] == "psf-fit/1"
    known_already = {"If-None-Match": answer.headers["etag"]}
    assert api.get(f"/v1/psfs/{'4' * 64}/report", headers=known_already).status_code == 304


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
