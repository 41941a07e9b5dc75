"""Receives an upload: streams it to the store, and at the same time hashes, counts and checks its bytes. The whole
upload is never in memory."""

from __future__ import annotations

import hashlib
import re
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import anyio.to_thread
from fastapi import Request
from fastapi.concurrency import run_in_threadpool

from psfcore.errors import DataError, HeaderError
from psfcore.fits.header import FitsLimits, HeaderSummary, read_summary
from psfcore.fits.stored_psf import check_is_psf
from psfcore.transit.archive import (
    START_BYTES,
    ArchiveContents,
    ArchiveLimits,
    archive_kind,
    could_be_archive,
    list_archive,
)
from service.http.forms import FORM, FormPart, chunks_of, media_type_of, pieces_of
from service.http.problems import Problem, problem
from service.http.state import state_of
from workers.files.store import Store

FITS_STARTS = (b"SIMPLE  =", b"\x1f\x8b")  # FITS, or FITS in gzip
FORM_BYTES = 2**16  # largest size of a form without its file
LARGE = frozenset(
    {f"{root}/{kind}" for root in ("", "/v1") for kind in ("images", "psfs", "transits")}
)  # upload addresses; they have their own limits
PARTS = "/v1/uploads/"  # addresses that receive parts of a resumable upload
UNDECLARED_BYTES = 2**20  # bytes that are counted in one step if the request does not declare its length
Take = Callable[[int], object]


