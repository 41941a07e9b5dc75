"""A real server in hostile surroundings: a folder full of traps, and clients that are no clients."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import httpx
import psutil
import pytest
from astropy.io import fits

from service.client.http import Client
from tests.conftest import write_image
from tests.service.keyed import ALL, bearer
from tests.whole.stack import QUICK, wait_for
from workers.catalogue.access import Scope
from workers.catalogue.catalogue import Catalogue
from workers.settings import Settings

MIB = 2**20
# Modules that a server or a worker imports only after its start, or that another program may have left in a folder.
TRAPS = {"kombu", "celery", "celeryconfig", "redis", "service", "workers"}
TRAPS |= {"psfcore", "numpy", "matplotlib", "sitecustomize"}


@dataclass
class Server:
    """A running server that asks for keys, and its files."""

    url: str
    process: subprocess.Popen[str]
    data: Path
    traps: Path
    log: Path

    def key(self, owner: str = "ann") -> str:
        catalogue = Catalogue(Settings(data_dir=self.data, database_url=None).catalogue_url)
        try:
            return catalogue.keys.make(owner, ALL - {Scope.ADMIN})
        finally:
            catalogue.close()


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("doors")
    traps, data, log = folder / "traps", folder / "data", folder / "server.log"
    traps.mkdir()
    data.mkdir(mode=0o755)
    for name in TRAPS | {one for one in sys.stdlib_module_names - {"__future__"} if not one.startswith("_")}:
        (traps / f"{name}.py").write_text(
            f"import os\nos.close(os.open({str(traps / 'sprung')!r}, os.O_CREAT | os.O_WRONLY))\n"
            f"raise ImportError('{name} of the working folder was imported')\n"
        )
    settings = {
        "HELIOPSF_DATA_DIR": str(data),
        "HELIOPSF_BROKER_URL": "filesystem://",
        "HELIOPSF_ACCESS": "keys",
        "HELIOPSF_STOP_S": "1",
        "HELIOPSF_READS_PER_MINUTE": "0",
    }
    cleared = {name: value for name, value in os.environ.items() if not name.startswith("HELIOPSF_")}
    with log.open("w") as errors:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "service.cli", "serve", "--port", "0"],
            cwd=traps,
            env=cleared | QUICK | settings,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            start_new_session=True,
            umask=0o022,  # as usual
        )
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        assert " serves " in line, log.read_text()
        url = line.split(" serves ")[1].split()[0]
        with Client(url) as client:
            client.wait_until_up()
        yield Server(url, process, data, traps, log)
    finally:
        started = [*psutil.Process(process.pid).children(recursive=True)]
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(40)
        finally:
            for one in (*started, psutil.Process(process.pid)) if process.poll() is None else started:
                if one.is_running():
                    one.kill()


def test_nothing_is_imported_from_the_working_folder(server: Server) -> None:
    def ready() -> bool:
        assert not (server.traps / "sprung").exists(), (server.data / "worker.log").read_text()[-2000:]
        return httpx.get(f"{server.url}/readyz").status_code == 200

    wait_for(ready, "the worker is there")
    assert not (server.traps / "sprung").exists()


def test_other_users_of_the_machine_read_no_file_of_the_service(server: Server, tmp_path: Path) -> None:
    write_image(tmp_path / "image.fits")
    content = (tmp_path / "image.fits").read_bytes()
    sent = httpx.post(f"{server.url}/v1/images", content=content, headers=bearer(server.key()))
    assert sent.status_code == 201
    found = {path: path.stat().st_mode & 0o777 for path in (server.data, *server.data.rglob("*"))}
    assert any(path.name == sent.json()["id"] for path in found)
    assert {path.name for path in found} >= {"catalogue.sqlite", "worker.log", "broker"}
    assert not {str(path): oct(mode) for path, mode in found.items() if mode & 0o077}


def test_requests_that_are_not_http_do_not_fill_the_log(server: Server) -> None:
    before, address = server.log.stat().st_size, httpx.URL(server.url)
    for _ in range(60):
        with socket.create_connection((address.host, address.port), timeout=10) as connection:
            connection.sendall(b"\x16\x03\x01 this is TLS\r\n\r\n")
            assert connection.recv(100).startswith(b"HTTP/1.1 400")
    assert server.log.read_text()[before:].count("Invalid HTTP request") <= 1


def test_what_a_client_says_as_a_proxy_is_not_believed(server: Server) -> None:
    """Refused keys are counted by address: with an address of its own choice a client could try keys without end."""
    answer = httpx.post(
        f"{server.url}/uws/jobs",
        data={"KIND": "psf-build", "instrument": "hri_euv"},
        headers=bearer(server.key()) | {"X-Forwarded-Proto": "https"},
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
        status = Path(f"/proc/{server.process.pid}/status").read_text()
        return int(re.findall(r"VmHWM:\s+(\d+)", status)[0]) / 1024

    ann, before = bearer(server.key()), peak_mib()

    def send(number: int) -> int:
        address = f"{server.url}/v1/images"
        return httpx.post(address, content=large_file(number), headers=ann, timeout=120).status_code

    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(send, range(8))) == {201}
    assert peak_mib() - before < 40


def test_the_log_has_no_traceback(server: Server) -> None:
    assert not re.search("Traceback", server.log.read_text())
