"""Connections: idle ones give way, busy ones are bounded, and a client that does not take its answer is let go."""

from __future__ import annotations

import logging
import resource
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
import uvicorn

from service.http.connections import FEWEST, ConnectionLimits, bounded
from tests.whole.stack import free_port, wait_for
from workers.settings import Settings

LARGE = bytes(2**20)
MOST = 4


@pytest.fixture
def held() -> Iterator[threading.Event]:
    """Requests to /held are answered when this is set."""
    event = threading.Event()
    yield event
    event.set()


@pytest.fixture
def address(held: threading.Event) -> Iterator[tuple[str, int]]:
    """A server of four connections, without the application: /large answers what no socket buffers."""
    import anyio

    async def app(scope: Any, receive: Any, send: Any) -> None:
        if scope["path"] == "/held":
            await anyio.to_thread.run_sync(held.wait, 20.0)
        pieces = 64 if scope["path"] == "/large" else 0
        length = str(2 + pieces * len(LARGE)).encode()
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", length)]})
        for _ in range(pieces):
            await send({"type": "http.response.body", "body": LARGE, "more_body": True})
        await send({"type": "http.response.body", "body": b"ok"})

    limits = ConnectionLimits(most=MOST, header_s=20.0, stalled_s=0.3)
    port = free_port()
    config = uvicorn.Config(
        app, port=port, http=bounded(limits), lifespan="off", log_level="warning", timeout_graceful_shutdown=1
    )
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run)
    thread.start()
    wait_for(lambda: server.started, "the server listens", timeout_s=20)
    yield "127.0.0.1", port
    held.set()
    server.should_exit = True
    thread.join(20)


def connected(address: tuple[str, int], path: str | None = None) -> socket.socket:
    connection = socket.create_connection(address, timeout=20)
    if path is not None:
        connection.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
    return connection


def answer(connection: socket.socket) -> bytes:
    """What arrives until the connection ends or the answer is complete."""
    said = b""
    while not said.endswith((b"ok", b"}")):
        more = connection.recv(4096)
        if not more:
            break
        said += more
    return said


def test_the_connection_that_waits_longest_gives_way(
    address: tuple[str, int], caplog: pytest.LogCaptureFixture
) -> None:
    idle = []
    for number in range(MOST):
        idle.append(connected(address, "/" if number == 0 else None))
        if number == 0:
            assert answer(idle[0]).startswith(
                b"HTTP/1.1 200"
            )  # it waits from now on, so it has waited longest
    with connected(address, "/") as another:
        assert answer(another).startswith(b"HTTP/1.1 200")
        assert idle[0].recv(1) == b"", "closed"
        idle[1].sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert answer(idle[1]).startswith(b"HTTP/1.1 200"), "still open"
    for connection in idle:
        connection.close()
    told = [record for record in caplog.records if record.name == "service.http.connections"]
    assert len(told) <= 1


def test_no_request_is_broken_off_for_a_new_connection(
    address: tuple[str, int], held: threading.Event
) -> None:
    busy = [connected(address, "/held") for _ in range(MOST)]
    time.sleep(0.2)  # until the server has read the requests; if it has not, one of them is answered later
    with connected(address) as another:
        refused = answer(another)
    assert refused.startswith(b"HTTP/1.1 503") and b"urn:heliopsf:too-many-connections" in refused
    assert b"Retry-After: 5" in refused
    held.set()
    for connection in busy:
        assert answer(connection).startswith(b"HTTP/1.1 200")
        connection.close()


def test_a_client_that_does_not_take_its_answer_is_let_go(address: tuple[str, int]) -> None:
    with connected(address, "/large") as stalled:
        time.sleep(1.0)  # three times what the server waits
        got = 0
        try:
            while more := stalled.recv(2**20):
                got += len(more)
        except ConnectionResetError:
            pass
    assert 0 < got < 64 * len(LARGE)


def test_a_client_that_takes_its_answer_slowly_gets_it(address: tuple[str, int]) -> None:
    with connected(address, "/large") as slow:
        got, began = 0, time.monotonic()
        while got < 64 * len(LARGE):
            more = slow.recv(2**20)
            assert more, "it was let go"
            got += len(more)
            if time.monotonic() - began < 0.6:  # twice what the server waits for a client that takes nothing
                time.sleep(0.02)


# File descriptors -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("soft", "hard", "most", "raised"),
    [
        (10_000, 10_000, 1024, None),
        (1024, 10_000, 1024, 2128),
        (1024, resource.RLIM_INFINITY, 1024, 2128),
        (1024, 1024, 472, 1024),
        (256, 512, 216, 512),
        (64, 64, FEWEST, 64),
        (resource.RLIM_INFINITY, resource.RLIM_INFINITY, 1024, None),
    ],
)
def test_connections_are_as_many_as_there_are_descriptors(
    soft: int,
    hard: int,
    most: int,
    raised: int | None,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    set_to: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "getrlimit", lambda _what: (soft, hard))
    monkeypatch.setattr(resource, "setrlimit", lambda _what, limits: set_to.append(limits))
    caplog.set_level(logging.WARNING)
    assert ConnectionLimits.of(Settings(max_connections=1024)).most == most
    assert set_to == ([] if raised is None else [(raised, hard)])