def _body(what: str, media_type: str) -> dict[str, Any]:
    """The OpenAPI description of an upload."""
    return {
        "parameters": [
            {
                "name": "filename",
                "in": "query",
                "required": False,
                "description": "file name to show in lists, if the body is the file itself",
                "schema": {"type": "string"},
            }
        ],
        "requestBody": {
            "required": True,
            "description": f"The {what}: the body itself, or the part `file` of a form.",
            "content": {
                media_type: {"schema": {"type": "string", "format": "binary"}},
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


OPENAPI_BODY = _body("FITS file", "application/fits")
OPENAPI_TRANSIT_BODY = _body("archive of the transit (.zip, .tar or .tar.gz)", "application/octet-stream")

Found = TypeVar("Found")
FoundOut = TypeVar("FoundOut", covariant=True)


@dataclass(frozen=True)
class Upload(Generic[Found]):
    """A completely received file and a summary of its content. The file is not yet in the store."""

    path: Path
    sha256: str
    bytes: int
    filename: str | None
    summary: Found


class _Format(Protocol[FoundOut]):
    """A kind of file that can be uploaded."""

    what: str
    start_bytes: int

    def recognise(self, start: bytes, *, whole: bool) -> None:
        """Raise ``Problem`` if a file of this kind cannot start with these bytes. whole: there are no further bytes."""

    def inspect(self, path: Path) -> FoundOut:
        """Read the summary of the file. Raises ``Problem`` if the file cannot be used."""


@asynccontextmanager
async def receive(
    request: Request, store: Store, limits: FitsLimits, max_bytes: int, take: Take
) -> AsyncIterator[Upload[HeaderSummary]]:
    """Stream the request's FITS file to a temporary path and inspect its header.

    take: counts bytes against the caller's allowance. Raises ``Problem`` 413 if the file exceeds the size limit, 415 if it
    is not FITS, 400 for a broken form or an incomplete upload, and 422 if the header shows that the file cannot be used.
    """
    async with _receive(request, store, _Fits(limits), max_bytes, take) as upload:
        yield upload


@asynccontextmanager
async def receive_psf(
    request: Request, store: Store, limits: FitsLimits, max_bytes: int, take: Take
) -> AsyncIterator[Upload[HeaderSummary]]:
    """Stream the request's FITS file to a temporary path and check that it can be a PSF.

    Raises the same ``Problem`` as ``receive``, and 422 if the file cannot be a PSF.
    """
    async with _receive(request, store, _PsfFile(limits), max_bytes, take) as upload:
        yield upload


@asynccontextmanager
async def receive_transit(
    request: Request, store: Store, limits: ArchiveLimits, max_bytes: int, take: Take
) -> AsyncIterator[Upload[ArchiveContents]]:
    """Stream a transit's archive to a temporary path and check its table of contents and its transit.json.

    Raises the same ``Problem`` as ``receive``. In addition: 413 if the unpacked files would exceed the limits, 415 if the file
    is not an archive, and 422 if the transit cannot be used.
    """
    async with _receive(request, store, _Archive(limits), max_bytes, take) as upload:
        yield upload


@asynccontextmanager
async def _receive(
    request: Request, store: Store, expected: _Format[Found], max_bytes: int, take: Take
) -> AsyncIterator[Upload[Found]]:
    declared = _refuse_by_length(request, max_bytes)
    taken = declared
    if declared:  # if the length is declared, the upload can be refused before it is sent
        await run_in_threadpool(take, declared)
    with store.temporary() as path:
        digest, size, start, filename = hashlib.sha256(), 0, b"", None
        with path.open("wb") as file:
            async for name, chunk in _file_of(request, max_bytes):
                filename = name
                if len(start) < expected.start_bytes:
                    start += chunk[: expected.start_bytes - len(start)]
                    expected.recognise(start, whole=False)
                size += len(chunk)
                if size > max_bytes:
                    raise _too_large(max_bytes)
                if size > taken:
                    await run_in_threadpool(take, UNDECLARED_BYTES)
                    taken += UNDECLARED_BYTES
                digest.update(chunk)
                file.write(chunk)
        if size == 0:
            raise Problem(400, "empty-upload", f"expected {expected.what}; got 0 bytes: check the file")
        expected.recognise(start, whole=True)
        limiter = state_of(request).inspecting
        found = await anyio.to_thread.run_sync(expected.inspect, path, limiter=limiter)
        yield Upload(path, digest.hexdigest(), size, filename, found)


class _Fits:
    what = "a FITS file"
    start_bytes = max(map(len, FITS_STARTS))

    def __init__(self, limits: FitsLimits) -> None:
        self._limits = limits

    def recognise(self, start: bytes, *, whole: bool) -> None:
        """Refuse a file that is not FITS at its first bytes, before the rest is received."""
        if not any(start.startswith(known[: len(start)]) for known in FITS_STARTS):
            raise Problem(
                415,
                "not-fits",
                f"expected a FITS file (it starts with 'SIMPLE  ='); got {start[:9]!r}: check the file",
            )

    def inspect(self, path: Path) -> HeaderSummary:
        try:
            return read_summary(path, self._limits)
        except HeaderError as error:
            raise problem(error) from error


class _PsfFile(_Fits):
    def inspect(self, path: Path) -> HeaderSummary:
        summary = super().inspect(path)
        try:
            check_is_psf(path, summary, self._limits)
        except DataError as error:
            raise problem(error) from error
        return summary


class _Archive:
    what = "a .zip, .tar or .tar.gz"
    start_bytes = START_BYTES

    def __init__(self, limits: ArchiveLimits) -> None:
        self._limits = limits

    def recognise(self, start: bytes, *, whole: bool) -> None:
        """Refuse a file that is not an archive at its first bytes, before the rest is received."""
        if not (could_be_archive(start) and (not whole or archive_kind(start))):
            raise Problem(
                415, "not-an-archive", f"expected {self.what}; got bytes {start[:9]!r}: check the file"
            )

    def inspect(self, path: Path) -> ArchiveContents:
        try:
            return list_archive(path, self._limits)
        except DataError as error:
            raise problem(error) from error


def _refuse_by_length(request: Request, max_bytes: int) -> int:
    """The length that the request declares; 0 if it declares none. Raises ``Problem`` 413 if it is too large."""
    text = request.headers.get("content-length", "")
    declared = int(text) if text.isdecimal() else 0
    if declared > max_bytes + FORM_BYTES:
        raise _too_large(max_bytes)
    return declared


def check_size(size_bytes: int, max_bytes: int) -> None:
    """Raise ``Problem`` 413 if a received file is too large, and 400 if it is empty."""
    if size_bytes > max_bytes:
        raise _too_large(max_bytes)
    if size_bytes == 0:
        raise Problem(400, "empty-upload", "expected a file; got 0 bytes: check the file")


def fits_summary(path: Path, limits: FitsLimits) -> HeaderSummary:
    """The summary of a received FITS file. Raises ``Problem`` 415 or 422 if it cannot be used."""
    return _inspected(path, _Fits(limits))


def psf_summary(path: Path, limits: FitsLimits) -> HeaderSummary:
    """As ``fits_summary``, for a PSF. Raises ``Problem`` 422 if the file cannot be a PSF."""
    return _inspected(path, _PsfFile(limits))


def archive_contents(path: Path, limits: ArchiveLimits) -> ArchiveContents:
    """The contents of a received archive of a transit. Raises ``Problem`` 413, 415 or 422 if it cannot be used."""
    return _inspected(path, _Archive(limits))


def _inspected(path: Path, expected: _Format[Found]) -> Found:
    with path.open("rb") as file:
        expected.recognise(file.read(expected.start_bytes), whole=True)
    return expected.inspect(path)


def has_own_limit(address: str, content_type: str) -> bool:
    """Whether the route itself limits the size of a body of this type, because the body may contain files."""
    form = content_type.lower().startswith(FORM)
    return (
        address in LARGE
        or address.startswith(PARTS)
        or (form and re.fullmatch(r"/uws/jobs(/[^/]+/parameters)?", address) is not None)
    )


def _too_large(max_bytes: int) -> Problem:
    return Problem(
        413,
        "too-large",
        f"expected a file of at most {max_bytes} bytes; got more: ask the operator for a higher limit",
    )


async def _file_of(request: Request, max_bytes: int) -> AsyncIterator[tuple[str | None, bytes]]:
    """The pieces of the file in a request, each with the label of the file: the raw body, or the part ``file`` of a form."""
    if media_type_of(request) != FORM:
        filename = label(request.query_params.get("filename"))
        async for chunk in chunks_of(request):
            yield filename, chunk
        return
    file: FormPart | None = None
    async for pieces in pieces_of(request, max_bytes + FORM_BYTES):  # the other parts of the form count too
        for part, piece in pieces:
            if file is None and part.name == "file":
                file = part
            if part is file and piece:
                yield label(file.filename), piece
    if file is None:
        raise Problem(
            400,
            "bad-form",
            "expected a form with a part named 'file'; got none: name the part with the file 'file'",
        )


def label(filename: str | None) -> str | None:
    """A short printable label from a client's file name. The label is never used as a path."""
    if not filename:
        return None
    last = re.split(r"[/\\]", filename)[-1]
    return "".join(c for c in last if c.isprintable())[:200] or None
