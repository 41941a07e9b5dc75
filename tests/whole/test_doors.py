"""A real server in hostile surroundings: a folder full of traps, and clients that are no clients."""

from __future__ import annotations

import re
import socket
import uuid
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest
from astropy.io import fits

from tests.conftest import write_image
from tests.service.keyed import bearer
from tests.whole.stack import Stack, wait_for

MIB = 2**20


@dataclass(frozen=True)
class Server:
    """The shared service that asks for keys, and the header with the key of an owner."""

    stack: Stack
    url: str
    ann: dict[str, str]
    said_before: int  # bytes of the log

    def said(self) -> str:
        """What is new in the log."""
        return (self.stack.data.parent / "server.log").read_text()[self.said_before :]


@pytest.fixture(scope="module")
def server(keyed_stack: Stack) -> Server:
    before = (keyed_stack.data.parent / "server.log").stat().st_size
    key = keyed_stack.key(f"ann-{uuid.uuid4().hex[:8]}")
    return Server(keyed_stack, keyed_stack.client.server, bearer(key), before)


def test_nothing_is_imported_from_the_working_folder(server: Server) -> None:
    assert server.stack.working is not None
    sprung = server.stack.working / "sprung"

    def ready() -> bool:
        assert not sprung.exists(), (server.stack.data / "worker.log").read_text()[-2000:]
        return httpx.get(f"{server.url}/readyz").status_code == 200

    wait_for(ready, "the worker is there")
    assert not sprung.exists() and (sprung.parent / "kombu.py").is_file()


def test_other_users_of_the_machine_read_no_file_of_the_service(server: Server, tmp_path: Path) -> None:
    write_image(tmp_path / "image.fits")
    content = (tmp_path / "image.fits").read_bytes()
    sent = httpx.post(f"{server.url}/v1/images", content=content, headers=server.ann)
    assert sent.status_code == 201
    data, found = server.stack.data, {}
    for path in (data, *data.rglob("*")):
        # Other tests put files of their own into the shared store.
        if path.is_file() and "blobs" in path.parts and path.name != sent.json()["id"]:
            continue
        with suppress(FileNotFoundError):  # other tests use the service too
            found[path] = path.stat().st_mode & 0o777
    assert any(path.name == sent.json()["id"] for path in found)
    assert {path.name for path in found} >= {"catalogue.sqlite", "worker.log", "broker"}
    assert not {str(path): oct(mode) for path, mode in found.items() if mode & 0o077}


def test_requests_that_are_not_http_do_not_fill_the_log(server: Server) -> None:
    address = httpx.URL(server.url)
    for _ in range(60):
        with socket.create_connection((address.host, address.port), timeout=10) as connection:
            connection.sendall(b"\x16\x03\x01 this is TLS\r\n\r\n")
            assert connection.recv(100).startswith(b"HTTP/1.1 400")
    assert server.said().count("Invalid HTTP request") <= 1


def test_what_a_client_says_as_a_proxy_is_not_believed(server: Server) -> None:
    """Refused keys are counted by address: with an address of its own choice a client could try keys without end."""
    answer = httpx.post(
        f"{server.url}/uws/jobs",
        data={"KIND": "psf-build", "instrument": "hri_euv"},
        headers=server.ann | {"X-Forwarded-Proto": "https"},
        follow_redirects=False,
    )
    assert answer.status_code == 303 and answer.headers["Location"].startswith("http://127.0.0.1:")


def large_file(number: int) -> Iterator[bytes]:
    """A FITS image of 2048 x 2048 px, 16 MiB, piece by piece; each number gives another file."""
    cards = {"SIMPLE": True, "BITPIX": -32, "NAXIS": 2, "NAXIS1": 2048, "NAXIS2": 2048}
    yield fits.Header(cards).tostring().encode()
    for piece in range(16):
        yield bytes([0, 0, number, piece]) * (MIB // 4)
    yield bytes(-16 * MIB % 2880)


def test_uploads_at_the_same_time_stay_on_the_disk(server: Server) -> None:
    """Eight uploads of 16 MiB at once: the server's memory grows by much less."""

    def peak_mib() -> float:
        pid = (server.stack.data.parent / "server.pid").read_text().split()[0]
        status = Path(f"/proc/{pid}/status").read_text()
        return int(re.findall(r"VmHWM:\s+(\d+)", status)[0]) / 1024

    before = peak_mib()

    def send(number: int) -> int:
        address = f"{server.url}/v1/images"
        return httpx.post(address, content=large_file(number), headers=server.ann, timeout=120).status_code

    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(send, range(8))) == {201}
    assert peak_mib() - before < 90, "other tests use the service too"


def test_the_log_has_no_traceback(server: Server) -> None:
    assert "Traceback" not in server.said()
