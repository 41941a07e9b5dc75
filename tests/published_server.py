"""A server on this machine that stands in for the repositories of published PSFs."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from hashlib import md5
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from unittest.mock import patch

from astropy.io import fits

from psfcore import published_psfs
from psfcore.psf import squared_radii

NAME = "aia_193_2025"
SIZE_PX = 200  # in the table; a file may be smaller
CHECKSUM = "/checksum"


def published_fits(size: int = 96, *, total: float = 1.0) -> bytes:
    """A FITS file as authors publish it: doubles without any card that describes them."""
    kernel = (1.0 + squared_radii((size, size))) ** -1.5
    file = BytesIO()
    fits.PrimaryHDU(kernel * (total / kernel.sum())).writeto(file)
    return file.getvalue()


@dataclass
class StandIn:
    """The server's files by path. published: the file whose MD5 it tells. broken: how many of the next answers end too
    early. faults: by path, what answers instead. asked: the paths of all requests for files. sent: how many bytes each
    answer announced."""

    files: dict[str, bytes]
    published: bytes
    broken: int = 0
    faults: dict[str, Callable[[BaseHTTPRequestHandler], None]] = field(default_factory=dict)
    asked: list[str] = field(default_factory=list)
    sent: list[int] = field(default_factory=list)
    address: str = ""


def answer(request: BaseHTTPRequestHandler, status: int, content: bytes = b"", **headers: object) -> None:
    """Send an answer; headers: their names with _ in place of -."""
    request.send_response(status)
    for name, value in ({"Content_Length": len(content)} | headers).items():
        if value is not None:
            request.send_header(name.replace("_", "-"), str(value))
    request.end_headers()
    request.wfile.write(content)


@contextmanager
def stand_in(*paths: str) -> Iterator[StandIn]:
    """Let the PSF `NAME` have these paths of the server as its addresses; the last path has the file.

    Only this server is asked, by http: its address is the origin of the PSF.
    """
    here = StandIn({paths[-1]: published_fits()}, published_fits())

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if self.path != CHECKSUM:
                here.asked.append(self.path)
            if self.path in here.faults:
                here.faults[self.path](self)
                return
            if self.path == CHECKSUM:
                checksum = {"type": "MD5", "value": md5(here.published).hexdigest()}
                answer(self, 200, json.dumps({"data": {"dataFile": {"checksum": checksum}}}).encode())
                return
            content = here.files.get(self.path)
            if content is None:
                self.send_error(404)
                return
            whole, first = len(content), int(self.headers.get("Range", "bytes=0-")[len("bytes=") : -1])
            content = content[first:]
            here.sent.append(len(content))
            here.broken -= 1
            answer(
                self,
                206 if first else 200,
                content[: len(content) // 2] if here.broken >= 0 else content,
                Content_Length=len(content),
                Content_Range=f"bytes {first}-{whole - 1}/{whole}",
            )

        def log_message(self, format: str, *args: object) -> None:
            """Nothing is printed."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    here.address = f"http://127.0.0.1:{server.server_port}"
    known = published_psfs.PUBLISHED[NAME]
    moved = replace(
        known,
        addresses=[here.address + path for path in paths],
        origins=[here.address],
        checksum_address=here.address + CHECKSUM,
        size_px=SIZE_PX,
    )
    with patch.dict(published_psfs.PUBLISHED, {NAME: moved}), patch.object(published_psfs, "TRIES_AGAIN", 1):
        yield here
    server.shutdown()
    server.server_close()
