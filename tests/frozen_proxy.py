"""A proxy of TCP on the loopback address, whose connections can fall silent without being closed."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress


class Proxy:
    """Passes bytes to a server. ``accepting``: whether new connections reach the server."""

    def __init__(self, host: str, port: int) -> None:
        self._server = (host, port)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self.accepting = True
        self._open: list[tuple[socket.socket, threading.Event]] = []
        threading.Thread(target=self._listen, daemon=True).start()

    def freeze(self) -> None:
        """Let all open connections forward nothing any more. They stay open, and take what is sent to them."""
        for _, frozen in self._open:
            frozen.set()

    def close(self) -> None:
        """Close all connections."""
        self._listener.close()
        for connection, _ in self._open:
            connection.close()

    def _listen(self) -> None:
        with suppress(OSError):  # the listener was closed
            while True:
                client, _ = self._listener.accept()
                frozen = threading.Event()
                self._open.append((client, frozen))
                if self.accepting:
                    server = socket.create_connection(self._server)
                    self._open.append((server, frozen))
                    for pair in ((client, server), (server, client)):
                        threading.Thread(target=_forward, args=(*pair, frozen), daemon=True).start()


def _forward(source: socket.socket, target: socket.socket, frozen: threading.Event) -> None:
    with suppress(OSError):  # one of them was closed
        while data := source.recv(65_536):
            if not frozen.is_set():
                target.sendall(data)
        if not frozen.is_set():
            target.shutdown(socket.SHUT_WR)


@contextmanager
def proxy_of(host: str, port: int) -> Iterator[Proxy]:
    """A proxy of this server."""
    proxy = Proxy(host, port)
    try:
        yield proxy
    finally:
        proxy.close()
