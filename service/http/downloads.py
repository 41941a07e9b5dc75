"""Sends stored files and contents made from them. An ETag says whether the client has a content already."""

from __future__ import annotations

import base64
import hashlib
import logging
from pathlib import Path

from fastapi import Request
from fastapi.responses import FileResponse, Response

from service.http.problems import Problem, problem
from workers.files.store import BadFile, Store, lost

log = logging.getLogger(__name__)

FITS_TYPE, GZIP_TYPE, JSON_TYPE = "application/fits", "application/gzip", "application/json"
KEPT = "private, max-age=31536000, immutable"  # the content at an address never changes


def send(
    request: Request,
    store: Store,
    digest: str | None,
    media_type: str,
    filename: str | None,
    *,
    size: int | None = None,
    missing: tuple[str, str] | None = None,
) -> Response:
    """The file with this SHA-256 as ETag, or 304 if the client already has it. size: as for ``path_of``.

    Clients can check the received file against the SHA-256 in the header Repr-Digest (RFC 9530). Raises ``Problem`` 410
    if the file is lost, and 404 with the code and the message of ``missing`` if digest is None.
    """
    if digest is None:
        assert missing is not None
        raise Problem(404, *missing)
    content = base64.b64encode(bytes.fromhex(digest)).decode()
    headers = {"ETag": f'"{digest}"', "Cache-Control": KEPT, "Repr-Digest": f"sha-256=:{content}:"}
    if _client_has(request, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    path = path_of(store, digest, size)
    return FileResponse(path, media_type=media_type, filename=filename, headers=headers)


def headers_of(content: str) -> dict[str, str]:
    """The headers of an answer that is made from stored files. content: a text that determines the answer."""
    return {"ETag": f'"{hashlib.sha256(content.encode()).hexdigest()}"', "Cache-Control": KEPT}


def not_modified(request: Request, headers: dict[str, str]) -> Response | None:
    """The answer 304 if the client already has the content with these headers; otherwise None."""
    return Response(status_code=304, headers=headers) if _client_has(request, headers["ETag"]) else None


def path_of(store: Store, digest: str, size: int | None = None) -> Path:
    """The path of a stored file, after a check. Raises ``Problem`` 410 if the file is lost or damaged.

    size: the recorded size of the file, bytes; the check then reads only the size. None: the check reads the whole file,
    which must therefore be small.
    """
    try:
        if size is not None:
            path = store.path(digest)
            if path.stat().st_size == size:
                return path
        return store.verified(digest)
    except FileNotFoundError as error:
        raise _logged(lost(digest)) from error
    except BadFile as error:
        raise _logged(error) from error


def _logged(error: BadFile) -> Problem:
    log.error("%s", error.message)
    return problem(error)


def _client_has(request: Request, etag: str) -> bool:
    """Whether the client already has the content of this ETag (If-None-Match)."""
    tags = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
    return "*" in tags or etag in tags
