"""UWS 1.1 over the same jobs: its life of a job, its documents, and one table of bad requests."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable
from pathlib import Path
from urllib.parse import urlencode
from xml.etree import ElementTree

import httpx
import pytest
from fastapi.testclient import TestClient

from service.app import create_app
from service.vo import jobs as uws
from tests.conftest import SMALL_INSTRUMENT
from tests.service.conftest import upload
from tests.service.serving import in_own_loop
from workers.catalogue.catalogue import Catalogue
from workers.settings import Settings

JOBS = "/uws/jobs"
NAMES = {
    "uws": "http://www.ivoa.net/xml/UWS/v1.0",
    "xlink": "http://www.w3.org/1999/xlink",
    "xsi": "http://www.w3.org/2001/XMLSchema-instance",
}
HREF, NIL = f"{{{NAMES['xlink']}}}href", f"{{{NAMES['xsi']}}}nil"
# The order that the schema demands, of those that are always there.
JOB_ELEMENTS = [
    "jobId",
    "ownerId",
    "phase",
    "quote",
    "creationTime",
    "startTime",
    "endTime",
    "executionDuration",
    "destruction",
    "parameters",
    "results",
]
BUILD = {"KIND": "psf-build", "instrument_file": SMALL_INSTRUMENT, "size": "128"}


def document(answer: httpx.Response) -> ElementTree.Element:
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "application/xml"
    return ElementTree.fromstring(answer.content)


def text(element: ElementTree.Element, name: str) -> str | None:
    found = element.find(f"uws:{name}", NAMES)
    assert found is not None, name
    return found.text


def local_names(element: ElementTree.Element) -> list[str]:
    assert all(child.tag.startswith(f"{{{NAMES['uws']}}}") for child in element)
    return [child.tag.partition("}")[2] for child in element]


def parameters(job: ElementTree.Element) -> dict[str, str | None]:
    return {p.attrib["id"]: p.text for p in job.iterfind(".//uws:parameter", NAMES)}


def post(api: TestClient, address: str, **fields: str) -> httpx.Response:
    return api.post(address, data=fields, follow_redirects=False)


def created(api: TestClient, **fields: str) -> str:
    """A job's address."""
    answer = post(api, JOBS, **fields)
    assert answer.status_code == 303, answer.text
    return answer.headers["location"]


def test_a_job_s_life(
    api: TestClient, run_jobs: Callable[[], None], image_file: Path, psf_file: Path
) -> None:
    image_id, psf_id = upload(api, image_file), upload(api, psf_file, "/v1/psfs")
    job = created(api, KIND="deconvolve", RUNID="mine")
    assert job.startswith("http://testserver/uws/jobs/")

    pending = document(api.get(job))
    assert pending.tag == f"{{{NAMES['uws']}}}job" and pending.attrib["version"] == "1.1"
    assert [n for n in local_names(pending) if n != "runId"] == JOB_ELEMENTS
    assert (text(pending, "phase"), text(pending, "runId")) == ("PENDING", "mine")
    assert text(pending, "ownerId") == api.get(f"{job}/owner").text == "local"
    created_at = text(pending, "creationTime")
    assert created_at is not None and created_at.endswith("Z") and "T" in created_at
    for unknown in ("startTime", "endTime", "quote"):
        found = pending.find(f"uws:{unknown}", NAMES)
        assert found is not None and found.attrib == {NIL: "true"} and found.text is None
    assert len(document(api.get(f"{job}/results"))) == 0

    # It may be set up bit by bit, and is judged when it runs.
    run_jobs()
    assert api.get(f"{job}/phase").text == "PENDING", "nobody told it to run"
    missing = post(api, f"{job}/phase", PHASE="RUN")
    assert missing.status_code == 400 and "image_id: expected a value" in missing.text
    post(api, f"{job}/parameters", image_id="0" * 64)
    unknown_image = post(api, f"{job}/phase", PHASE="RUN")
    assert unknown_image.status_code == 400 and "the id of one of your images" in unknown_image.text
    assert unknown_image.headers["content-type"].startswith("text/plain")
    assert api.get(f"{job}/phase").text == "PENDING"
    method = '{"name": "linear", "steps": 2}'
    changed = post(api, f"{job}/parameters", image_id=image_id, PSF_ID=psf_id, method=method, error_draws="0")
    assert (changed.status_code, changed.headers["location"]) == (303, job)
    assert parameters(document(api.get(f"{job}/parameters")))["method"] == method

    started = post(api, f"{job}/phase", PHASE="RUN")
    assert (started.status_code, started.headers["location"]) == (303, job)
    assert api.get(f"{job}/phase").text == "QUEUED"
    resolved = parameters(document(api.get(f"{job}/parameters")))
    assert (resolved["KIND"], resolved["psf_id"], resolved["error_draws"]) == ("deconvolve", psf_id, "0")
    assert '"stop": "fixed"' in (resolved["method"] or "")

    run_jobs()
    done = document(api.get(job))
    assert text(done, "phase") == "COMPLETED"
    assert (text(done, "startTime") or "") <= (text(done, "endTime") or "")
    listed = {r.attrib["id"]: r.attrib for r in document(api.get(f"{job}/results"))}
    assert set(listed) == {"result", "description"}
    assert listed["result"]["mime-type"] == "application/fits"
    to_file = api.get(f"{job}/results/result", follow_redirects=False)
    assert (to_file.status_code, to_file.headers["location"]) == (303, listed["result"][HREF])
    file = api.get(listed["result"][HREF])
    assert file.content.startswith(b"SIMPLE  =") and file.headers["content-type"] == "application/fits"
    assert api.get(listed["description"][HREF]).json()["psf_id"] == psf_id

    row = api.get(f"/v1/jobs/{job[-32:]}").json()
    assert row["phase"] == "COMPLETED", "the JSON interface has the same jobs"
    gone = api.delete(job, follow_redirects=False)
    assert (gone.status_code, gone.headers["location"]) == (303, "http://testserver/uws/jobs")
    assert api.get(job).status_code == api.delete(job, follow_redirects=False).status_code == 404
    assert api.get(row["result"]).status_code == 200, "what it made stays"


