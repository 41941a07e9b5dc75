"""Sockets and connections: idle ones give way, busy ones are bounded, and a client that does not take its answer is let go."""

from __future__ import annotations

import asyncio
import gc
import resource
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import anyio
import httpx
import pytest
import uvicorn

from service import server
from service.http.connections import FEWEST, ConnectionLimits, bounded
from tests.service.conftest import settings_in
from tests.service.serving import in_own_loop, serving
from tests.whole.stack import wait_for
from workers.settings import Settings


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_answers_on_a_connection_that_is_used_again_do_not_wait_for_an_acknowledgement(host: str) -> None:
    """Whether asyncio sets TCP_NODELAY depends on the protocol that the listener states."""

    async def delay_is_off() -> bool:
        accepted: asyncio.Future[bool] = asyncio.get_running_loop().create_future()

        def look(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            own: socket.socket = writer.get_extra_info("socket")
            accepted.set_result(bool(own.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)))
            writer.close()

        with server.listening(host, 0) as listener:
            async with await asyncio.start_server(look, sock=listener):
                _, client = await asyncio.open_connection(*listener.getsockname()[:2])
                off = await asyncio.wait_for(accepted, 10)
                client.close()
        return off

    try:
        server.listening(host, 0).close()
    except OSError as error:
        if host != "::1":
            raise
        pytest.skip(f"this machine has no IPv6: {error}")
    assert in_own_loop(delay_is_off)


def test_a_port_that_is_in_use_is_refused() -> None:
    with server.listening("127.0.0.1", 0) as listener:
        listener.listen()
        with pytest.raises(OSError, match="in use"):
            server.listening("127.0.0.1", listener.getsockname()[1])


@pytest.fixture
def unfrozen() -> Iterator[None]:
    """Nothing is kept from the garbage collector, now and afterwards; signals are handled afterwards as before."""
    handler = signal.getsignal(signal.SIGTERM)
    gc.unfreeze()
    yield
    gc.unfreeze()
    signal.signal(signal.SIGTERM, handler)


@pytest.mark.usefixtures("unfrozen")
def test_a_started_server_keeps_idle_connections_and_spares_the_garbage_collector(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An idle connection stays open longer than clients use it; what the start has loaded is not looked at again."""
    servers: list[uvicorn.Server] = []
    run = uvicorn.Server.run

    def run_and_stop(running: uvicorn.Server, sockets: list[socket.socket]) -> None:
        servers.append(running)
        thread = threading.Thread(target=run, args=(running, sockets))
        thread.start()
        wait_for(lambda: running.started and gc.get_freeze_count() > 0, "the server listens", timeout_s=20)
        running.should_exit = True
        thread.join(20)

    monkeypatch.setattr(uvicorn.Server, "run", run_and_stop)
    monkeypatch.setattr(server, "embedded_worker", lambda settings: nullcontext())
    monkeypatch.setattr(server.logs, "configure", lambda settings, *, verbose: None)
    server.serve(settings_in(tmp_path), "127.0.0.1", 0, lambda address: None)
    used_for_s = httpx.Limits().keepalive_expiry
    assert used_for_s is not None and servers[0].config.timeout_keep_alive > 2 * used_for_s


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

    async def app(scope: Any, receive: Any, send: Any) -> None:
        if scope["path"] == "/held":
            await anyio.to_thread.run_sync(held.wait, 20.0)
        pieces = 64 if scope["path"] == "/large" else 0
        length = str(2 + pieces * len(LARGE)).encode()
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", length)]})
        for _ in range(pieces):
            await send({"type": "http.response.body", "body": LARGE, "more_body": True})
        await send({"type": "http.response.body", "body": b"ok"})

    limits = ConnectionLimits(most=MOST, header_s=20.0, stalled_s=1.0)
    with serving(app, http=bounded(limits), lifespan="off") as port:
        yield "127.0.0.1", port
        held.set()


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
    idle = [connected(address, "/")]
    assert answer(idle[0]).startswith(b"HTTP/1.1 200")  # it waits from now on, so it has waited longest
    idle += [connected(address) for _ in range(MOST - 1)]
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
        time.sleep(2.0)  # twice what the server waits
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
            if time.monotonic() - began < 1.5:  # longer than the server waits for a client that takes nothing
                time.sleep(0.03)


# File descriptors -----------------------------------------------------------------------------------


def test_connections_are_as_many_as_there_are_descriptors(monkeypatch: pytest.MonkeyPatch) -> None:
    infinity = resource.RLIM_INFINITY
    for soft, hard, most, raised in (
        (10_000, 10_000, 1024, None),
        (1024, 10_000, 1024, 2128),
        (1024, infinity, 1024, 2128),
        (1024, 1024, 472, 1024),
        (256, 512, 216, 512),
        (64, 64, FEWEST, 64),
        (infinity, infinity, 1024, None),
    ):
        limits: list[tuple[int, int]] = []
        with monkeypatch.context() as patched:
            patched.setattr(resource, "getrlimit", lambda _what, both=(soft, hard): both)
            patched.setattr(resource, "setrlimit", lambda _what, both, limits=limits: limits.append(both))
            assert ConnectionLimits.of(Settings(max_connections=1024)).most == most, (soft, hard)
        assert limits == ([] if raised is None else [(raised, hard)]), (soft, hard)
