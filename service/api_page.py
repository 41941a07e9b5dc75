"""The interactive API reference at ``/docs``: Swagger UI, served from this host.

The package ``fastapi-swagger`` contains the scripts and the style sheet of Swagger UI. The page of that package starts
Swagger UI with an inline script, which our content security policy forbids. The page in this module starts it with a
script file.
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files

from fastapi import APIRouter, HTTPException, Response

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
TYPES = {
    "swagger-ui-bundle.js": "text/javascript",
    "swagger-ui.css": "text/css",
    "start.js": "text/javascript",
    "icon.svg": "image/svg+xml",
}
router = APIRouter(include_in_schema=False)


@router.get("/docs")
def docs() -> Response:
    """The page."""
    return Response(
        PAGE, media_type="text/html; charset=utf-8", headers={"Content-Security-Policy": PAGE_POLICY}
    )


@router.get("/docs/{name}")
def part(name: str) -> Response:
    """A script or the style sheet of the page."""
    if name not in TYPES:
        raise HTTPException(404, f"expected one of {', '.join(TYPES)}; got {name!r}")
    return Response(_content(name), media_type=f"{TYPES[name]}; charset=utf-8")


@cache
def _content(name: str) -> bytes:
    if name == "start.js":
        return START.encode()
    if name == "icon.svg":
        return (files("service.pages") / "static" / name).read_bytes()
    return (files("fastapi_swagger") / "resources" / name).read_bytes()