def test_what_went_wrong(api: TestClient, run_jobs: Callable[[], None]) -> None:
    masked = (
        SMALL_INSTRUMENT + '[mount]\nbasis = "drawing"\nmask_image = { file = "mask.png", width_mm = 4.0 }\n'
    )
    job = created(api, KIND="psf-build", instrument_file=masked, size="128", phase="RUN")
    assert api.get(f"{job}/error").status_code == 404
    run_jobs()
    summary = document(api.get(job)).find("uws:errorSummary", NAMES)
    assert summary is not None and summary.attrib == {"type": "fatal", "hasDetail": "true"}
    assert "mask.png" in (text(summary, "message") or "")
    error = api.get(f"{job}/error")
    assert error.headers["content-type"].startswith("text/plain")
    assert "mask.png" in error.text and "(mask-missing, fault: user)" in error.text
    assert api.get(f"{job}/results/result").status_code == 404


def test_true_and_false_are_read_where_only_one_is_allowed(shared_api: TestClient) -> None:
    created(shared_api, KIND="cross-validate", transit_id="0" * 64, as_published="false", runs="3")
    created(shared_api, KIND="report", transit_id="0" * 64, dark_offsets="false", psf_id="null")


BAD_CREATIONS = [
    ("unknown KIND", {"KIND": "<rm -rf>"}, "got '<rm -rf>'"),
    ("unknown parameter", BUILD | {"colour": "red"}, "colour: there is no such field"),
    ("odd size", BUILD | {"size": "127"}, "size: Input should be a multiple of 2; got 127"),
    ("not JSON", {"KIND": "deconvolve", "method": "{linear"}, "method: "),
    ("NaN in JSON", {"KIND": "deconvolve", "noise": '{"photon_gain_dn": NaN, "read_noise_dn": 1}'}, "noise: "),
    ("missing inside", {"KIND": "deconvolve", "noise": '{"photon_gain_dn": 1}'}, "noise/read_noise_dn"),
    ("no XML", BUILD | {"instrument_file": "a\x00b"}, "characters that XML can hold"),
    ("RUNID too long", BUILD | {"RUNID": "a" * 300}, "RUNID"),
    ("PHASE", BUILD | {"PHASE": "NONSENSE"}, "expected PHASE=RUN or no PHASE; got 'NONSENSE'"),
    ("destruction", BUILD | {"DESTRUCTION": "2001-01-01"}, "a time in the future"),
    ("incomplete and RUN", {"KIND": "deconvolve", "PHASE": "RUN"}, "image_id: expected a value"),
    ("a misspelt KIND", {"KIND": "reprot"}, "did you mean 'report'?"),
]  # fmt: skip


