"""An archive worked through by real processes: on the command line, and by two workers beside a person's job."""

from __future__ import annotations

import json
import time
import uuid
from pathlib import Path

import pytest
from click.testing import CliRunner

from service.cli.main import main
from tests.conftest import write_image
from tests.whole.stack import Stack, items, running, wait_for
from tests.whole.test_killed import IMAGES, SERVED, archive_run, done


def test_the_command_line_from_submission_to_report(
    open_stack: Stack, psf_file: Path, tmp_path: Path
) -> None:
    name = f"run-{uuid.uuid4().hex[:8]}"
    archive = open_stack.data.parent / "archive" / name
    archive.mkdir()
    for number in range(2):
        write_image(archive / f"{number}.fits", shape=(96, 96), seed=number, WAVELNTH=174)
    (archive / "zz.fits").write_text("no FITS\n" * 500)

    def bulk(*arguments: str, status: int = 0) -> str:
        answer = CliRunner().invoke(main, ["bulk", *arguments, "--server", open_stack.client.server])
        assert answer.exit_code == status, answer.output
        return answer.output

    where = ["--where", "WAVELNTH=174", "--where", "XPOSURE>=1", "--where", "XPOSURE<3"]
    how = ("--psf", str(psf_file), *where, "--steps", "2", "--name", name, "--wait")
    said = bulk("submit", f"{archive}/*.fits", *how, status=1)  # an image failed
    bulk_id = said.split()[1]
    assert "COMPLETED: 2 of 3 done, 1 failed" in said
    assert f"{bulk_id[:12]}  COMPLETED" in bulk("list")
    manifest, failures = tmp_path / "m.csv", tmp_path / "f.ndjson"
    said = bulk("report", bulk_id, "-o", str(manifest), "--failures", str(failures), "--most", "1")
    assert said.count(f"/{name}/") == 2, "one image and one failure"
    assert "failed: " in said and "zz.fits: expected a FITS file" in said
    assert len(manifest.read_text().splitlines()) == 2 + 1
    assert json.loads(failures.read_text())["error"]["code"] == "not-fits"
    (archive / "zz.fits").unlink()
    write_image(archive / "zz.fits", shape=(96, 96), seed=99)
    bulk("retry", bulk_id)
    assert "COMPLETED: 3 of 3 done, 0 failed" in bulk("status", bulk_id, "--wait")


@pytest.mark.slow
def test_two_workers_share_a_bulk_run_and_a_persons_job_goes_first(tmp_path: Path, psf_file: Path) -> None:
    (tmp_path / "archive").mkdir()
    changes = {"HELIOPSF_BULK_ROOTS": str(tmp_path / "archive")}
    with running(SERVED, tmp_path, changes, workers=2) as stack:
        bulk = archive_run(stack, psf_file, steps=100)
        wait_for(lambda: done(stack, bulk) >= 2, "it is under way", timeout_s=120)
        write_image(tmp_path / "mine.fits")
        image_id = stack.client.upload_image(tmp_path / "mine.fits")["id"]
        psf_id = stack.client.upload_psf(psf_file)["id"]
        submitted_at = time.time()
        job = stack.client.wait(stack.client.submit("deconvolve", image_id=image_id, psf_id=psf_id))
        between = [
            row for row in items(stack) if row.taken_at and submitted_at < row.taken_at < job["started_at"]
        ]
        assert len(between) <= 1, (
            "the first worker to end an image takes the job; the other may begin one meanwhile"
        )
        assert stack.client.bulk(bulk["id"])["phase"] == "RUNNING"
        end = stack.client.wait_for_bulk(bulk["id"])
        assert end["images"]["done"] == IMAGES
        workers = {row.job_id for row in items(stack)}
        assert len(workers) == 2, "both had a turn"
