"""Sockets and connections: how the server listens, and how many files it may open."""

from __future__ import annotations

import asyncio
import gc
import resource
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path

import httpx
import pytest
import uvicorn

from service import server
from tests.service.conftest import settings_in
from tests.service.serving import in_own_loop
from tests.whole.stack import wait_for


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


def test_a_server_may_open_as_many_files_as_the_system_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    infinity, most = resource.RLIM_INFINITY, server.MOST_OPEN_FILES
    for soft, hard, raised in (
        (1024, 10_000, 10_000),
        (1024, infinity, most),
        (1024, 1024, None),
        (infinity, infinity, None),
    ):
        limits: list[tuple[int, int]] = []
        with monkeypatch.context() as patched:
            patched.setattr(resource, "getrlimit", lambda _what, both=(soft, hard): both)
            patched.setattr(resource, "setrlimit", lambda _what, both, limits=limits: limits.append(both))
            server._allow_open_files()
        assert limits == ([] if raised is None else [(raised, hard)]), (soft, hard)
