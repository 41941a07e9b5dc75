"""Bounds on connections: how many are open, and how long a client may take to send a header or to take an answer.

uvicorn has no time limit for the header of a first request and none for a client that does not read its answer. Its
``limit_concurrency`` refuses everybody as soon as connections without a request fill the server. This protocol closes the
connection that has waited longest for a request instead, so a client that sends its request at once is always answered.
"""

from __future__ import annotations

import asyncio
import logging
import resource
from dataclasses import dataclass
from typing import Any, ClassVar

from uvicorn.protocols.http.h11_impl import H11Protocol

from workers import logs
from workers.settings import Settings

log = logging.getLogger(__name__)
log.addFilter(logs.Seldom())
# The event loop accepts up to this number of connections in one step. This number is small, because each
# connection needs a file descriptor before the bound on connections can apply.
ACCEPTED_AT_ONCE = 16
LISTEN = 512  # connections that the system keeps until the server accepts them
# File descriptors that the server needs besides its connections: its database connections (SQLite: three each), its logs,
# and its worker.
OWN_DESCRIPTORS = 64 + ACCEPTED_AT_ONCE
PER_CONNECTION = 2  # its socket, and the file that it sends or receives
FEWEST = 8
_FULL = (
    b"HTTP/1.1 503 Service Unavailable\r\nContent-Type: application/problem+json\r\nRetry-After: 5\r\n"
    b"Connection: close\r\nContent-Length: %d\r\n\r\n%s"
)
_FULL_BODY = (
    b'{"type": "urn:heliopsf:too-many-connections", "title": "Service Unavailable", "status": 503, "detail": '
    b'"expected a free connection of the server; all are in use: try again in a few seconds"}'
)


@dataclass(frozen=True)
class ConnectionLimits:
    """The limits of the connections of one server process.

    most: largest number of connections that are open at the same time. header_s: longest time from the connection, or
    from the last answer, until the header of a request is complete. stalled_s: a connection is closed if
    its client reads nothing of a waiting answer for this time.
    """

    most: int
    header_s: float
    stalled_s: float

    @classmethod
    def of(cls, settings: Settings) -> ConnectionLimits:
        """The limits in the settings. The number of connections is smaller if the system allows too few file descriptors."""
        return cls(_most(settings.max_connections), settings.header_s, settings.stalled_s)


class BoundedConnection(H11Protocol):
    """A connection of uvicorn, with these bounds. A subclass sets ``limits``."""

    limits: ClassVar[ConnectionLimits]

    def __init__(self, *given: Any, **options: Any) -> None:
        super().__init__(*given, **options)
        self._header_timer: asyncio.TimerHandle | None = None
        self._stalled_timer: asyncio.TimerHandle | None = None
        self._waits_since = self.loop.time()

    @property
    def answering(self) -> bool:
        """Whether this connection has a request that is not completely answered yet."""
        return self.cycle is not None and not self.cycle.response_complete

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Accept the connection. If too many are open, close the one that has waited longest for a request. If all
        are answering requests, refuse this connection."""
        super().connection_made(transport)
        if self._open_connections() > self.limits.most and not self._close_the_longest_waiting():
            log.warning(
                "refused a connection: all %d connections of this server are answering requests",
                self.limits.most,
            )
            transport.write(_FULL % (len(_FULL_BODY), _FULL_BODY))
            transport.close()
            return
        self._await_header()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop the timers."""
        self._stop_header_timer()
        self.resume_writing()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Receive a part of a request. The timer for the header stops only when the header is complete."""
        super().data_received(data)
        if self.answering:
            self._stop_header_timer()

    def on_response_complete(self) -> None:
        """Wait for the next request. If nobody reads the rest of a body, the server receives it and drops it."""
        super().on_response_complete()
        if not self.answering and not self.transport.is_closing():
            self._await_header()

    def pause_writing(self) -> None:
        """Start a timer: the connection is closed if the client receives no part of its answer in this time."""
        super().pause_writing()
        self._stalled_timer = self.loop.call_later(self.limits.stalled_s, self.transport.abort)

    def resume_writing(self) -> None:
        """Stop the timer that `pause_writing` started: the client received a part of its answer, or the connection
        ended."""
        if self._stalled_timer is not None:
            self._stalled_timer.cancel()
            self._stalled_timer = None
        super().resume_writing()

    def _await_header(self) -> None:
        self._stop_header_timer()
        self._waits_since = self.loop.time()
        self._header_timer = self.loop.call_later(self.limits.header_s, self.transport.abort)

    def _stop_header_timer(self) -> None:
        if self._header_timer is not None:
            self._header_timer.cancel()
            self._header_timer = None

    def _open_connections(self) -> int:
        if len(self.connections) <= self.limits.most:
            return len(self.connections)
        return sum(not one.transport.is_closing() for one in self.connections)

    def _close_the_longest_waiting(self) -> bool:
        """Close another connection: the one that has waited longest for a request.

        Returns False if all other connections are answering requests.
        """
        waiting = [
            one
            for one in self.connections
            if isinstance(one, BoundedConnection)
            and one is not self
            and not one.answering
            and not one.transport.is_closing()
        ]
        if not waiting:
            return False
        min(waiting, key=lambda one: one._waits_since).transport.abort()
        log.warning(
            "all %d connections of this server are open: each new connection closes the one that has waited longest for a request",
            self.limits.most,
        )
        return True


def bounded(limits: ConnectionLimits) -> type[BoundedConnection]:
    """The protocol with these limits, for uvicorn."""
    return type("LimitedConnection", (BoundedConnection,), {"limits": limits})


def _most(wanted: int) -> int:
    """The number of connections for which there are file descriptors. If needed, this function first raises the limit
    of the process."""
    needed = OWN_DESCRIPTORS + PER_CONNECTION * wanted
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < needed:
        soft = needed if hard == resource.RLIM_INFINITY else min(needed, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    if soft == resource.RLIM_INFINITY or soft >= needed:
        return wanted
    most = max(FEWEST, (soft - OWN_DESCRIPTORS) // PER_CONNECTION)
    log.warning(
        "expected %d file descriptors for %d connections; the system allows %d (ulimit -n): at most %d connections are open",
        needed,
        wanted,
        soft,
        most,
    )
    return most