def test_bad_creations(shared_api: TestClient) -> None:
    before = shared_api.get(JOBS).content
    for name, fields, told in BAD_CREATIONS:
        answer = post(shared_api, JOBS, **fields)
        assert answer.status_code == 400 and told in answer.text, (name, answer.text)
        assert answer.headers["content-type"].startswith("text/plain") and len(answer.text) < 2000, name
        assert shared_api.get(JOBS).content == before, f"{name}: nothing is left behind"


BAD_REQUESTS = [
    ("GET", "?WAIT=abc", {}, 400, "expected WAIT, a whole number of -1 or more; got 'abc'"),
    ("GET", "?WAIT=1&wait=2", {}, 400, "expected WAIT once"),
    ("GET", "?WAIT=1&PHASE=NONSENSE", {}, 400, "expected PHASE, one of ABORTED"),
    ("POST", "", {"ACTION": "RUN"}, 400, "expected ACTION=DELETE"),
    ("POST", "/phase", {"PHASE": "NONSENSE"}, 400, "expected PHASE=RUN or PHASE=ABORT, got 'NONSENSE'"),
    ("POST", "/executionduration", {"EXECUTIONDURATION": "long"}, 400, "got 'long'"),
    ("POST", "/executionduration", {}, 400, "expected the field EXECUTIONDURATION"),
    ("POST", "/destruction", {"DESTRUCTION": "soon"}, 400, "expected DESTRUCTION, a time such as"),
    ("POST", "/destruction", {"DESTRUCTION": "1999-01-01T00:00:00Z"}, 400, "a time in the future"),
    ("POST", "/parameters", {"KIND": "report"}, 400, "expected KIND=psf-build"),
    ("GET", "/results/result", {}, 404, "has no result"),
    ("GET", "/error", {}, 404, "and has none"),
]


def test_bad_requests(shared_api: TestClient) -> None:
    job = created(shared_api, **BUILD)
    before = shared_api.get(job).content
    for method, address, fields, status, told in BAD_REQUESTS:
        body = {"data": fields} if method == "POST" else {}
        answer = shared_api.request(method, job + address, follow_redirects=False, **body)
        case = (method, address, fields, answer.text)
        assert (answer.status_code, answer.headers["content-type"][:10]) == (status, "text/plain"), case
        assert told in answer.text, case
        assert shared_api.get(job).content == before, "nothing has changed"


