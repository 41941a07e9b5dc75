"""The files that pages load: style sheets, scripts and pictures, at ``/static/VERSION/NAME``.

VERSION is a hash of all files. Scripts import each other by relative addresses, so a page and its scripts always have
the same version, and browsers may keep them for ever.

The interactive reference of the API at ``/docs`` is Swagger UI. The package ``fastapi-swagger`` contains its scripts and its
style sheet. The page of that package starts Swagger UI with an inline script, which our content security policy forbids; the
page in this module starts it with a script file.
"""

from __future__ import annotations

import gzip
import hashlib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

from fastapi import APIRouter, HTTPException, Request, Response

from service.http.problems import Problem

FOLDERS = ("static", "vendor")
TYPES = {
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".png": "image/png",
}
FOR_EVER = "public, max-age=31536000, immutable"
router = APIRouter(include_in_schema=False)


@dataclass(frozen=True)
class Asset:
    """A file: its bytes as they are and compressed, and its media type."""

    plain: bytes
    zipped: bytes
    type: str


@cache
def assets() -> dict[str, Asset]:
    """All files by their names."""
    found = [Path(str(one)) for folder in FOLDERS for one in files(__package__).joinpath(folder).iterdir()]
    plain = {one.name: one.read_bytes() for one in found if one.suffix in TYPES}
    return {
        name: Asset(content, gzip.compress(content, mtime=0), TYPES[Path(name).suffix])
        for name, content in plain.items()
    }


@cache
def version() -> str:
    """The hash of all files."""
    said = [(name, hashlib.sha256(one.plain).hexdigest()) for name, one in sorted(assets().items())]
    return hashlib.sha256(repr(said).encode()).hexdigest()[:12]


def address(name: str) -> str:
    """The address of a file. Raises KeyError for an unknown name."""
    assert assets()[name]
    return f"/static/{version()}/{name}"


@router.get("/static/{of_version}/{name}")
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


# --- the reference of the API ---------------------------------------------------------------------------

# Swagger UI loads its icons from data: addresses in its style sheet, and its scripts set styles.
PAGE_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data:; "
    "connect-src 'self'; frame-ancestors 'none'; base-uri 'none'"
)
PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>heliopsf API</title>
<link rel="icon" href="docs/icon.svg" type="image/svg+xml">
<link rel="stylesheet" href="docs/swagger-ui.css">
</head>
<body>
<p style="margin: 1rem"><a href="./">Back to heliopsf</a></p>
<div id="reference"></div>
<noscript>This page needs JavaScript. The description itself is at <a href="openapi.json">openapi.json</a>.</noscript>
<script src="docs/swagger-ui-bundle.js"></script>
<script src="docs/start.js"></script>
</body>
</html>
"""
# validatorUrl: null keeps Swagger UI from asking another host to validate the description.
START = """SwaggerUIBundle({
  url: "openapi.json",
  dom_id: "#reference",
  deepLinking: true,
  docExpansion: "none",
  validatorUrl: null,
  presets: [SwaggerUIBundle.presets.apis],
});
"""
OF_REFERENCE = {
    "swagger-ui-bundle.js": "text/javascript",
    "swagger-ui.css": "text/css",
    "start.js": "text/javascript",
    "icon.svg": "image/svg+xml",
}


@router.get("/docs")
def docs() -> Response:
    """The page."""
    return Response(
        PAGE, media_type="text/html; charset=utf-8", headers={"Content-Security-Policy": PAGE_POLICY}
    )


@router.get("/docs/{name}")
def part(name: str) -> Response:
    """A script or the style sheet of the page."""
    if name not in OF_REFERENCE:
        raise HTTPException(404, f"expected one of {', '.join(OF_REFERENCE)}; got {name!r}")
    return Response(_content(name), media_type=f"{OF_REFERENCE[name]}; charset=utf-8")


@cache
def _content(name: str) -> bytes:
    if name == "start.js":
        return START.encode()
    if name == "icon.svg":
        return assets()[name].plain
    return (files("fastapi_swagger") / "resources" / name).read_bytes()
