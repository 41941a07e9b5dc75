"""A large deconvolution that is cancelled at work: the step at work is its last, and nothing of it is left."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.conftest import write_image
from tests.whole.stack import MODES, Stack, running, wait_for

pytestmark = pytest.mark.slow
STAGE = {"kind": "deconvolve", "stage": "deconvolving"}


def steps_ended(stack: Stack) -> int | None:
    """Steps of deconvolutions whose attempts have ended; None before there was one."""
    text = httpx.get(f"{stack.client.server}/metrics", timeout=60).text
    samples = (one for family in text_string_to_metric_families(text) for one in family.samples)
    found = [
        one.value for one in samples if (one.name, one.labels) == ("heliopsf_job_stage_steps_total", STAGE)
    ]
    return int(found[0]) if found else None


@pytest.fixture(params=MODES)
def stack(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Stack]:
    with running(request.param, tmp_path) as stack:
        yield stack


def test_no_step_is_begun_after_the_one_at_work(stack: Stack, tmp_path: Path, psf_file: Path) -> None:
    client = stack.client
    write_image(tmp_path / "image.fits", shape=(2048, 2048))
    write_image(tmp_path / "small.fits")
    image_id, psf_id = client.upload_image(tmp_path / "image.fits")["id"], client.upload_psf(psf_file)["id"]
    method = {"name": "richardson-lucy-extended", "steps": 200, "margin_px": 2048}
    job = client.submit("deconvolve", image_id=image_id, psf_id=psf_id, method=method)
    wait_for(lambda: client.job(job["id"])["progress"]["step"] >= 2, "steps are reported", 120)
    blobs = {path for path in (stack.data / "blobs").rglob("*") if path.is_file()}
    assert len(blobs) == 2, "image and PSF"

    cancelled = client.cancel(job["id"])
    assert (cancelled["phase"], cancelled["cancel_requested"]) == ("EXECUTING", True)
    reported = cancelled["progress"]
    assert reported["stage"] == "deconvolving" and 2 <= reported["step"] < 200
    wait_for(lambda: client.job(job["id"])["phase"] == "ABORTED", "the job is aborted")
    wait_for(lambda: steps_ended(stack) is not None, "the steps of the attempt are counted")
    assert steps_ended(stack) == reported["step"] + 1, "the step at work, and none after it"

    ended = client.job(job["id"])
    assert ended["progress"] == reported and ended["result"] is None and ended["error"] is None
    assert list(client.products()) == []
    assert {path for path in (stack.data / "blobs").rglob("*") if path.is_file()} == blobs
    wait_for(lambda: not list((stack.data / "tmp").iterdir()), "half-written files are gone", 10)
    catalogue = stack.catalogue()
    row = catalogue.jobs.get(job["id"])
    catalogue.close()
    assert row is not None and row.lease is None and row.attempt == 1

    small = client.upload_image(tmp_path / "small.fits")["id"]
    after = client.submit("deconvolve", image_id=small, psf_id=psf_id)
    assert client.wait(after, timeout_s=120)["phase"] == "COMPLETED", "the worker is free again"
    assert client.job(job["id"])["phase"] == "ABORTED"
