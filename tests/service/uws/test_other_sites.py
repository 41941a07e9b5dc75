"""Forms of UWS that a page of another site sends, and documents as vo-models reads them."""

from __future__ import annotations

from pathlib import Path

from fastapi.testclient import TestClient
from pydantic_xml import BaseXmlModel, element
from vo_models.uws import Jobs, JobSummary, Parameter, Results
from vo_models.uws.types import ExecutionPhase

from tests.service.conftest import refusal
from tests.service.keyed import Keyed
from tests.service.uws.test_uws import BUILD, JOBS, created, post
from tests.service.vo.made import add_product

FOREIGN = [
    {"Origin": "http://evil.example"},
    {"Origin": "null"},
    {"Sec-Fetch-Site": "cross-site"},
    {"Sec-Fetch-Site": "same-site", "Origin": "http://testserver"},
]


class _Parameters(
    BaseXmlModel, tag="parameters", ns="uws", nsmap={"uws": "http://www.ivoa.net/xml/UWS/v1.0"}
):
    """The parameters of a job, whatever their names."""

    parameter: list[Parameter] = element(tag="parameter", default_factory=list)


def test_no_form_of_another_site_changes_a_job(api: TestClient) -> None:
    job = created(api, **BUILD)
    before = api.get(job).content
    forms = (
        (JOBS, BUILD),
        (job, {"ACTION": "DELETE"}),
        (f"{job}/phase", {"PHASE": "RUN"}),
        (f"{job}/phase", {"PHASE": "ABORT"}),
        (f"{job}/parameters", {"size": "256"}),
        (f"{job}/executionduration", {"EXECUTIONDURATION": "1"}),
        (f"{job}/destruction", {"DESTRUCTION": "2027-01-01T00:00:00Z"}),
    )
    for headers in FOREIGN:
        for address, fields in forms:
            urlencoded = api.post(address, data=fields, headers=headers, follow_redirects=False)
            parts = {name: (None, value) for name, value in fields.items()}
            multipart = api.post(address, files=parts, headers=headers, follow_redirects=False)
            for answer in (urlencoded, multipart):
                refusal(answer, 403, "cross-site")
        assert api.delete(job, headers=headers, follow_redirects=False).status_code == 403
    assert api.get(job).content == before
    assert len(Jobs.from_xml(api.get(JOBS).content).jobref or []) == 1, "no job was added"


def test_a_stored_password_does_not_help_another_site(service: Keyed) -> None:
    """A browser adds the password of HTTP Basic by itself, also to a form of another site."""
    service.api.auth = ("anybody", service.key("owner"))
    for headers in FOREIGN:
        refused = service.api.post(JOBS, data=BUILD, headers=headers, follow_redirects=False)
        assert refused.status_code == 403
    assert post(service.api, JOBS, **BUILD).status_code == 303, "a program sends neither header"


def test_vo_models_reads_the_documents(api: TestClient, tmp_path: Path) -> None:
    ids = add_product(api, tmp_path)
    pending = created(api, RUNID="<mine> & yours", **BUILD)
    listed = Jobs.from_xml(api.get(JOBS).content)
    assert {one.phase for one in listed.jobref or []} == {ExecutionPhase.PENDING, ExecutionPhase.COMPLETED}
    waiting = JobSummary[_Parameters].from_xml(api.get(pending).content)
    assert (waiting.run_id, waiting.owner_id, waiting.quote) == ("<mine> & yours", "local", None)
    assert {one.id: one.value for one in waiting.parameters.parameter}["KIND"] == "psf-build"  # type: ignore[union-attr]
    done = JobSummary[_Parameters].from_xml(api.get(f"{JOBS}/{ids['job']}").content)
    assert done.start_time is not None and done.end_time is not None and done.end_time > done.start_time
    results = Results.from_xml(api.get(f"{JOBS}/{ids['job']}/results").content)
    for one in results.results or []:
        assert api.get(str(one.href)).headers["content-type"] == one.mime_type
