"""One upload, streamed to the store: hashed, counted and recognised as it comes, never held in memory."""

from __future__ import annotations

import hashlib
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fastapi import Request
from fastapi.concurrency import run_in_threadpool
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.requests import ClientDisconnect

from psfcore.errors import HeaderError
from psfcore.header import FitsLimits, HeaderSummary, read_summary
from service.problems import Problem
from workers.store import Store

if TYPE_CHECKING:
    from python_multipart.multipart import MultipartCallbacks

FITS_STARTS = (b"SIMPLE  =", b"\x1f\x8b")  # FITS, or FITS in gzip
FORM_BYTES = 2**16  # what a form may add to the file
START_BYTES = max(map(len, FITS_STARTS))
OPENAPI_BODY: dict[str, Any] = {
    "parameters": [
        {
            "name": "filename",
            "in": "query",
            "required": False,
            "description": "a label for people, where the file is the body itself",
            "schema": {"type": "string"},
        }
    ],
    "requestBody": {
        "required": True,
        "description": "The FITS file, as the body itself or as the part `file` of a form.",
        "content": {
            "application/fits": {"schema": {"type": "string", "format": "binary"}},
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "properties": {"file": {"type": "string", "format": "binary"}},
                    "required": ["file"],
                }
            },
        },
    },
}


@dataclass(frozen=True)
class Upload:
    """A file that came whole and whose header is good; not yet kept."""

    path: Path
    sha256: str
    bytes: int
    filename: str | None
    summary: HeaderSummary


@asynccontextmanager
async def receive(
    request: Request, store: Store, limits: FitsLimits, max_bytes: int
) -> AsyncIterator[Upload]:
    """Stream the request's file to a temporary path and inspect its header.

    Raises ``Problem`` 413 over the size limit, 415 for what is no FITS, 400 for a broken form or an upload
    that ended early, and 422 for a header that shows a file that cannot be used.
    """
    _refuse_by_length(request, max_bytes)
    with store.temporary() as path:
        body = _Body(request, max_bytes)
        digest, size, start = hashlib.sha256(), 0, b""
        with path.open("wb") as file:
            async for chunk in body.chunks():
                if len(start) < START_BYTES:
                    start += chunk[: START_BYTES - len(start)]
                    _recognise(start)
                size += len(chunk)
                if size > max_bytes:
                    raise _too_large(max_bytes)
                digest.update(chunk)
                file.write(chunk)
        if size == 0:
            raise Problem(400, "empty-upload", "expected a FITS file, got 0 bytes")
        try:
            summary = await run_in_threadpool(read_summary, path, limits)
        except HeaderError as error:
            raise Problem(422, error.code, error.message) from error
        yield Upload(path, digest.hexdigest(), size, body.filename, summary)


def _refuse_by_length(request: Request, max_bytes: int) -> None:
    declared = request.headers.get("content-length", "")
    if declared.isdecimal() and int(declared) > max_bytes + FORM_BYTES:
        raise _too_large(max_bytes)


def _too_large(max_bytes: int) -> Problem:
    return Problem(413, "too-large", f"expected a file of at most {max_bytes} bytes, got more")


def _recognise(start: bytes) -> None:
    """Refuse at the first bytes what cannot become FITS, before the rest is taken."""
    if not any(start.startswith(known[: len(start)]) for known in FITS_STARTS):
        raise Problem(
            415, "not-fits", f"expected a FITS file (it starts with 'SIMPLE  ='), got {start[:9]!r}"
        )


class _Body:
    """The file in a request: the raw body, or the part named ``file`` of a form."""

    def __init__(self, request: Request, max_bytes: int) -> None:
        self._request, self._max_bytes = request, max_bytes
        self.filename: str | None = None
        self._ready: list[bytes] = []
        self._name, self._value = b"", b""
        self._in_file = self._seen_file = self._whole = False

    async def chunks(self) -> AsyncIterator[bytes]:
        kind, options = parse_options_header(self._request.headers.get("content-type", ""))
        try:
            if kind == b"multipart/form-data":
                async for chunk in self._form(options):
                    yield chunk
            else:
                self.filename = _label(self._request.query_params.get("filename"))
                async for chunk in self._request.stream():
                    if chunk:
                        yield chunk
        except ClientDisconnect as error:
            raise Problem(
                400, "upload-ended-early", "the connection closed before the file was whole"
            ) from error

    async def _form(self, options: dict[bytes, bytes]) -> AsyncIterator[bytes]:
        if not options.get(b"boundary"):
            raise Problem(400, "bad-form", "expected a boundary in the multipart Content-Type, got none")
        callbacks: MultipartCallbacks = {
            "on_part_begin": self._part_begin,
            "on_header_field": self._header_field,
            "on_header_value": self._header_value,
            "on_header_end": self._header_end,
            "on_part_data": self._part_data,
            "on_end": self._end,
        }
        parser = MultipartParser(options[b"boundary"], callbacks)
        try:
            sent = 0
            async for chunk in self._request.stream():
                sent += len(chunk)
                if sent > self._max_bytes + FORM_BYTES:  # parts that are not the file count too
                    raise _too_large(self._max_bytes)
                parser.write(chunk)
                while self._ready:
                    yield self._ready.pop(0)
        except FormParserError as error:
            raise Problem(400, "bad-form", f"expected multipart/form-data: {error}") from error
        if not self._seen_file:
            raise Problem(400, "bad-form", "expected a form with a part named 'file', got none")
        if not self._whole:
            raise Problem(400, "upload-ended-early", "the form ended before its last boundary")

    def _part_begin(self) -> None:
        self._in_file = False

    def _header_field(self, data: bytes, start: int, end: int) -> None:
        self._name += data[start:end]

    def _header_value(self, data: bytes, start: int, end: int) -> None:
        self._value += data[start:end]

    def _header_end(self) -> None:
        if self._name.lower() == b"content-disposition":
            _, options = parse_options_header(self._value)
            if options.get(b"name") == b"file" and not self._seen_file:
                self._in_file = self._seen_file = True
                self.filename = _label(options.get(b"filename", b"").decode("utf-8", "replace"))
        self._name, self._value = b"", b""

    def _part_data(self, data: bytes, start: int, end: int) -> None:
        if self._in_file:
            self._ready.append(data[start:end])

    def _end(self) -> None:
        self._whole = True


def _label(filename: str | None) -> str | None:
    """A client's file name as a label for people: its last part, printable, short. It is never a path."""
    if not filename:
        return None
    last = re.split(r"[/\\]", filename)[-1]
    return "".join(c for c in last if c.isprintable())[:200] or None
