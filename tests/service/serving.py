"""A server in a thread of its own, for tests that need a real connection.

Nothing here uses the event loop of the test's own thread: a browser test may have left one running in it.

A running server in a thread of the test, and a client that gathers what a stream says."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Coroutine, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TypeVar

import httpx
import uvicorn
from fastapi import FastAPI

from service.app import create_app
from service.client.http import Client
from tests.whole.stack import wait_for
from workers.catalogue.bulks import new_id
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.jobs import Lease
from workers.catalogue.tables import DEFAULT_OWNER
from workers.settings import Settings

T = TypeVar("T")


@contextmanager
def serving(app: Any, **options: Any) -> Iterator[int]:
    """The port of 127.0.0.1 at which the application is served. options: of uvicorn."""
    options = {"log_level": "warning", "timeout_graceful_shutdown": 1, **options}
    server = uvicorn.Server(uvicorn.Config(app, port=0, **options))
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        wait_for(lambda: server.started, "the server listens", timeout_s=20)
        yield server.servers[0].sockets[0].getsockname()[1]
    finally:
        server.should_exit = True
        thread.join(20)


def in_own_loop(work: Callable[[], Coroutine[Any, Any, T]]) -> T:
    """What the coroutine returns, run in an event loop of another thread."""
    with ThreadPoolExecutor(1) as beside:
        return beside.submit(lambda: asyncio.run(work())).result()


# --- a service and its streams ---------------------------------------------------------------------------


@dataclass
class Live:
    """A server in a thread of this process."""

    url: str
    app: FastAPI
    client: Client

    @property
    def catalogue(self) -> Catalogue:
        found = self.app.state.heliopsf.catalogue
        assert isinstance(found, Catalogue)
        return found

    def streams(self) -> int:
        """The number of streams that are open."""
        return int(self.app.state.heliopsf.streams.total())

    def job(self) -> tuple[str, Lease]:
        """A job that is at work."""
        row, _ = self.catalogue.jobs.submit("psf-build", {}, new_id(), DEFAULT_OWNER)
        lease = self.catalogue.jobs.claim(row.id, "w")
        assert lease is not None
        return row.id, lease


@contextmanager
def running(settings: Settings) -> Iterator[Live]:
    """A server with these settings."""
    app = create_app(settings)
    with serving(app) as port:
        url = f"http://127.0.0.1:{port}"
        with Client(url) as client:
            yield Live(url, app, client)


class Following(threading.Thread):
    """What a stream says, gathered beside the test."""

    def __init__(self, url: str, **headers: str) -> None:
        super().__init__(daemon=True)
        self.url, self.headers = url, headers
        self.lines: list[str] = []
        self.status = 0
        self.start()

    def run(self) -> None:
        with (
            suppress(httpx.TransportError),  # the test may end before the stream
            httpx.stream("GET", self.url, headers=self.headers, timeout=30) as answer,
        ):
            self.status = answer.status_code
            self.type = answer.headers.get("content-type", "")
            for line in answer.iter_lines():
                self.lines.append(line)

    def await_lines(self, start: str, count: int) -> None:
        """Wait until so many lines that begin like this have come."""
        wait_for(lambda: len(self.said(start)) >= count, f"{count} lines {start}", timeout_s=20)

    def said(self, start: str) -> list[str]:
        return [line.removeprefix(start).strip() for line in self.lines if line.startswith(start)]
