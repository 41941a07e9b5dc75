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
from workers.catalogue.tables import JobRow
from workers.contract.jobs import Phase

IMAGES = 8
AT_WORK = 3  # images of a bulk run that one process reads, computes and writes at the same time
SERVED = "redis and postgresql"
SOME_STEPS = {"name": "richardson-lucy", "steps": 40}


@pytest.fixture
def stack(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Stack]:
    """A service of the test's own, and an archive that it may read."""
    (tmp_path / "archive").mkdir()
    changes = {
        "HELIOPSF_BULK_ROOTS": str(tmp_path / "archive"),
        "HELIOPSF_BULK_OUTPUT_ROOTS": str(tmp_path / "out"),
    }
    with running(request.param, tmp_path, changes) as stack:
        yield stack


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """A service on Redis and PostgreSQL that two tests share; each leaves a worker."""
    with running(SERVED, tmp_path_factory.mktemp("served"), workers=0) as stack:
        yield stack


def large_job(stack: Stack, folder: Path, psf_file: Path) -> dict[str, Any]:
    """A job of some seconds, at work."""
    write_image(folder / "large.fits", shape=(1024, 1024))
    image_id = stack.client.upload_image(folder / "large.fits")["id"]
    psf_id = stack.client.upload_psf(psf_file)["id"]
    job = stack.client.submit("deconvolve", image_id=image_id, psf_id=psf_id, method=SOME_STEPS)
    wait_for(lambda: stack.client.job(job["id"])["progress"]["step"] > 2, "the job is at work")
    return job


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


@pytest.mark.parametrize("stack", EMBEDDED_FIRST, indirect=True)
def test_a_bulk_run_goes_on_and_a_server_that_dies_takes_its_worker_along(
    stack: Stack, psf_file: Path
) -> None:
    bulk = archive_run(stack, psf_file, output=str(stack.data.parent / "out"))
    wait_for(lambda: done(stack, bulk) >= 2, "some are done", timeout_s=120)
    before = {row.position: row.ended_at for row in items(stack) if row.state == "done"}
    if stack.redis is None:
        stack.kill_workers()  # the service itself starts them again
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
    assert len({row.product_id for row in rows}) == len(list(stack.client.products())) == IMAGES
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


def test_a_job_of_a_killed_worker_is_done_once_by_another(
    served: Stack, tmp_path: Path, psf_file: Path
) -> None:
    if not served.worker_processes():
        served.start_worker()
    blobs = stored(served)
    job = large_job(served, tmp_path, psf_file)
    served.kill_workers()
    assert served.client.job(job["id"])["phase"] == "EXECUTING"
    served.start_worker()
    ended = served.client.wait(job, timeout_s=120)
    assert ended["attempt"] == 2
    products = [one["id"] for one in served.client.products()]
    assert products == [ended["result"].rpartition("/")[2]]
    assert len(stored(served) - blobs) == 5, "image, PSF, product, picture of the changes, thumbnail"


def stored(stack: Stack) -> set[Path]:
    """The stored files."""
    return {path for path in (stack.data / "blobs").rglob("*") if path.is_file()}


@pytest.mark.slow  # tests/workers/catalogue/test_waiting.py has the same without processes
def test_the_single_job_of_one_owner_does_not_wait_for_the_forty_of_another(served: Stack) -> None:
    if served.worker_processes():
        served.kill_workers()
    catalogue = served.catalogue()
    # Jobs that end at once: their PSF does not exist.
    for owner, count in (("many", 40), ("one", 1)):
        for number in range(count):
            catalogue.jobs.submit("psf-tables", {"psf_id": f"{number:064x}"}, f"{owner} {number}", owner)
    wait_for(lambda: not catalogue.jobs.unsubmitted(3600.0), "the broker has all jobs")
    served.start_worker()

    def rows() -> list[JobRow]:
        return [row for owner in ("many", "one") for row in catalogue.page(JobRow, owner=owner, limit=50)]

    wait_for(lambda: all(Phase(row.phase).ended for row in rows()), "all jobs end")
    starts = sorted((row.started_at or 0.0, row.owner) for row in rows())
    catalogue.close()
    assert len(starts) == 41
    assert "one" in [owner for _, owner in starts[:2]]


@pytest.mark.slow
@pytest.mark.parametrize("stack", EMBEDDED_FIRST, indirect=True)
def test_what_was_queued_while_everything_was_down_is_done(
    stack: Stack, tmp_path: Path, psf_file: Path
) -> None:
    psf_id = stack.client.upload_psf(psf_file)["id"]
    jobs = []
    for seed in range(3):
        write_image(tmp_path / f"{seed}.fits", seed=seed)
        image_id = stack.client.upload_image(tmp_path / f"{seed}.fits")["id"]
        jobs.append(stack.client.submit("deconvolve", image_id=image_id, psf_id=psf_id))
    stack.kill_everything()
    stack.start_server()
    if stack.redis is not None:
        stack.start_worker()
    for job in jobs:
        assert stack.client.wait(stack.client.job(job["id"]), timeout_s=120)["phase"] == "COMPLETED"
    assert len(list(stack.client.products())) == 3


@pytest.mark.slow  # tests/workers/catalogue has the fast cases of lost messages
@pytest.mark.parametrize("stack", [SERVED], indirect=True)
def test_a_broker_killed_at_work_costs_nothing(stack: Stack, tmp_path: Path, psf_file: Path) -> None:
    """The running job ends, the worker lives on, and what was queued meanwhile is done once Redis is back."""
    assert stack.redis is not None
    job = large_job(stack, tmp_path, psf_file)
    stack.redis.kill()
    few = {**job["parameters"]["method"], "steps": 3}
    inputs = {name: job["parameters"][name] for name in ("image_id", "psf_id")}
    meanwhile = stack.client.submit("deconvolve", **inputs, method=few)
    assert stack.client.wait(job, timeout_s=90)["attempt"] == 1
    stack.redis.start()
    assert stack.client.wait(meanwhile, timeout_s=120)["attempt"] == 1
    assert stack.workers[0].poll() is None


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
