"""The UWS interface of a real service that asks for keys, used by the client that astronomers use: pyvo."""

from __future__ import annotations

import io
import time
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import requests
from astropy.io import fits
from astropy.time import Time
from pyvo.dal import DALQueryError, DALServiceError
from pyvo.dal.tap import AsyncTAPJob
from pyvo.io.uws import parse_job_list

from service.client.http import Client, ServiceError
from tests.conftest import SMALL_INSTRUMENT, write_image
from tests.whole.stack import Stack, wait_for
from workers.catalogue.access import Scope

BUILD = {"KIND": "psf-build", "instrument_file": SMALL_INSTRUMENT, "size": "128", "RUNID": "<small> & quick"}


@dataclass(frozen=True)
class Astronomer:
    """An owner of the shared service, with a key, a session of pyvo that sends it, and a client of the JSON interface."""

    name: str
    key: str
    session: requests.Session
    client: Client

    def created(self, **fields: str) -> AsyncTAPJob:
        """A job as pyvo holds it: at the address that the creation led to."""
        answer = self.session.post(f"{self.client.server}/uws/jobs", data=fields, timeout=60)
        assert answer.history and answer.history[0].status_code == 303, answer.text
        return AsyncTAPJob(answer.url, session=self.session, delete=False)


@pytest.fixture
def astronomer(keyed_stack: Stack) -> Iterator[Astronomer]:
    name = f"astronomer-{uuid.uuid4().hex[:8]}"
    key = keyed_stack.key(name, Scope.READ, Scope.SUBMIT)
    with Client(keyed_stack.client.server, key=key) as client:
        yield Astronomer(name, key, session_with(key), client)


def session_with(key: str) -> requests.Session:
    session = requests.Session()
    session.headers["Authorization"] = f"Bearer {key}"
    return session


def listed(astronomer: Astronomer, **filters: object) -> list[str]:
    address = f"{astronomer.client.server}/uws/jobs"
    answer = astronomer.session.get(address, params=filters, timeout=60)
    return [job.jobid for job in parse_job_list(io.BytesIO(answer.content))]


def long_job(astronomer: Astronomer, folder: Path, psf_file: Path) -> AsyncTAPJob:
    """A job that takes long enough for something to happen to it, at work."""
    job = started_long_job(astronomer, folder, psf_file)
    wait_for(lambda: astronomer.client.job(job.job_id)["progress"]["step"] > 2, "the job is at work")
    return job


def started_long_job(astronomer: Astronomer, folder: Path, psf_file: Path, **more: str) -> AsyncTAPJob:
    write_image(folder / "image.fits", shape=(1024, 1024))
    image_id = astronomer.client.upload_image(folder / "image.fits")["id"]
    psf_id = astronomer.client.upload_psf(psf_file)["id"]
    method = '{"name": "richardson-lucy", "steps": 200}'
    job = astronomer.created(KIND="deconvolve", image_id=image_id, psf_id=psf_id, method=method, **more)
    job.run()
    return job


def test_create_run_wait_results_delete(astronomer: Astronomer) -> None:
    before = Time.now()
    job = astronomer.created(**BUILD)
    assert (job.phase, job.uws_version, job.owner) == ("PENDING", "1.1", astronomer.name)
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
        astronomer.client.wait(astronomer.client.job(job.job_id))
    assert job.run().wait(timeout=120).phase == "COMPLETED"
    job.raise_if_error()
    assert job.job.starttime <= job.job.endtime
    assert job.result.mimetype == "application/fits"
    for address in (job.result_uri, f"{job.url}/results/result"):
        with fits.open(
            io.BytesIO(astronomer.session.get(address, timeout=60).content), checksum=True
        ) as hdus:
            assert hdus[0].data.shape == (128, 128)
    assert astronomer.client.job(job.job_id)["phase"] == "COMPLETED", "the JSON interface has the same job"

    assert listed(astronomer, LAST=1) == [job.job_id] and job.job_id in listed(
        astronomer, PHASE=["COMPLETED", "ERROR"]
    )
    assert listed(astronomer, AFTER=job.job.creationtime.isot + "Z") == []
    assert requests.get(job.result_uri, timeout=60).status_code == 401, "the file needs the key too"
    url = job.url
    job.delete()
    assert astronomer.session.get(url, timeout=60).status_code == 404
    assert listed(astronomer) == []
    assert len(list(astronomer.client.psfs())) == 1, "what it made stays"


