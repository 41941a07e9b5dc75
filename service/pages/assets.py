"""The files that pages load: style sheets, scripts and pictures, at ``/static/VERSION/NAME``.

VERSION is a hash of all files. Scripts import each other by relative addresses, so a page and its scripts always have
the same version, and browsers may keep them for ever.
"""

from __future__ import annotations

import gzip
import hashlib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable

from fastapi import APIRouter, Request, Response

from service.http.problems import Problem

FOLDERS = ("static", "vendor")
TYPES = {
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".png": "image/png",
}
FOR_EVER = "public, max-age=31536000, immutable"
router = APIRouter(prefix="/static", include_in_schema=False)


@dataclass(frozen=True)
class Asset:
    """A file: its bytes as they are and compressed, and its media type."""

    plain: bytes
    zipped: bytes
    type: str


@cache
def assets() -> dict[str, Asset]:
    """All files by their names."""
    found = [one for folder in FOLDERS for one in files(__package__).joinpath(folder).iterdir()]
    return {one.name: _asset(one) for one in found if _suffix(one) in TYPES}


@cache
def version() -> str:
    """The hash of all files."""
    said = [(name, hashlib.sha256(one.plain).hexdigest()) for name, one in sorted(assets().items())]
    return hashlib.sha256(repr(said).encode()).hexdigest()[:12]


def address(name: str) -> str:
    """The address of a file. Raises KeyError for an unknown name."""
    assert assets()[name]
    return f"/static/{version()}/{name}"


@router.get("/{of_version}/{name}")
def asset(of_version: str, name: str, request: Request) -> Response:
    """One file. A page of an earlier version gets the present file, which browsers must not keep."""
    found = assets().get(name)
    if found is None:
        raise Problem(404, "no-such-file", f"expected the name of a file that pages load; got {name[:80]!r}")
    headers = {
        "Cache-Control": FOR_EVER if of_version == version() else "no-cache",
        "Vary": "Accept-Encoding",
    }
    if "gzip" in request.headers.get("accept-encoding", ""):
        return Response(found.zipped, media_type=found.type, headers={**headers, "Content-Encoding": "gzip"})
    return Response(found.plain, media_type=found.type, headers=headers)


def _asset(file: Traversable) -> Asset:
    plain = file.read_bytes()
    return Asset(plain, gzip.compress(plain, mtime=0), TYPES[_suffix(file)])


def _suffix(file: Traversable) -> str:
    return "." + file.name.rpartition(".")[2]
