"""Resumable uploads over a real connection, which is cut in the middle."""

from __future__ import annotations

import base64
import hashlib
import os
import socket
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest

from psfcore.transit.archive import pack
from service.client import connection, errors, http
from service.client.connection import upload_in_parts
from service.client.errors import ServiceError
from tests.service.serving import Live, running
from tests.transit_files import write_transit
from tests.whole.stack import wait_for
from workers.files import partial_uploads
from workers.files.partial_uploads import PartialUploads
from workers.settings import Settings

TUS = {"Tus-Resumable": "1.0.0"}
PART = TUS | {"Content-Type": "application/offset+octet-stream"}


@pytest.fixture
def live(settings: Settings) -> Iterator[Live]:
    with running(settings) as live:
        yield live


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    pack(write_transit(tmp_path / "mercury", images=4), tmp_path / "mercury.tar")
    return tmp_path / "mercury.tar"


def encoded(**metadata: str) -> str:
    return ",".join(f"{k} {base64.b64encode(v.encode()).decode()}" for k, v in metadata.items())


def begun(live: Live, length: int, **metadata: str) -> str:
    """Begin an upload; returns its URL."""
    headers = TUS | {"Upload-Length": str(length), "Upload-Metadata": encoded(**metadata)}
    answer = httpx.post(f"{live.url}/v1/uploads", headers=headers)
    assert answer.status_code == 201, answer.text
    assert answer.headers["upload-offset"] == "0" and "upload-expires" in answer.headers
    return live.url + str(answer.headers["location"])


def offset(url: str) -> int:
    answer = httpx.head(url, headers=TUS)
    assert answer.status_code == 200 and answer.headers["cache-control"] == "no-store"
    return int(answer.headers["upload-offset"])


def patch(url: str, at: int, content: bytes, **headers: str) -> httpx.Response:
    return httpx.patch(url, content=content, headers=PART | {"Upload-Offset": str(at)} | headers)


def cut(url: str, at: int, content: bytes, announced: int, **headers: str) -> None:
    """Send fewer bytes than announced, then close the connection."""
    parts = urlsplit(url)
    assert parts.hostname is not None
    lines = [f"PATCH {parts.path} HTTP/1.1", f"Host: {parts.netloc}", f"Content-Length: {announced}"]
    lines += [f"{k}: {v}" for k, v in (PART | {"Upload-Offset": str(at)} | headers).items()]
    with socket.create_connection((parts.hostname, parts.port or 80)) as connection:
        connection.sendall("\r\n".join(lines).encode() + b"\r\n\r\n" + content)
        time.sleep(0.2)


def checksum(content: bytes) -> str:
    return "sha256 " + base64.b64encode(hashlib.sha256(content).digest()).decode()


def wait_for_offset(url: str, expected: int) -> None:
    wait_for(lambda: offset(url) == expected, f"offset {expected}", timeout_s=20)


def test_an_upload_continues_where_the_connection_was_cut(live: Live, archive: Path) -> None:
    content = archive.read_bytes()
    url = begun(live, len(content), kind="transit", filename="mercury.tar")
    cut(url, 0, content[:30_000], announced=len(content))
    wait_for_offset(url, 30_000)
    wrong = patch(url, 0, content)
    assert wrong.status_code == 409 and "bytes from 30000 on" in wrong.json()["detail"]
    done = patch(url, 30_000, content[30_000:])
    assert done.status_code == 204 and done.headers["upload-offset"] == str(len(content))
    sha256 = hashlib.sha256(content).hexdigest()
    assert done.headers["content-location"] == f"/v1/transits/{sha256}"
    transit = live.client.get(done.headers["content-location"])
    assert (transit["id"], transit["bytes"], transit["filename"]) == (sha256, len(content), "mercury.tar")
    assert httpx.head(url, headers=TUS).status_code == 404


def test_bytes_that_could_not_be_checked_are_not_kept(live: Live, archive: Path) -> None:
    content = archive.read_bytes()
    url = begun(live, len(content))
    assert patch(url, 0, content[:1000], **{"Upload-Checksum": checksum(content[:1000])}).status_code == 204
    cut(url, 1000, content[1000:5000], announced=9000, **{"Upload-Checksum": checksum(content[1000:10_000])})
    time.sleep(0.3)
    wait_for_offset(url, 1000)
    damaged = patch(url, 1000, content[1001:5001], **{"Upload-Checksum": checksum(content[1000:5000])})
    assert damaged.status_code == 460 and damaged.json()["title"] == "Checksum Mismatch"
    assert offset(url) == 1000
    assert patch(url, 1000, content[1000:]).headers["content-location"].startswith("/v1/transits/")


