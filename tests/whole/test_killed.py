"""Processes killed at work, each as when the power goes: nothing is lost, and nothing is done twice."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.conftest import write_image
from tests.whole.stack import EMBEDDED_FIRST, Stack, items, running, wait_for
from workers.contract.jobs import Phase

IMAGES = 8
AT_WORK = 3  # images of a bulk run that one process reads, computes and writes at the same time
SERVED = "redis and postgresql"


@pytest.fixture(scope="module", params=EMBEDDED_FIRST)
def stack(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """A service that the first two tests share, and an archive that it may read."""
    folder = tmp_path_factory.mktemp("shared")
    (folder / "archive").mkdir()
    changes = {
        "HELIOPSF_BULK_ROOTS": str(folder / "archive"),
        "HELIOPSF_BULK_OUTPUT_ROOTS": str(folder / "out"),
    }
    with running(request.param, folder, changes) as stack:
        yield stack


def archive_run(stack: Stack, psf_file: Path, *, steps: int = 30, **more: Any) -> dict[str, Any]:
    """A bulk run of the images of an archive."""
    archive = stack.data.parent / "archive"
    for number in range(IMAGES):
        write_image(archive / f"{number:02}.fits", shape=(256, 256), seed=number)
    psf_id = stack.client.upload_psf(psf_file)["id"]
    method = {"name": "richardson-lucy", "steps": steps}
    return stack.client.submit_bulk(files=[f"{archive}/*.fits"], psf_id=psf_id, method=method, **more)


def done(stack: Stack, bulk: dict[str, Any]) -> int:
    return int(stack.client.bulk(bulk["id"])["images"]["done"])


@pytest.mark.slow  # tests/workers/run/test_worker.py has the fast case
def test_a_job_of_a_killed_worker_is_done_once_by_another(
    stack: Stack, tmp_path: Path, psf_file: Path
) -> None:
    write_image(tmp_path / "large.fits", shape=(1024, 1024))
    image_id = stack.client.upload_image(tmp_path / "large.fits")["id"]
    psf_id = stack.client.upload_psf(psf_file)["id"]
    method = {"name": "richardson-lucy", "steps": 40}
    job = stack.client.submit("deconvolve", image_id=image_id, psf_id=psf_id, method=method)
    wait_for(lambda: stack.client.job(job["id"])["progress"]["step"] > 2, "the job is at work", 120)
    stack.kill_workers()  # a service that has started its worker starts another one
    assert stack.client.job(job["id"])["phase"] == "EXECUTING"
    if stack.redis is not None:
        stack.start_worker()
    ended = stack.client.wait(job, timeout_s=120)
    assert ended["attempt"] == 2
    assert [one["id"] for one in stack.client.products()] == [ended["result"].rpartition("/")[2]]
    stored = [path for path in (stack.data / "blobs").rglob("*") if path.is_file()]
    assert len(stored) == 5, "image, PSF, product, picture of the changes, thumbnail"


def test_a_bulk_run_goes_on_and_a_server_that_dies_takes_its_worker_along(
    stack: Stack, psf_file: Path
) -> None:
    earlier = {one["id"] for one in stack.client.products()}
    bulk = archive_run(stack, psf_file, output=str(stack.data.parent / "out"))
    wait_for(lambda: done(stack, bulk) >= 2, "some are done", timeout_s=120)
    before = {row.position: row.ended_at for row in items(stack) if row.state == "done"}
    if stack.redis is None:
        stack.kill_workers()
    else:
        stack.kill_everything()
        stack.start_server()
        stack.start_worker()
    end = stack.client.wait_for_bulk(bulk["id"])
    rows = items(stack)
    assert end["phase"] == "COMPLETED" and [row.error for row in rows if row.error] == []
    assert end["images"]["done"] == IMAGES
    assert {row.position: row.ended_at for row in rows if row.position in before} == before, "done stays done"
    assert sum(row.attempts for row in rows) <= IMAGES + AT_WORK, "the kill costs an attempt of those at work"
    products = {one["id"] for one in stack.client.products()} - earlier
    assert products == {row.product_id for row in rows} and len(products) == IMAGES
    written = {path.name for path in (stack.data.parent / "out").iterdir()}
    assert written == {Path(str(row.output)).name for row in rows}, "and nothing half-written"
    manifest = list(stack.client.bulk_results(bulk["id"]))
    assert [line["position"] for line in manifest] == list(range(IMAGES))

    if stack.redis is None:
        workers = stack.worker_processes()
        assert workers and stack.server is not None
        stack.server.kill()
        stack.server.wait()
        _, left = psutil.wait_procs(workers, timeout=30)
        assert left == []


# A worker on a busy machine, whose processes need long to load their libraries. Python imports this module when it starts.
# Celery waits 4 s for a process that replaces another one, unless it is told to wait longer.
SLOW_START = """
import time
from celery.signals import worker_process_init

@worker_process_init.connect(weak=False)
def load(**_):
    time.sleep(6.0)
"""


@pytest.mark.slow
def test_a_process_that_replaces_a_lost_one_and_starts_slowly_is_not_ended(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(SLOW_START)
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    with running(SERVED, tmp_path, {"PYTHONPATH": path}) as stack:
        catalogue = stack.catalogue()
        wait_for(lambda: len(catalogue.census.workers(3600.0)) == 1, "the first process works", 90.0)
        parent, child = stack.worker_processes()
        child.kill()
        # This job ends at once, because its PSF does not exist.
        job, _ = catalogue.jobs.submit("psf-tables", {"psf_id": "0" * 64}, "k", "local")

        def ended() -> bool:
            row = catalogue.jobs.get(job.id)
            return row is not None and Phase(row.phase).ended

        wait_for(ended, "the job ends", 60.0)
        assert len(catalogue.census.workers(3600.0)) == 2, "the first process and the one in its place"
        assert parent.is_running()
        catalogue.close()
    assert "Timed out waiting" not in (tmp_path / "workers.log").read_text("utf-8")
