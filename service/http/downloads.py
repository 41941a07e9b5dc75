"""Sends stored files, with their SHA-256 as ETag."""

from __future__ import annotations

from fastapi import Request
from fastapi.responses import FileResponse, Response

from workers.files.store import Store

FITS_TYPE = "application/fits"
KEPT = "private, max-age=31536000, immutable"  # the content at an address never changes


def send(request: Request, store: Store, digest: str, media_type: str, filename: str | None) -> Response:
    """The file, or 304 if the client already has it."""
    headers = {"ETag": f'"{digest}"', "Cache-Control": KEPT}
    if known(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    return FileResponse(store.path(digest), media_type=media_type, filename=filename, headers=headers)


def known(request: Request, etag: str) -> bool:
    """Whether the client already has the content of this ETag (If-None-Match)."""
    tags = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
    return "*" in tags or etag in tags
