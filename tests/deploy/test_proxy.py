"""nginx accepts the file of the proxy, passes requests on as the server needs them, and closes slow connections."""

from __future__ import annotations

import re
import shutil
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml

from tests.service.serving import serving
from tests.whole.stack import wait_for

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "deploy" / "nginx.conf").read_text("utf-8")
COMPOSE = yaml.safe_load((ROOT / "docker-compose.yml").read_text("utf-8"))


async def app(scope: Any, receive: Any, send: Any) -> None:
    """Answer with the headers of the request and the length of its body."""
    got, more = 0, True
    while more:
        message = await receive()
        got, more = got + len(message.get("body", b"")), message.get("more_body", False)
    headers = [(b"got-" + name, value) for name, value in scope["headers"]]
    await send({"type": "http.response.start", "status": 200, "headers": headers})
    await send({"type": "http.response.body", "body": str(got).encode()})


@pytest.fixture(scope="module")
def proxy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[int]:
    """The port of nginx with this file, in front of ``app``; only addresses, folders and one time differ."""
    binary = shutil.which("nginx")
    if binary is None:
        pytest.skip("nginx is not installed (Debian: the package nginx contains it)")
    folder = tmp_path_factory.mktemp("proxy")
    with socket.socket() as free, serving(app, lifespan="off") as port:
        free.bind(("127.0.0.1", 0))
        own = free.getsockname()[1]
        text = TEXT.replace("http://api:8765", f"http://127.0.0.1:{port}").replace("/tmp/", f"{folder}/")
        text = text.replace("listen 8765", f"listen 127.0.0.1:{own}")
        text = text.replace("client_header_timeout 10s", "client_header_timeout 1s")
        (folder / "nginx.conf").write_text(text)
        free.close()
        process = subprocess.Popen([binary, "-c", str(folder / "nginx.conf"), "-g", "daemon off;"])
        try:
            wait_for(lambda: (folder / "nginx.pid").exists(), "nginx listens", timeout_s=20)
            yield own
        finally:
            process.terminate()
            process.wait(20)


def test_requests_arrive_with_their_host_and_address(proxy: int) -> None:
    sent = {"Host": "sun.example:1", "X-Forwarded-Proto": "https", "X-Forwarded-For": "1.2.3.4"}
    answer = httpx.post(f"http://127.0.0.1:{proxy}/v1/images", headers=sent, content=bytes(5 * 2**20))
    assert answer.text == str(5 * 2**20), "the server decides which sizes it takes"
    got = {name: answer.headers[f"got-{name}"] for name in ("host", "x-forwarded-for", "x-forwarded-proto")}
    assert got == {
        "host": "sun.example:1",
        "x-forwarded-for": "1.2.3.4, 127.0.0.1",
        "x-forwarded-proto": "https",
    }


def test_a_header_that_does_not_end_closes_the_connection(proxy: int) -> None:
    with socket.create_connection(("127.0.0.1", proxy), timeout=10) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n")
        assert connection.recv(100) == b"", "it is closed before the time limit of this socket"


def test_the_file_fits_the_compose_file() -> None:
    """The gateway is the first address of the network, which the server trusts; the ports are the same."""
    (network,) = COMPOSE["networks"]["default"]["ipam"]["config"]
    assert COMPOSE["services"]["api"]["environment"]["HELIOPSF_TRUSTED_PROXIES"] == network["subnet"]
    assert re.findall(r"set_real_ip_from (\S+);", TEXT) == [network["subnet"].replace(".0/24", ".1")]
    (published,), (port,) = COMPOSE["services"]["proxy"]["ports"], re.findall(r"listen (\d+);", TEXT)
    assert published.endswith(f":{port}")
    assert "ports" not in COMPOSE["services"]["api"], "only the proxy is reached from outside"
