"""The web process: its listening socket, and the garbage collector after the start."""

from __future__ import annotations

import asyncio
import gc
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn
from fastapi import FastAPI

from service import server
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
                found = await asyncio.wait_for(accepted, 10)
                client.close()
        return found

    try:
        server.listening(host, 0).close()
    except OSError as error:
        if host != "::1":
            raise
        pytest.skip(f"this machine has no IPv6: {error}")
    assert asyncio.run(delay_is_off())


def test_a_port_that_is_in_use_is_refused() -> None:
    with server.listening("127.0.0.1", 0) as listener:
        listener.listen()
        with pytest.raises(OSError, match="in use"):
            server.listening("127.0.0.1", listener.getsockname()[1])


class Configured(Exception):
    """Raised in place of a start. settings: those of uvicorn."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self.settings = settings


def test_an_idle_connection_stays_open_longer_than_clients_use_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def config(_: FastAPI, **settings: Any) -> None:
        raise Configured(settings)

    monkeypatch.setattr(server.uvicorn, "Config", config)
    monkeypatch.setattr(server.logs, "configure", lambda settings, *, verbose: None)
    with pytest.raises(Configured) as raised:
        server.serve(Settings(data_dir=tmp_path), "127.0.0.1", 0, lambda address: None)
    used_for_s = httpx.Limits().keepalive_expiry
    assert used_for_s is not None and raised.value.settings["timeout_keep_alive"] > 2 * used_for_s


@pytest.fixture
def unfrozen() -> Iterator[None]:
    """The garbage collector, as it was before."""
    yield
    gc.unfreeze()


@pytest.mark.usefixtures("unfrozen")
def test_the_garbage_collector_does_not_look_again_at_what_the_start_has_loaded() -> None:
    assert gc.get_freeze_count() == 0
    with server.listening("127.0.0.1", 0) as listener:
        running = server._Server(uvicorn.Config(FastAPI(), log_level="warning", lifespan="off"))
        thread = threading.Thread(target=running.run, kwargs={"sockets": [listener]})
        thread.start()
        wait_for(lambda: running.started and gc.get_freeze_count() > 0, "the server listens", timeout_s=20)
        running.should_exit = True
        thread.join(20)
