"""SIGTERM to a server: it takes no more, and is gone within the time that it states, whatever a client does."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest

from tests.whole.stack import free_port, wait_for


@pytest.mark.parametrize("stop_s", [0.5, 60.0])
def test_a_server_lets_requests_end_and_does_not_wait_for_those_that_do_not(
    tmp_path: Path, stop_s: float
) -> None:
    """With half an upload on the line: gone after stop_s; or, where the rest comes in time, after the answer."""
    log = tmp_path / "server.log"
    server = subprocess.Popen(
        [sys.executable, "-m", "service.cli", "serve", "--port", "0"],
        env=os.environ
        | {
            "HELIOPSF_DATA_DIR": str(tmp_path / "data"),
            "HELIOPSF_BROKER_URL": f"redis://127.0.0.1:{free_port()}/0",  # so that no worker starts beside it
            "HELIOPSF_STOP_S": str(stop_s),
            "HELIOPSF_LOG_FORMAT": "json",
        },
        stdout=subprocess.PIPE,
        stderr=log.open("w"),
        text=True,
    )
    try:
        assert server.stdout is not None
        url = server.stdout.readline().split(" serves ")[1].split()[0]
        wait_for(lambda: _up(url), "the server is up")
        port = int(url.rsplit(":", 1)[1])
        with socket.create_connection(("127.0.0.1", port)) as line:
            line.sendall(
                b"POST /v1/images HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 2880\r\n\r\nSIMPLE  ="
            )
            wait_for(lambda: any((tmp_path / "data" / "tmp").iterdir()), "the upload is at work")
            told = time.monotonic()
            server.send_signal(signal.SIGTERM)
            wait_for(lambda: not _listens(port), "it takes no more")
            if stop_s > 1:
                assert server.poll() is None
                line.sendall(b" " * (2880 - len(b"SIMPLE  =")))
                answer = line.recv(65536)
                assert answer.startswith(b"HTTP/1.1 422"), "no good file, but a whole answer"
            server.wait(40)
            assert time.monotonic() - told < 30.0
    finally:
        if server.poll() is None:
            server.kill()
        server.wait()
        server.stdout and server.stdout.close()
    assert server.returncode == 0, log.read_text()
    assert list((tmp_path / "data" / "tmp").iterdir()) == [], "half an upload is not left behind"


def _up(url: str) -> bool:
    try:
        return httpx.get(f"{url}/healthz").status_code == 200
    except httpx.HTTPError:
        return False


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0
