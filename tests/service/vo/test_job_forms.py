"""Multipart forms of UWS clients: fields are read; a file in the form, or the parameter UPLOAD, is refused."""

from __future__ import annotations

import httpx
from fastapi.testclient import TestClient

from tests.service.vo.test_jobs import BUILD, JOBS, created, document, parameters
from workers.settings import Settings

Files = dict[str, tuple[str | None, bytes | str]]
BOUNDARY = "multipart/form-data; boundary=x"
PART = b'--x\r\nContent-Disposition: form-data; name="KIND"\r\n\r\ndeconvolve\r\n'
BROKEN: list[tuple[bytes, str]] = [
    (PART, "it ended before its last boundary"),
    (PART.replace(b'name="KIND"', b"") + b"--x--", "expected a name for every part"),
    (PART.replace(b"deconvolve", b"\xff") + b"--x--", "in UTF-8"),
    (PART * 2 + b"--x--", "expected KIND once"),
]


def post(api: TestClient, address: str, files: Files) -> httpx.Response:
    return api.post(address, files=files, follow_redirects=False)


def test_fields_of_a_multipart_form_are_read(shared_api: TestClient) -> None:
    made = post(shared_api, JOBS, {name: (None, text) for name, text in BUILD.items()})
    assert made.status_code == 303, made.text
    job = made.headers["location"]
    assert post(shared_api, f"{job}/parameters", {"size": (None, "64")}).status_code == 303
    assert parameters(document(shared_api.get(job)))["size"] == "64"


def test_a_file_with_a_job_is_refused_and_the_client_told_to_upload_it(
    api: TestClient, settings: Settings
) -> None:
    fields: Files = {"KIND": (None, "deconvolve"), "UPLOAD": (None, "image,param:f")}
    large = b"SIMPLE  =" + bytes(2 * settings.max_body_kib * 2**10)
    job = created(api, KIND="deconvolve")
    for address in (JOBS, f"{job}/parameters"):
        for content in (b"SIMPLE  =", large):
            for files in (fields | {"f": ("sun.fits", content)}, {"f": ("sun.fits", content)} | fields):
                refused(post(api, address, files))
        refused(api.post(address, data={"UPLOAD": "image,http://127.0.0.1:8765/metrics"}))
        for body, told in BROKEN:
            answer = api.post(address, content=body, headers={"Content-Type": BOUNDARY})
            assert answer.status_code == 400 and told in answer.text, answer.text
    assert len(document(api.get(JOBS))) == 1 and api.get("/v1/images").json()["items"] == []


def refused(answer: httpx.Response) -> None:
    assert answer.status_code == 400 and answer.headers["content-type"].startswith("text/plain")
    assert "POST /v1/images" in answer.text and "image_id" in answer.text, answer.text