class Broken:
    """Answers requests by a client, but breaks the connection in some of them, before or after the server got them."""

    def __init__(self, live: Live, breaks: list[str]) -> None:
        self._live, self._breaks = live, breaks
        self.parts: list[int] = []

    def __call__(self, method: str, address: str, **options: Any) -> httpx.Response:
        how = self._breaks.pop(0) if method == "PATCH" and self._breaks else ""
        if method == "PATCH":
            self.parts.append(int(options["headers"]["Upload-Offset"]))
        if how == "before":
            half = options["content"][: len(options["content"]) // 2]
            headers = {"Upload-Checksum": options["headers"]["Upload-Checksum"]}
            cut(self._live.url + address, self.parts[-1], half, len(options["content"]), **headers)
            raise ServiceError("no answer")
        answer = self._live.client._answer(method, address, **options)
        if how == "after":
            raise ServiceError("no answer")
        return answer


def test_the_client_continues_after_cuts(live: Live, archive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "PART_BYTES", 20_000)
    monkeypatch.setattr(errors, "FIRST_WAIT_S", 0.3)
    said: list[str] = []
    broken = Broken(live, ["", "before", "after", ""])
    found = upload_in_parts(broken, archive, "transit", "mercury.tar", said.append)
    assert found == f"/v1/transits/{hashlib.sha256(archive.read_bytes()).hexdigest()}"
    assert live.client.get(found)["bytes"] == archive.stat().st_size
    # The second part is cut and sent again; the answer to it is lost, but the service has it.
    assert broken.parts[:5] == [0, 20_000, 20_000, 40_000, 60_000]
    assert any("the upload continues at" in line for line in said)
    again = Broken(live, [])
    assert upload_in_parts(again, archive, "transit", "mercury.tar", said.append) == found
    assert again.parts == [], "a file that is there needs no bytes"


def test_another_process_continues_the_upload(
    live: Live, archive: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connection, "PART_BYTES", 20_000)
    with monkeypatch.context() as patched:
        patched.setattr(errors, "PATIENCE_S", -1.0)
        with pytest.raises(ServiceError, match="no answer"):
            upload_in_parts(Broken(live, ["", "", "before"]), archive, "transit", "m.tar", print)
    second = Broken(live, [])
    time.sleep(0.5)
    upload_in_parts(second, archive, "transit", "m.tar", print)
    assert second.parts[0] == 40_000
    write_transit(archive.parent / "other", images=3)
    pack(archive.parent / "other", archive)
    monkeypatch.setattr(http, "FROM_BYTES", 1000)
    sent = live.client.upload_transit(archive)
    assert sent["id"] == hashlib.sha256(archive.read_bytes()).hexdigest(), (
        "a large transit, by the client itself"
    )


def open_files(settings: Settings) -> list[str]:
    """The names of the files of open uploads."""
    return [path.name for path in (settings.data_dir / "uploads").iterdir() if path.name != "lock"]


def test_a_file_that_cannot_be_used_is_refused_and_removed(live: Live, settings: Settings) -> None:
    url = begun(live, 100)
    assert patch(url, 0, b"Dear archive, " * 8).status_code == 413 and offset(url) == 0
    refused = patch(url, 0, b"x" * 100)
    assert refused.status_code == 415 and refused.json()["type"] == "urn:heliopsf:not-an-archive"
    assert open_files(settings) == []
    url = begun(live, 5, sha256="0" * 64)
    assert "expected a file with the SHA-256 000" in patch(url, 0, b"hello").json()["detail"]
    assert open_files(settings) == []


def test_the_protocol_of_uploads(live: Live) -> None:
    for headers, status, words in (
        ({"Tus-Resumable": "0.2.0"}, 412, "Tus-Resumable: 1.0.0"),
        ({"Upload-Length": "many"}, 400, "a number of bytes"),
        ({"Upload-Length": str(2**45)}, 413, "expected a file of at most"),
        ({"Upload-Metadata": "kind !"}, 400, "a value in base64"),
        ({"Upload-Metadata": encoded(kind="film")}, 422, "transit or image; got 'film'"),
        ({"Upload-Metadata": encoded(sha256="abc")}, 422, "64 hexadecimal digits"),
    ):
        answer = httpx.post(f"{live.url}/v1/uploads", headers=TUS | {"Upload-Length": "10"} | headers)
        assert answer.status_code == status and words in answer.json()["detail"], headers
    options = httpx.options(f"{live.url}/v1/uploads")
    assert options.status_code == 204 and options.headers["tus-version"] == "1.0.0"
    assert options.headers["tus-extension"] == "creation,termination,expiration,checksum"
    url = begun(live, 10)
    assert httpx.patch(url, content=b"x", headers=TUS | {"Upload-Offset": "0"}).status_code == 415
    assert httpx.delete(url, headers=TUS).status_code == 204
    assert httpx.head(url, headers=TUS).status_code == 404


def test_only_one_request_sends_bytes_and_uploads_expire(
    live: Live, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = begun(live, 10)
    uploads = PartialUploads(settings.data_dir)
    upload = uploads.find(url.rsplit("/", 1)[1], "local")
    assert upload is not None
    with uploads.opened(upload):
        assert patch(url, 0, b"12345").status_code == 423
    assert patch(url, 0, b"12345").status_code == 204
    old = time.time() - partial_uploads.EXPIRES_S - 1
    os.utime(uploads.path(upload), (old, old))
    with uploads.opened(upload):
        uploads.sweep()
        assert uploads.path(upload).exists(), "a request appends to it, so the clock must be wrong"
    begun(live, 10)
    assert httpx.head(url, headers=TUS).status_code == 404
    monkeypatch.setattr(partial_uploads, "MOST_OPEN", 1)
    many = httpx.post(f"{live.url}/v1/uploads", headers=TUS | {"Upload-Length": "10"})
    assert many.status_code == 429 and "at most 1 open uploads" in many.json()["detail"]


def test_uploads_that_begin_at_once_are_counted_one_after_the_other(
    live: Live, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(partial_uploads, "MOST_OPEN", 4)
    whole = PartialUploads.create

    def slow(uploads: PartialUploads, *about: Any) -> Any:
        time.sleep(0.02)  # so that all requests would count the same uploads
        return whole(uploads, *about)

    monkeypatch.setattr(PartialUploads, "create", slow)
    headers = TUS | {"Upload-Length": "10"}
    with ThreadPoolExecutor(12) as pool:
        answers = list(pool.map(lambda _n: httpx.post(f"{live.url}/v1/uploads", headers=headers), range(12)))
    assert sorted(answer.status_code for answer in answers) == 4 * [201] + 8 * [429]
    assert len(open_files(settings)) == 2 * 4


def test_the_declared_lengths_of_open_uploads_count_in_the_quota(
    settings: Settings, archive: Path, image_file: Path
) -> None:
    limited = settings.model_copy(update={"quota_mib": 1})
    with running(limited) as live:
        url = begun(live, 2**20 - 1000)
        second = httpx.post(f"{live.url}/v1/uploads", headers=TUS | {"Upload-Length": "1001"})
        assert second.status_code == 413 and second.json()["used_bytes"] == 2**20 - 1000
        image = httpx.post(f"{live.url}/v1/images", content=image_file.read_bytes())
        assert image.status_code == 413 and image.json()["type"] == "urn:heliopsf:quota-exceeded"
        assert patch(url, 0, bytes(2000)).status_code == 204, "its own length is not counted twice"
        [part] = (limited.data_dir / "uploads").glob("*.part")
        old = time.time() - partial_uploads.EXPIRES_S - 1
        os.utime(part, (old, old))
        assert httpx.post(f"{live.url}/v1/images", content=image_file.read_bytes()).status_code == 201
        content = archive.read_bytes()
        assert patch(begun(live, len(content)), 0, content).status_code == 204


def test_an_upload_that_another_request_ends_meanwhile_is_not_there(
    live: Live, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, method in (("offset", "HEAD"), ("opened", "PATCH"), ("offset", "PATCH")):
        url = begun(live, 10)
        whole = getattr(PartialUploads, name)

        def ended(uploads: PartialUploads, upload: Any, whole: Any = whole) -> Any:
            uploads.remove(upload)
            return whole(uploads, upload)

        with monkeypatch.context() as patched:
            patched.setattr(PartialUploads, name, ended)
            headers = PART | {"Upload-Offset": "0"}
            answer = httpx.request(method, url, headers=headers, content=b"12345")
        assert answer.status_code == 404, (name, method)
        assert method == "HEAD" or answer.json()["type"] == "urn:heliopsf:no-such-upload"
        assert open_files(settings) == []