def test_the_list_and_its_filters(api: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    jobs = []
    for size in (64, 128, 256):
        jobs.append(created(api, **BUILD | {"size": str(size), "RUNID": f"<{size}>&"}))
        time.sleep(0.003)  # the times in the list have milliseconds
    post(api, f"{jobs[1]}/phase", PHASE="RUN")
    post(api, f"{jobs[2]}/phase", PHASE="ABORT")
    by_json = api.post("/v1/jobs", json={"kind": "psf-build", "parameters": {"instrument": "hri_euv"}}).json()

    def ids(query: str = "") -> list[str]:
        return [line.attrib["id"] for line in document(api.get(JOBS + query))]

    everything = [by_json["id"], *(job[-32:] for job in reversed(jobs))]
    assert ids() == everything, "newest first"
    assert ids("?LAST=2") == everything[:2] and ids("?last=99999999999999") == everything
    assert ids("?PHASE=QUEUED") == [everything[0], everything[2]]
    assert ids("?PHASE=QUEUED&PHASE=ABORTED") == everything[:3]
    assert ids("?PHASE=ARCHIVED") == []
    assert ids("?PHASE=PENDING&PHASE=QUEUED&LAST=2") == [everything[0], everything[2]]

    monkeypatch.setattr(uws, "MOST_LISTED", 3)
    assert ids() == ids("?LAST=4") == everything[:3], "the newest, of many"
    assert ids("?LAST=2") == everything[:2]
    monkeypatch.undo()

    root = document(api.get(JOBS))
    assert root.tag == f"{{{NAMES['uws']}}}jobs" and root.attrib == {"version": "1.1"}
    oldest = root[-1]
    assert local_names(oldest) == ["phase", "runId", "ownerId", "creationTime"]
    assert oldest.attrib[HREF] == jobs[0] and text(oldest, "runId") == "<64>&"
    times = [str(text(line, "creationTime")) for line in root]
    assert ids("?" + urlencode({"AFTER": times[-1]})) == everything[:-1], "after, not at"
    assert ids("?" + urlencode({"AFTER": times[0]})) == []
    assert ids("?AFTER=2001-01-01") == everything

    for query in ("?LAST=0", "?LAST=few", "?AFTER=noon", "?PHASE=NONSENSE", "?LAST=1&LAST=2"):
        answer = api.get(JOBS + query)
        assert (answer.status_code, answer.headers["content-type"][:10]) == (400, "text/plain"), query
        assert "expected" in answer.text and "got" in answer.text


def test_only_a_pending_job_s_parameters_change_and_an_ended_job_stays(
    api: TestClient, run_jobs: Callable[[], None]
) -> None:
    job = created(api, PHASE="RUN", **BUILD)
    late = post(api, f"{job}/parameters", size="64")
    assert late.status_code == 403 and "is QUEUED" in late.text
    assert post(api, f"{job}/phase", PHASE="RUN").status_code == 303, "it runs already"
    run_jobs()
    assert post(api, f"{job}/phase", PHASE="ABORT").status_code == 303
    assert api.get(f"{job}/phase").text == "COMPLETED"
    again = post(api, f"{job}/phase", PHASE="RUN")
    assert again.status_code == 403 and "is COMPLETED" in again.text

    other = created(api, **BUILD | {"size": "64"})
    assert post(api, f"{other}/phase", PHASE="ABORT").status_code == 303
    assert api.get(f"{other}/phase").text == "ABORTED"
    assert post(api, f"{other}/phase", PHASE="RUN").status_code == 403
    run_jobs()
    assert api.get(f"{other}/phase").text == "ABORTED"
    assert post(api, other, ACTION="DELETE").headers["location"].endswith("/uws/jobs")
    assert post(api, other, ACTION="DELETE").status_code == 404


def test_terms_are_clipped_to_what_is_allowed(api: TestClient, settings: Settings) -> None:
    job = created(api, **BUILD | {"EXECUTIONDURATION": "60", "DESTRUCTION": "2999-01-01T00:00:00"})
    assert api.get(f"{job}/executionduration").text == "60"
    latest = api.get(f"{job}/destruction").text
    assert latest.endswith("Z") and latest < "2999"
    most = str(settings.uws_max_execution_s)
    for seconds, allowed in (("10", "10"), ("0", most), ("9" * 12, most)):
        answer = post(api, f"{job}/executionduration", EXECUTIONDURATION=seconds)
        assert (answer.status_code, answer.headers["location"]) == (303, job)
        assert api.get(f"{job}/executionduration").text == allowed
        assert text(document(api.get(job)), "executionDuration") == allowed
    sooner = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(time.time() + 3600))
    assert post(api, f"{job}/destruction", DESTRUCTION=sooner).status_code == 303
    assert api.get(f"{job}/destruction").text == f"{sooner}.000Z"
    assert text(document(api.get(job)), "destruction") == f"{sooner}.000Z"
    assert api.get(f"{job}/quote").text == ""

    by_json = api.post("/v1/jobs", json={"kind": "psf-build", "parameters": {"instrument": "hri_euv"}}).json()
    unlimited = f"{JOBS}/{by_json['id']}"
    for seconds in ("0", "7"):
        assert api.get(f"{unlimited}/executionduration").text == seconds
        assert api.get(f"{unlimited}/destruction").text == ""
        assert post(api, f"{unlimited}/executionduration", EXECUTIONDURATION="7").status_code == 303


def test_what_xml_cannot_hold_or_would_read_otherwise(api: TestClient) -> None:
    awkward = f"# <a b='c'>]]>&amp; \u2028\U0001f31e\ufffd\ttab\r\n{SMALL_INSTRUMENT}"
    job = created(api, KIND="psf-build", instrument_file=awkward, RUNID="<&>\"' ☀")
    found = document(api.get(job))
    assert text(found, "runId") == "<&>\"' ☀"
    assert parameters(found)["instrument_file"] == awkward
    by_json_body = {"kind": "psf-build", "parameters": {"instrument_file": f"# \ufffe\n{SMALL_INSTRUMENT}"}}
    by_json = api.post("/v1/jobs", json=by_json_body).json()
    shown = parameters(document(api.get(f"{JOBS}/{by_json['id']}")))["instrument_file"]
    assert shown is not None and shown.startswith("# \ufffd\n")


