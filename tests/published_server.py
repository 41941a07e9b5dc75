"""A server on this machine that stands in for the repositories of published PSFs."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from hashlib import sha256
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from unittest.mock import patch

from astropy.io import fits

from psfcore import published_psfs
from psfcore.psf import squared_radii

NAME = "aia_193_2025"


def published_fits(size: int = 96, *, total: float = 1.0) -> bytes:
    """A FITS file as authors publish it: doubles without any card that describes them."""
    kernel = (1.0 + squared_radii((size, size))) ** -1.5
    file = BytesIO()
    fits.PrimaryHDU(kernel * (total / kernel.sum())).writeto(file)
    return file.getvalue()


@dataclass
class StandIn:
    """The server's files by path. broken: how many of the next answers end too early. asked: the paths of all requests. sent: how
    many bytes each answer announced."""

    files: dict[str, bytes]
    broken: int = 0
    asked: list[str] = field(default_factory=list)
    sent: list[int] = field(default_factory=list)
    address: str = ""


@contextmanager
def stand_in(*paths: str) -> Iterator[StandIn]:
    """Let the PSF `NAME` have these paths of the server as its addresses; the last path has the file."""
    here = StandIn({paths[-1]: published_fits()})

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            here.asked.append(self.path)
            content = here.files.get(self.path)
            if content is None:
                self.send_error(404)
                return
            version = f'"{sha256(content).hexdigest()}"'
            first = int(self.headers.get("Range", "bytes=0-")[len("bytes=") : -1])
            if self.headers.get("If-Range") != version:
                first = 0
            content = content[first:]
            here.sent.append(len(content))
            self.send_response(206 if first else 200)
            self.send_header("ETag", version)
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            here.broken -= 1
            self.wfile.write(content[: len(content) // 2] if here.broken >= 0 else content)

        def log_message(self, format: str, *args: object) -> None:
            """Nothing is printed."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    here.address = f"http://127.0.0.1:{server.server_port}"
    known = published_psfs.PUBLISHED[NAME]
    moved = replace(known, addresses=tuple(here.address + path for path in paths))
    with patch.dict(published_psfs.PUBLISHED, {NAME: moved}), patch.object(published_psfs, "TRIES_AGAIN", 1):
        yield here
    server.shutdown()
    server.server_close()
