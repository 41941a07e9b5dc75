"""The UWS interface of a real service, used by the client that astronomers use: pyvo."""

from __future__ import annotations

import io
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import requests
from astropy.io import fits
from astropy.time import Time
from pyvo.dal import DALQueryError, DALServiceError
from pyvo.dal.tap import AsyncTAPJob
from pyvo.io.uws import parse_job_list

from service.client.http import ServiceError
from tests.conftest import SMALL_INSTRUMENT, write_image
from tests.whole import stack as stacks
from tests.whole.stack import Stack, wait_for

BUILD = {"KIND": "psf-build", "instrument_file": SMALL_INSTRUMENT, "size": "128", "RUNID": "<small> & quick"}


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    with stacks.embedded(tmp_path_factory.mktemp("uws")) as running:
        yield running


def created(stack: Stack, **fields: str) -> AsyncTAPJob:
    """A job as pyvo holds it: at the address that the creation led to."""
    answer = requests.post(f"{stack.client.server}/uws/jobs", data=fields, timeout=60)
    answer.raise_for_status()
    assert answer.history[0].status_code == 303
    return AsyncTAPJob(answer.url, delete=False)


def listed(stack: Stack, **filters: object) -> list[str]:
    answer = requests.get(f"{stack.client.server}/uws/jobs", params=filters, timeout=60)
    return [job.jobid for job in parse_job_list(io.BytesIO(answer.content))]


def long_job(stack: Stack, folder: Path, psf_file: Path, **more: str) -> AsyncTAPJob:
    """A job that takes long enough for something to happen to it, at work."""
    write_image(folder / "image.fits", shape=(1024, 1024), seed=int(more.pop("seed", "1")))
    image_id = stack.client.upload_image(folder / "image.fits")["id"]
    psf_id = stack.client.upload_psf(psf_file)["id"]
    method = '{"name": "richardson-lucy", "steps": 200}'
    job = created(stack, KIND="deconvolve", image_id=image_id, psf_id=psf_id, method=method, **more)
    job.run()
    wait_for(lambda: stack.client.job(job.job_id)["progress"]["step"] > 2, "the job is at work")
    return job


def test_create_run_wait_results_delete(stack: Stack) -> None:
    before = Time.now()
    job = created(stack, **BUILD)
    assert (job.phase, job.uws_version, job.owner) == ("PENDING", "1.1", "local")
    assert job.job.runid == BUILD["RUNID"]
    assert {p.id_: p.content for p in job.job.parameters}[
        "instrument_file"
    ].strip() == SMALL_INSTRUMENT.strip()
    assert abs((job.job.creationtime - before).sec) < 60 and job.destruction > before
    assert job.quote is None and job.job.starttime is None and list(job.results) == []
    job.execution_duration = 600
    assert job.execution_duration.sec == 600
    job.destruction = "2999-01-01T00:00:00.000Z"
    assert job.destruction.datetime.year < 2999, "clipped"

    with pytest.raises(ServiceError, match="not started"):
        stack.client.wait(stack.client.job(job.job_id))
    assert job.run().wait(timeout=120).phase == "COMPLETED"
    job.raise_if_error()
    assert job.job.starttime <= job.job.endtime
    assert job.result.mimetype == "application/fits"
    for address in (job.result_uri, f"{job.url}/results/result"):
        with fits.open(io.BytesIO(requests.get(address, timeout=60).content), checksum=True) as hdus:
            assert hdus[0].data.shape == (128, 128)
    assert stack.client.job(job.job_id)["phase"] == "COMPLETED", "the JSON interface has the same job"

    assert listed(stack, LAST=1) == [job.job_id] and job.job_id in listed(stack, PHASE=["COMPLETED", "ERROR"])
    assert listed(stack, AFTER=job.job.creationtime.isot + "Z") == []
    url = job.url
    job.delete()
    assert requests.get(url, timeout=60).status_code == 404
    assert listed(stack) == []
    assert len(list(stack.client.psfs())) == 1, "what it made stays"


def test_a_failed_job_says_why(stack: Stack) -> None:
    masked = (
        SMALL_INSTRUMENT + '[mount]\nbasis = "drawing"\nmask_image = { file = "a.png", width_mm = 4.0 }\n'
    )
    job = created(stack, KIND="psf-build", instrument_file=masked, size="128", PHASE="RUN")
    assert job.wait(timeout=120).phase == "ERROR"
    with pytest.raises(DALQueryError, match=r"a\.png"):
        job.raise_if_error()
    assert "(mask-missing, fault: user)" in requests.get(f"{job.url}/error", timeout=60).text


def test_abort_at_work(stack: Stack, tmp_path: Path, psf_file: Path) -> None:
    job = long_job(stack, tmp_path, psf_file)
    job.abort()
    with pytest.raises(DALServiceError, match="not active"):  # how pyvo says that it was aborted
        job.wait(timeout=60)
    assert job.phase == "ABORTED" and job.result is None
    job.abort()
    assert job.phase == "ABORTED"


def test_delete_at_work_stops_the_worker(stack: Stack, tmp_path: Path, psf_file: Path) -> None:
    job = long_job(stack, tmp_path, psf_file, seed="2")
    job.delete()
    after = created(stack, **BUILD, PHASE="RUN")
    assert after.wait(timeout=60).phase == "COMPLETED", "the worker is free again"
    assert list(stack.client.products()) == []


def test_a_job_that_executes_too_long_is_aborted_and_one_that_is_due_is_destroyed(
    stack: Stack, tmp_path: Path, psf_file: Path
) -> None:
    soon = Time(time.time() + 1.5, format="unix").isot + "Z"
    due = created(stack, **BUILD, DESTRUCTION=soon)
    job = long_job(stack, tmp_path, psf_file, seed="3", EXECUTIONDURATION="1")
    wait_for(lambda: job.phase == "ABORTED", "the job is aborted", 60)
    wait_for(lambda: due.job_id not in listed(stack), "the job is destroyed", 60)


def test_who_waits_does_not_keep_the_service_from_stopping(tmp_path: Path) -> None:
    with stacks.alone(tmp_path) as stack:
        job = created(stack, **BUILD)
        assert stack.server is not None
        answers: list[requests.Response] = []
        waiting = threading.Thread(
            target=lambda: answers.append(requests.get(job.url, params={"WAIT": "-1"}, timeout=60))
        )
        waiting.start()
        time.sleep(1.5)  # until the request is surely there
        started = time.monotonic()
        stack.server.terminate()
        waiting.join()
        assert time.monotonic() - started < 30  # the request itself would wait for 60 s
        assert answers[0].status_code == 200 and b"PENDING" in answers[0].content