def test_forms_of_any_kind(api: TestClient) -> None:
    multipart = api.post(JOBS, files={k: (None, v) for k, v in BUILD.items()}, follow_redirects=False)
    assert multipart.status_code == 303
    assert parameters(document(api.get(multipart.headers["location"])))["size"] == "128"
    in_address = api.post(f"{JOBS}?phase=RUN&{urlencode(BUILD)}", follow_redirects=False)
    assert api.get(f"{in_address.headers['location']}/phase").text == "QUEUED"
    form = {"Content-Type": "application/x-www-form-urlencoded"}
    for answer, status in (
        (api.post(JOBS, json=BUILD), 415),
        (api.post(in_address.headers["location"] + "/phase", files={"PHASE": ("a.txt", b"RUN")}), 400),
        (api.post(JOBS, files=[(f"f{n}", (None, "v")) for n in range(65)]), 400),
        (api.post(JOBS, files={"KIND": (None, "deconvolve"), "a": (None, "b" * (2**20 + 1))}), 413),
        (api.post(JOBS, content=b"KIND=%ff", headers=form), 400),
        (api.post(JOBS, content=b"&".join(b"a%d=1" % n for n in range(200)), headers=form), 400),
    ):
        assert (answer.status_code, answer.headers["content-type"][:10]) == (status, "text/plain"), (
            answer.text
        )
    empty = created(api, **BUILD | {"component": "", "RUNID": ""})
    assert "component" not in parameters(document(api.get(empty))), "a field without a value was not sent"


def test_waiting_ends_when_it_should(api: TestClient, settings: Settings) -> None:
    job = created(api, PHASE="RUN", **BUILD)

    def waited(query: str) -> tuple[str | None, float]:
        started = time.monotonic()
        answer = document(api.get(f"{job}?{query}"))
        return text(answer, "phase"), time.monotonic() - started

    assert waited("WAIT=30&PHASE=PENDING")[1] < 15, "its phase is another already"
    assert waited("WAIT=0")[1] < 15
    phase, took_s = waited("WAIT=1")
    assert phase == "QUEUED" and took_s >= 1
    assert waited("PHASE=QUEUED")[1] < 15, "without WAIT there is no wait"

    abort = threading.Timer(0.5, lambda: Catalogue(settings.catalogue_url).jobs.cancel(job[-32:]))
    abort.start()
    phase, took_s = waited("WAIT=-1")
    abort.join()
    assert phase == "ABORTED" and took_s > 0.3
    assert waited("WAIT=-1")[0] == "ABORTED", "an ended job is not waited for"

    hasty = settings.model_copy(update={"uws_max_wait_s": 0.4})
    with TestClient(create_app(hasty)) as other:
        pending = created(other, **BUILD)
        for wait in ("-1", "86400"):
            started = time.monotonic()
            assert text(document(other.get(f"{pending}?WAIT={wait}")), "phase") == "PENDING"
            assert 0.4 <= time.monotonic() - started < 60, "a wait is capped"
    threading.Timer(0.3, lambda: Catalogue(settings.catalogue_url).uws.destroy(pending[-32:])).start()
    assert api.get(f"{pending}?WAIT=20").status_code == 404, "it ends with a job that is destroyed"


def test_many_that_wait_hold_no_thread_and_a_stop_lets_all_go(api: TestClient) -> None:
    job = created(api, **BUILD)

    async def all_at_once() -> None:
        transport = httpx.ASGITransport(app=api.app)
        async with httpx.AsyncClient(transport=transport, base_url="http://testserver", timeout=60) as http:
            waiting = [asyncio.create_task(http.get(f"{job}?WAIT=30")) for _ in range(60)]
            await asyncio.sleep(0.5)
            assert (await http.get(f"{job}/phase")).text == "PENDING"
            assert not any(one.done() for one in waiting), "they wait"
            api.app.state.stopping = True
            started = time.monotonic()
            assert {answer.status_code for answer in await asyncio.gather(*waiting)} == {200}
            assert time.monotonic() - started < 20

    in_own_loop(all_at_once)
