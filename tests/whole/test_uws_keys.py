"""The UWS interface of a real service that asks for keys, used by pyvo with a session that sends one."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import pytest
import requests
from astropy.io import fits
from pyvo.dal import DALServiceError
from pyvo.dal.tap import AsyncTAPJob
from pyvo.io.uws import parse_job_list

from service.client.http import Client
from tests.conftest import SMALL_INSTRUMENT, write_image, write_psf
from tests.whole import stack as stacks
from tests.whole.stack import Stack, wait_for
from workers.catalogue.access.keys import Scope
from workers.catalogue.catalogue import Catalogue
from workers.settings import Settings

BUILD = {"KIND": "psf-build", "instrument_file": SMALL_INSTRUMENT, "size": "128"}


@pytest.fixture(scope="module")
def stack(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv("HELIOPSF_ACCESS", "keys")
        patched.delenv("HELIOPSF_KEY", raising=False)
        with stacks.embedded(tmp_path_factory.mktemp("keys")) as running:
            yield running


def key_of(stack: Stack, owner: str, *scopes: Scope) -> str:
    catalogue = Catalogue(Settings(data_dir=stack.data, database_url=None).catalogue_url)
    try:
        return catalogue.keys.make(owner, set(scopes))
    finally:
        catalogue.close()


def session_with(key: str, way: str = "bearer") -> requests.Session:
    session = requests.Session()
    if way == "bearer":
        session.headers["Authorization"] = f"Bearer {key}"
    else:
        session.auth = ("anybody", key)
    return session


def created(stack: Stack, session: requests.Session, **fields: str) -> AsyncTAPJob:
    answer = session.post(f"{stack.client.server}/uws/jobs", data=fields, timeout=60)
    answer.raise_for_status()
    return AsyncTAPJob(answer.url, session=session, delete=False)


@pytest.mark.parametrize("way", ["bearer", "basic"])
def test_create_run_wait_results_delete_with_a_key(stack: Stack, way: str) -> None:
    session = session_with(key_of(stack, f"astronomer-{way}", Scope.READ, Scope.SUBMIT), way)
    job = created(stack, session, **BUILD)
    assert (job.phase, job.owner) == ("PENDING", f"astronomer-{way}")
    job.execution_duration = 600
    assert job.run().wait(timeout=120).phase == "COMPLETED"
    job.raise_if_error()
    file = session.get(job.result_uri, timeout=60)
    with fits.open(io.BytesIO(file.content), checksum=True) as hdus:
        assert hdus[0].data.shape == (128, 128)
    (result,) = (one for one in job.results if one.id_ == "result")
    assert result.mimetype == "application/fits"
    assert requests.get(job.result_uri, timeout=60).status_code == 401, "the file needs the key too"
    url = job.url
    job.delete()
    assert session.get(url, timeout=60).status_code == 404
    jobs = session.get(f"{stack.client.server}/uws/jobs", timeout=60)
    assert list(parse_job_list(io.BytesIO(jobs.content))) == []


def test_abort_at_work_with_a_key(stack: Stack, tmp_path: Path) -> None:
    key = key_of(stack, "aborter", Scope.READ, Scope.SUBMIT)
    session = session_with(key)
    write_image(tmp_path / "image.fits", shape=(1024, 1024))
    write_psf(tmp_path / "psf.fits")
    with Client(stack.client.server, key=key) as client:
        image_id = client.upload_image(tmp_path / "image.fits")["id"]
        psf_id = client.upload_psf(tmp_path / "psf.fits")["id"]
        method = '{"name": "richardson-lucy", "steps": 200}'
        job = created(stack, session, KIND="deconvolve", image_id=image_id, psf_id=psf_id, method=method)
        job.run()
        wait_for(lambda: client.job(job.job_id)["progress"]["step"] > 2, "the job is at work")
        job.abort()
        with pytest.raises(DALServiceError, match="not active"):  # how pyvo says that it was aborted
            job.wait(timeout=60)
        assert job.phase == "ABORTED" and job.result is None
        assert list(client.products()) == []
    job.delete()


def test_without_a_good_key_pyvo_gets_nothing(stack: Stack) -> None:
    owner = session_with(key_of(stack, "owner", Scope.READ, Scope.SUBMIT))
    job = created(stack, owner, **BUILD)
    for session, status, said in (
        (requests.Session(), 401, "expected a key"),
        (session_with("hpsf_" + 16 * "0" + "_" + 43 * "A"), 401, "key"),
        (
            session_with(key_of(stack, "other", Scope.READ, Scope.SUBMIT)),
            404,
            "expected the id of one of your jobs",
        ),
    ):
        with pytest.raises(DALServiceError, match=said) as refused:
            AsyncTAPJob(job.url, session=session, delete=False)
        assert refused.value.code == status
    reads = session_with(key_of(stack, "owner", Scope.READ))
    seen = AsyncTAPJob(job.url, session=reads, delete=False)
    assert seen.phase == "PENDING"
    for act in (seen.run, seen.abort, seen.delete):
        with pytest.raises(DALServiceError, match="'submit'") as refused:
            act()
        assert refused.value.code == 403
    assert job.phase == "PENDING"
    job.delete()
