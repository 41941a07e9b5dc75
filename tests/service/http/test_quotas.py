"""What an owner may keep: refused before it is sent or worked on, with the figures of the owner's files."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner
from fastapi.testclient import TestClient

from service.cli.main import main
from tests.conftest import write_image
from tests.service.conftest import refusal, upload
from tests.workers.jobs import run_job
from workers.bulk.runs import keep_turns
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import ImageRow
from workers.files.store import Store
from workers.run.runner import Runner
from workers.settings import Settings


@pytest.fixture
def settings(settings: Settings, tmp_path: Path) -> Settings:
    more = {"quota_mib": 1, "max_upload_mib": 4, "bulk_roots": str(tmp_path / "archive")}
    return settings.model_copy(update=more)


def large(path: Path, kib: int) -> Path:
    """A file that can be uploaded as an image and as a PSF: all light is in its central pixel."""
    pixels = np.zeros((kib, 256), "f4")
    pixels[kib // 2, 128] = 1.0
    fits.PrimaryHDU(pixels).writeto(path)
    return path


def counted(catalogue: Catalogue) -> int:
    """What the owner of an open service has in its quota."""
    return catalogue.quotas.usage("local", 1).used_bytes


def fill(catalogue: Catalogue, left_bytes: int) -> None:
    """Add a file that leaves this much of the quota."""
    size = 2**20 - counted(catalogue) - left_bytes
    catalogue.add(ImageRow(owner="local", id="b" * 64, created_at=1.0, bytes=size, summary={}))


def work(catalogue: Catalogue, settings: Settings) -> None:
    """Let each bulk run have a turn."""
    runner = Runner(settings, catalogue, Store(settings.data_dir))
    keep_turns(catalogue, settings)
    for turn in catalogue.jobs.of_kind("bulk"):
        run_job(runner, catalogue, turn.id)


def test_an_upload_over_the_quota_is_refused_with_figures(
    api: TestClient, catalogue: Catalogue, tmp_path: Path
) -> None:
    upload(api, large(tmp_path / "a.fits", 600))
    used = counted(catalogue)
    assert used == (tmp_path / "a.fits").stat().st_size
    for where in ("/v1/images", "/v1/psfs"):
        content = large(tmp_path / f"{where[-4:]}.fits", 500).read_bytes()
        # With a length that is said before, and without.
        for body in (content, iter([content[:1000], content[1000:]])):
            answer = api.post(where, content=body, headers={"Content-Type": "application/fits"})
            # Sent without a length, at least the bytes that came are needed.
            message = refusal(answer, 413, "quota-exceeded")
            needed_mib = answer.json()["needed_bytes"] / 2**20
            assert "0.6 of 1.0 MiB are used" in message and f"{needed_mib:.1f} MiB more" in message
            assert (answer.json()["used_bytes"], answer.json()["limit_bytes"]) == (used, 2**20)
    assert list((tmp_path / "data" / "tmp").iterdir()) == []
    assert len(api.get("/v1/images").json()["items"]) == 1
    upload(api, large(tmp_path / "small.fits", 300))


def test_jobs_that_were_queued_while_there_was_room_end_where_there_is_none(
    api: TestClient, catalogue: Catalogue, settings: Settings, image_file: Path, psf_file: Path
) -> None:
    image_id, psf_id = upload(api, image_file), upload(api, psf_file, "/v1/psfs")

    def parameters(steps: int) -> dict[str, Any]:
        method = {"name": "richardson-lucy", "steps": steps}
        return {"image_id": image_id, "psf_id": psf_id, "method": method}

    def submit(kind: str, parameters: dict[str, Any]) -> str:
        answer = api.post("/v1/jobs", json={"kind": kind, "parameters": parameters})
        assert answer.status_code == 202, answer.text
        return str(answer.json()["id"])

    first, second = (submit("deconvolve", parameters(steps)) for steps in (1, 2))
    method = json.dumps(parameters(1)["method"])
    form = {"KIND": "deconvolve", "PHASE": "RUN", **parameters(1), "method": method}
    equal = api.post("/uws/jobs", data=form, follow_redirects=False).headers["Location"][-32:]
    tables = submit("psf-tables", {"psf_id": psf_id})
    fill(catalogue, left_bytes=1)
    runner = Runner(settings, catalogue, Store(settings.data_dir))
    jobs = {}
    for job_id in (first, second, equal, tables):
        run_job(runner, catalogue, job_id)
        jobs[job_id] = api.get(f"/v1/jobs/{job_id}").json()
    error = jobs[second]["error"]
    assert (jobs[second]["phase"], error["code"], error["fault"]) == ("ERROR", "quota-exceeded", "user")
    assert "of 1.0 MiB are used, and the result of this job could not be kept" in error["message"]
    assert len(api.get("/v1/products").json()["items"]) == 1, "what was at work when the room ended"
    assert jobs[first]["phase"] == jobs[equal]["phase"] == "COMPLETED"
    assert jobs[equal]["result"] == jobs[first]["result"], "nothing more"
    assert jobs[tables]["phase"] == "COMPLETED", "tables are not counted"
    refused = api.post("/v1/jobs", json={"kind": "deconvolve", "parameters": parameters(3)})
    assert "of 1.0 MiB are used" in refusal(refused, 507, "quota-exceeded"), "its result could not be kept"


def test_a_bulk_that_fills_the_quota_stops_and_goes_on_with_room(
    api: TestClient, catalogue: Catalogue, tmp_path: Path, settings: Settings, psf_file: Path
) -> None:
    (tmp_path / "archive").mkdir()
    for number in range(5):
        write_image(tmp_path / "archive" / f"{number}.fits", shape=(288, 288), seed=number)
    request = {
        "files": [{"glob": f"{tmp_path}/archive/*"}],
        "psf_id": upload(api, psf_file, "/v1/psfs"),
        "parameters": {"method": {"name": "richardson-lucy", "steps": 1}},
    }
    here = f"/v1/bulk/{api.post('/v1/bulk', json=request).json()['id']}"
    while catalogue.bulks.at_work():
        work(catalogue, settings)
    stopped = api.get(here).json()
    assert stopped["phase"] == "ERROR" and stopped["error"]["code"] == "quota-exceeded"
    # The quota is checked before an image is computed; the last product may still be written then.
    assert 0 < stopped["images"]["done"] < 5 and stopped["images"]["failed"] == 0
    catalogue.quotas.set_quota("local", 100)
    assert api.post(f"{here}/resume").status_code == 200
    while catalogue.bulks.at_work():
        work(catalogue, settings)
    assert api.get(here).json()["images"]["done"] == 5


def test_the_command_line_tells_and_sets_quotas(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HELIOPSF_DATA_DIR", str(tmp_path / "data"))
    monkeypatch.setenv("HELIOPSF_QUOTA_MIB", "5")

    def said(*arguments: str, status: int = 0) -> str:
        answer = CliRunner().invoke(main, list(arguments))
        assert answer.exit_code == status, answer.output
        return re.sub(" +", " ", answer.output.strip())

    said("database", "upgrade")
    assert said("store", "quota", "me", "7") == "me 0.0 MiB of 7 MiB"
    assert said("store", "quota", "me", "0") == "me 0.0 MiB no limit"
    assert said("store", "quota", "me", "--default") == "me 0.0 MiB of 5 MiB" == said("store", "usage")
    assert "2147483647" in said("store", "quota", "me", str(2**31), status=2)
    said("store", "quota", "me", status=2), said("store", "quota", "No Body", "1", status=2)
