"""pyvo from a list of products to its files, on a real service with keys: what an archive or an astronomer does.
The UWS interface of a real service that asks for keys, used by the client that astronomers use: pyvo."""

from __future__ import annotations

import io
import uuid

import numpy as np
import prov
import pytest
import requests
from astropy.io import fits
from pyvo.dal import DALServiceError
from pyvo.dal.adhoc import DatalinkQuery, DatalinkResults
from pyvo.dal.query import DALResults
from pyvo.dal.tap import AsyncTAPJob
from pyvo.io.uws import parse_job_list

from service.client.http import Client, ServiceError
from tests.conftest import SMALL_INSTRUMENT, write_image, write_psf
from tests.service.vo.made import OBSERVED, WCS_CARDS
from tests.whole.stack import Stack
from workers.catalogue.access import Scope


@pytest.fixture(scope="module")
def session(keyed_stack: Stack, tmp_path_factory: pytest.TempPathFactory) -> requests.Session:
    """A session that sends a key as a password, as TOPCAT does, whose owner has one product."""
    folder = tmp_path_factory.mktemp("images")
    key = keyed_stack.key("astronomer-of-products", Scope.READ, Scope.SUBMIT)
    write_image(folder / "image.fits", **OBSERVED, **WCS_CARDS)
    write_psf(folder / "psf.fits")
    with Client(keyed_stack.client.server, key=key) as client:
        psf = client.upload_psf(folder / "psf.fits")
        # The test's PSF names no instrument; only the request connects it with the image.
        client.deconvolve(
            folder / "image.fits", folder / "sharp.fits", psf_id=psf["id"], method="linear", steps=2
        )
    session = requests.Session()
    session.auth = ("anybody", key)
    return session


@pytest.mark.slow
def test_from_the_list_to_the_file_its_input_its_psf_and_its_provenance(
    keyed_stack: Stack, session: requests.Session
) -> None:
    products = DALResults.from_result_url(f"{keyed_stack.client.server}/vo/products", session=session)
    [product] = products
    assert product["instrument_name"] == "HRI_EUV" and product["method"] == "linear"
    table = DatalinkResults.from_result_url(str(product["access_url"]), session=session)
    by_name = {str(link["local_semantics"]): link for link in table}
    for name, count in (("file", 2), ("input", 1), ("psf", 1)):
        content = session.get(by_name[name].access_url, timeout=60).content
        assert len(content) == by_name[name].content_length
        with fits.open(io.BytesIO(content)) as hdus:
            assert len(hdus) == count
    assert {link.semantics for link in table.bysemantics("#progenitor", include_narrower=False)} == {
        "#progenitor"
    }
    document = prov.read(session.get(by_name["provenance"].access_url, timeout=60).content)
    name = str(product["obs_publisher_did"]).removeprefix("urn:heliopsf:")
    assert len(document.get_record(name)) == 1

    [row] = [link for link in table if link.service_def == "cutout"]
    cutout = DatalinkQuery.from_resource(row, table.get_adhocservice_by_id("cutout"), session=session)
    cutout["CIRCLE"], cutout["FRAME"] = "100 -50 4", "helioprojective"
    answer = session.get(cutout.queryurl, params=dict(cutout), timeout=60)
    with fits.open(io.BytesIO(answer.content)) as hdus:
        assert hdus[0].shape == (17, 17) and np.isfinite(hdus[0].data).all()


# --- UWS -------------------------------------------------------------------------------------------------


UWS_BUILD = {
    "KIND": "psf-build",
    "instrument_file": SMALL_INSTRUMENT,
    "size": "128",
    "RUNID": "<small> & quick",
}


def test_create_run_wait_results_delete(keyed_stack: Stack) -> None:
    name, server = f"astronomer-{uuid.uuid4().hex[:8]}", keyed_stack.client.server
    key = keyed_stack.key(name, Scope.READ, Scope.SUBMIT)
    session = requests.Session()
    session.headers["Authorization"] = f"Bearer {key}"

    def created() -> AsyncTAPJob:
        """A job as pyvo holds it: at the address that the creation led to."""
        answer = session.post(f"{server}/uws/jobs", data=UWS_BUILD, timeout=60)
        assert answer.history and answer.history[0].status_code == 303, answer.text
        return AsyncTAPJob(answer.url, session=session, delete=False)

    def listed(**filters: object) -> list[str]:
        answer = session.get(f"{server}/uws/jobs", params=filters, timeout=60)
        return [job.jobid for job in parse_job_list(io.BytesIO(answer.content))]

    job, other = created(), created()
    assert (job.phase, job.uws_version, job.owner) == ("PENDING", "1.1", name)
    assert job.job.runid == UWS_BUILD["RUNID"]
    file = {one.id_: one.content for one in job.job.parameters}["instrument_file"]
    assert file.strip() == SMALL_INSTRUMENT.strip()
    assert job.quote is None and job.job.starttime is None and list(job.results) == []
    job.execution_duration = 600
    assert job.execution_duration.sec == 600
    job.destruction = "2999-01-01T00:00:00.000Z"
    assert job.destruction.datetime.year < 2999, "clipped"
    other.abort()
    assert other.phase == "ABORTED" and other.result is None

    with Client(server, key=key) as client:
        with pytest.raises(ServiceError, match="not started"):
            client.wait(client.job(job.job_id))
        assert job.run().wait(timeout=120).phase == "COMPLETED"
        assert client.job(job.job_id)["phase"] == "COMPLETED", "the JSON interface has the same job"
    job.raise_if_error()
    assert job.job.starttime <= job.job.endtime
    assert job.result.mimetype == "application/fits"
    for address in (job.result_uri, f"{job.url}/results/result"):
        content = session.get(address, timeout=60).content
        with fits.open(io.BytesIO(content), checksum=True) as hdus:
            assert hdus[0].data.shape == (128, 128)
    assert listed(PHASE=["COMPLETED", "ERROR"]) == [job.job_id]
    # The file needs the key too, which TOPCAT sends as a password.
    assert requests.get(job.result_uri, timeout=60).status_code == 401
    assert requests.get(job.result_uri, auth=("anybody", key), timeout=60).status_code == 200
    url = job.url
    job.delete()
    assert session.get(url, timeout=60).status_code == 404 and listed() == [other.job_id]
    with pytest.raises(DALServiceError) as refused:
        AsyncTAPJob(other.url, session=requests.Session(), delete=False)
    assert refused.value.code == 401