def test_a_failed_job_says_why(astronomer: Astronomer) -> None:
    masked = (
        SMALL_INSTRUMENT + '[mount]\nbasis = "drawing"\nmask_image = { file = "a.png", width_mm = 4.0 }\n'
    )
    job = astronomer.created(KIND="psf-build", instrument_file=masked, size="128", PHASE="RUN")
    assert job.wait(timeout=120).phase == "ERROR"
    with pytest.raises(DALQueryError, match=r"a\.png"):
        job.raise_if_error()
    assert "(mask-missing, fault: user)" in astronomer.session.get(f"{job.url}/error", timeout=60).text


def test_abort_at_work(astronomer: Astronomer, tmp_path: Path, psf_file: Path) -> None:
    job = long_job(astronomer, tmp_path, psf_file)
    job.abort()
    with pytest.raises(DALServiceError, match="not active"):  # how pyvo says that it was aborted
        job.wait(timeout=60)
    assert job.phase == "ABORTED" and job.result is None
    job.abort()
    assert job.phase == "ABORTED"
    assert list(astronomer.client.products()) == []


@pytest.mark.slow  # tests/workers/catalogue/test_uws_jobs.py: a worker loses the lease of a job that is destroyed
def test_delete_at_work_stops_the_worker(astronomer: Astronomer, tmp_path: Path, psf_file: Path) -> None:
    job = long_job(astronomer, tmp_path, psf_file)
    job.delete()
    after = astronomer.created(**BUILD, PHASE="RUN")
    assert after.wait(timeout=60).phase == "COMPLETED", "the worker is free again"
    assert list(astronomer.client.products()) == []


@pytest.mark.slow  # tests/workers/catalogue/test_uws_jobs.py: the terms of jobs end them
def test_a_job_that_executes_too_long_is_aborted_and_one_that_is_due_is_destroyed(
    astronomer: Astronomer, tmp_path: Path, psf_file: Path
) -> None:
    soon = Time(time.time() + 1.5, format="unix").isot + "Z"
    due = astronomer.created(**BUILD, DESTRUCTION=soon)
    job = started_long_job(astronomer, tmp_path, psf_file, EXECUTIONDURATION="1")
    wait_for(lambda: job.phase == "ABORTED", "the job is aborted", 60)
    wait_for(lambda: due.job_id not in listed(astronomer), "the job is destroyed", 60)


def test_without_a_good_key_pyvo_gets_nothing(keyed_stack: Stack, astronomer: Astronomer) -> None:
    job = astronomer.created(**BUILD)
    for session, status, said in (
        (requests.Session(), 401, "expected a key"),
        (session_with("hpsf_" + 16 * "0" + "_" + 43 * "A"), 401, "key"),
        (session_with(keyed_stack.key("other")), 404, "expected the id of one of your jobs"),
    ):
        with pytest.raises(DALServiceError, match=said) as refused:
            AsyncTAPJob(job.url, session=session, delete=False)
        assert refused.value.code == status
    reads = session_with(keyed_stack.key(astronomer.name, Scope.READ))
    seen = AsyncTAPJob(job.url, session=reads, delete=False)
    assert seen.phase == "PENDING"
    basic = requests.Session()
    basic.auth = ("anybody", astronomer.key)  # as TOPCAT sends it
    assert AsyncTAPJob(job.url, session=basic, delete=False).phase == "PENDING"
    for act in (seen.run, seen.abort, seen.delete):
        with pytest.raises(DALServiceError, match="'submit'") as refused:
            act()
        assert refused.value.code == 403
    assert job.phase == "PENDING"
    job.delete()
