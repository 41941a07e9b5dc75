"""Files of requests and answers.

A stored file, or a content made from one, is sent with an ETag, which says whether the client has it already. An upload
is streamed to a temporary file; at the same time its bytes are hashed, counted and checked. No whole file is ever in
memory.
"""

from __future__ import annotations

import base64
import hashlib
import json
import logging
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Generic, Self, cast

from fastapi import Request
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse, Response
from starlette.types import Receive, Scope, Send

from psfcore.files import GZIP_START
from psfcore.fits.header import HeaderSummary, read_summary
from psfcore.fits.stored_psf import check_is_psf
from psfcore.transit.archive import START_BYTES, archive_kind, could_be_archive, list_archive
from service.client.outputs import base_name
from service.http.callers import Caller
from service.http.forms import FORM, URL_ENCODED, FormPart, chunks_of, media_type_of, pieces_of
from service.http.problems import Problem, as_problems, problem
from service.http.quotas import Allowed
from service.http.state import State, state_of
from workers.catalogue.catalogue import Row
from workers.catalogue.tables import ImageRow, PsfRow, TransitRow
from workers.files.store import BadFile, Store, lost
from workers.intake.uploads import Upload, image_row, transit_row, uploaded_psf_row

log = logging.getLogger(__name__)

FITS_TYPE, GZIP_TYPE, JSON_TYPE = "application/fits", "application/gzip", "application/json"
FITS_STARTS = (b"SIMPLE  =", GZIP_START)  # FITS, or FITS in gzip
FORM_BYTES = 2**16  # largest size of a form without its file
UNDECLARED_BYTES = 2**20  # bytes that are counted in one step if the request does not declare its length
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
    """The file with this SHA-256 as ETag, or 304 if the client already has it.

    Clients can check the received file against the SHA-256 in the header Repr-Digest (RFC 9530).

    Parameters
    ----------
    digest
        SHA-256 of the file; None: there is no file.
    size
        Recorded size of the file, bytes, as for ``path_of``.
    missing
        Code and message of the error if ``digest`` is None.

    Raises
    ------
    Problem
        Status 410 if the file is lost, and 404 if ``digest`` is None.
    """
    if digest is None:
        assert missing is not None
        raise Problem(404, *missing)
    content = base64.b64encode(bytes.fromhex(digest)).decode()
    headers = {"ETag": f'"{digest}"', "Cache-Control": KEPT, "Repr-Digest": f"sha-256=:{content}:"}
    if (same := not_modified(request, headers)) is not None:
        return same
    find = partial(path_of, store, digest, size)
    return _Stored(request, find, media_type=media_type, filename=filename, headers=headers)


class _Stored(FileResponse):
    """An answer with a stored file, which is fetched when it is the turn of the owner. The storage may be slow."""

    def __init__(
        self,
        request: Request,
        find: Callable[[], Path],
        *,
        media_type: str,
        filename: str | None,
        headers: dict[str, str],
    ) -> None:
        super().__init__("", media_type=media_type, filename=filename, headers=headers)
        self._request, self._find = request, find

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        caller: Caller = self._request.state.caller
        self.path = await state_of(self._request).stored.run(caller.owner, self._find)
        await super().__call__(scope, receive, send)


def headers_of(content: str) -> dict[str, str]:
    """The headers of an answer that is made from stored files. The text ``content`` determines the answer."""
    return {"ETag": f'"{hashlib.sha256(content.encode()).hexdigest()}"', "Cache-Control": KEPT}


def not_modified(request: Request, headers: dict[str, str]) -> Response | None:
    """The answer 304 if the client already has the content with these headers; otherwise None."""
    tags = [tag.strip().removeprefix("W/") for tag in request.headers.get("if-none-match", "").split(",")]
    has = "*" in tags or headers["ETag"] in tags
    return Response(status_code=304, headers=headers) if has else None


def json_of(store: Store, digest: str, size: int | None = None) -> dict[str, Any]:
    """The content of a stored JSON file. Errors and size: as for ``path_of``."""
    return cast("dict[str, Any]", json.loads(path_of(store, digest, size).read_bytes()))


def path_of(store: Store, digest: str, size: int | None = None) -> Path:
    """The path of a stored file, after a check. Raises ``Problem`` 410 if the file is lost or damaged.

    With `size`, the recorded size of the file in bytes, the check compares the sizes alone. Without it, the check reads
    the whole file to compute its SHA-256: use this for small files.
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


# --- uploads --------------------------------------------------------------------------------------------


def _body(what: str, media_type: str) -> dict[str, object]:
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


@dataclass(frozen=True)
class UploadKind(Generic[Row]):
    """A kind of file that can be uploaded.

    Attributes
    ----------
    may_start
        Function that says whether a file of this kind can start with these bytes. Its second argument is True if the
        file has no further bytes.
    content
        Function that reads the summary of a file, and raises DataError if the file cannot be used.
    row
        Function that makes the row of a file from its owner, SHA-256, size, name and summary.
    """

    address: str
    what: str
    code: str  # of the error for another kind of file
    table: type[Row]
    start_bytes: int
    may_start: Callable[[bytes, bool], bool]
    content: Callable[[Path, State], object]
    row: Callable[..., Row]
    limit: str = "max_upload_bytes"  # the setting

    def most_bytes(self, state: State) -> int:
        """Largest file of this kind, bytes."""
        return int(getattr(state.settings, self.limit))

    def check_start(self, start: bytes, *, whole: bool) -> None:
        """Raise ``Problem`` 415 if a file of this kind cannot start with these bytes."""
        if not self.may_start(start, whole):
            message = f"expected {self.what}; got a file that starts with {start[:9]!r}: check the file"
            raise Problem(415, self.code, message)

    def check_size(self, size_bytes: int, state: State) -> None:
        """Raise ``Problem`` 413 if a file is too large, and 400 if it is empty."""
        if size_bytes > self.most_bytes(state):
            raise _too_large(self.most_bytes(state))
        if size_bytes == 0:
            raise Problem(400, "empty-upload", f"expected {self.what}; got 0 bytes: check the file")

    def inspect(self, path: Path, state: State) -> object:
        """The summary of a received file. Raises ``Problem`` 413, 415 or 422 if the file cannot be used."""
        with path.open("rb") as file:
            self.check_start(file.read(self.start_bytes), whole=True)
        with as_problems():
            return self.content(path, state)


class RequestFile:
    """A file of a request, which is written to a temporary path and hashed while it arrives.

    Attributes
    ----------
    filename
        The name that the client gives to the file.
    bytes
        The number of bytes that have arrived.
    """

    def __init__(self, path: Path) -> None:
        self.filename: str | None = None
        self.bytes = 0
        self._file, self._digest = path.open("wb"), hashlib.sha256()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def write(self, piece: bytes) -> None:
        """Add the next bytes of the file."""
        self._digest.update(piece)
        self._file.write(piece)
        self.bytes += len(piece)

    @property
    def sha256(self) -> str:
        """SHA-256 of the bytes that have arrived."""
        return self._digest.hexdigest()


def _psf_content(path: Path, state: State) -> HeaderSummary:
    limits = state.settings.psf_limits
    summary = read_summary(path, limits)
    check_is_psf(path, summary, limits)
    return summary


_FITS = ("a FITS file, which starts with 'SIMPLE  ='", "not-fits")
_FITS_START = (
    max(map(len, FITS_STARTS)),
    lambda start, _whole: any(start.startswith(one[: len(start)]) for one in FITS_STARTS),
)
IMAGE = UploadKind(
    "/v1/images",
    *_FITS,
    ImageRow,
    *_FITS_START,
    lambda path, state: read_summary(path, state.settings.image_limits),
    image_row,
)
PSF = UploadKind(
    "/v1/psfs", *_FITS, PsfRow, *_FITS_START, _psf_content, uploaded_psf_row, limit="max_psf_bytes"
)
TRANSIT = UploadKind(
    "/v1/transits",
    "a .zip, .tar or .tar.gz",
    "not-an-archive",
    TransitRow,
    START_BYTES,
    lambda start, whole: could_be_archive(start) and (not whole or bool(archive_kind(start))),
    lambda path, state: list_archive(path, state.settings.archive_limits),
    transit_row,
    limit="max_transit_bytes",
)


async def add_upload(
    request: Request,
    response: Response,
    caller: Caller,
    state: State,
    kind: UploadKind[Row],
    *,
    equal: Callable[[str], Row | None] | None = None,
    columns: Mapping[str, str | None] | None = None,
) -> Row:
    """Receive the file of a request, check it and add it to the catalogue; returns its row.

    Sets the status and the header Location of the response.

    Parameters
    ----------
    equal
        Function that finds a row that stands for the file with this SHA-256. If there is one, the file is not added.
    columns
        Further arguments of ``kind.row``.

    Raises
    ------
    Problem
        Status 413 if the file exceeds the size limit or the quota, 415 if it is of another kind, 400 for a broken form
        or an incomplete upload, and 422 if the content shows that the file cannot be used.
    """
    allowed = Allowed(state, caller)
    with state.store.temporary() as path, _advising(request):
        file = await _receive(request, path, state, kind, allowed)
        summary = await state.pixels.run(caller.owner, kind.inspect, path, state)
        there = None if equal is None else await run_in_threadpool(equal, file.sha256)
        if there is None:
            upload = Upload(caller.owner, file.sha256, file.bytes, label(file.filename))
            row = kind.row(upload, summary, **(columns or {}))
            row, new = await state.stored.run(caller.owner, allowed.keep, path, file.sha256, row)
        else:
            row, new = there, False
    response.status_code = 201 if new else 200
    response.headers["Location"] = f"{kind.address}/{row.id}"
    return row


@contextmanager
def _advising(request: Request) -> Iterator[None]:
    """Add to an error about the content of a file how to send it, if the request looks like that of `curl -d @FILE`."""
    try:
        yield
    except Problem as error:
        if error.status not in (415, 422) or media_type_of(request) != URL_ENCODED:
            raise
        advice = (
            f"the body was sent as {URL_ENCODED}, as curl -d does, which removes zeros and line ends from a file: "
            "send it with curl -F file=@FILE or curl --data-binary @FILE"
        )
        raise Problem(
            error.status, error.code, f"{error.detail}; {advice}", headers=None, **error.more
        ) from error


async def _receive(
    request: Request, path: Path, state: State, kind: UploadKind[Row], take: Allowed
) -> RequestFile:
    """Write the file of a request to a path."""
    most_bytes = kind.most_bytes(state)
    text = request.headers.get("content-length", "")
    counted = int(text) if text.isdecimal() else 0
    if counted > most_bytes + FORM_BYTES:
        raise _too_large(most_bytes)
    if counted:  # if the length is declared, the upload can be refused before it is sent
        await run_in_threadpool(take, counted)
    start = b""
    with RequestFile(path) as file:
        async for name, chunk in _file_of(request, most_bytes):
            file.filename = name
            if len(start) < kind.start_bytes:
                start += chunk[: kind.start_bytes - len(start)]
                kind.check_start(start, whole=False)
            if file.bytes + len(chunk) > most_bytes:
                raise _too_large(most_bytes)
            if file.bytes + len(chunk) > counted:
                await run_in_threadpool(take, UNDECLARED_BYTES)
                counted += UNDECLARED_BYTES
            file.write(chunk)
    kind.check_size(file.bytes, state)
    return file


def _too_large(max_bytes: int) -> Problem:
    return Problem(
        413,
        "too-large",
        f"expected a file of at most {max_bytes} bytes; got more: ask the operator for a higher limit",
    )


async def _file_of(request: Request, max_bytes: int) -> AsyncIterator[tuple[str | None, bytes]]:
    """The pieces of the file in a request, each with the name of the file: the raw body, or the part ``file`` of a
    form.
    """
    if media_type_of(request) != FORM:
        filename = request.query_params.get("filename")
        async for chunk in chunks_of(request):
            yield filename, chunk
        return
    files: list[FormPart] = []
    async for pieces in pieces_of(request, max_bytes + FORM_BYTES):  # the other parts of the form count too
        for part, piece in pieces:
            if (part.name == "file" or part.filename is not None) and part not in files[-1:]:
                files.append(part)
            if piece and files and part is files[0]:
                yield part.filename, piece
    if [part.name for part in files] != ["file"]:
        raise Problem(
            400,
            "bad-form",
            f"expected a form with one file, in a part named 'file'; got {len(files)} "
            f"part{'s' if len(files) != 1 else ''} "
            "with a file: name the part 'file', and send each file in a request of its own",
        )


def label(filename: str | None) -> str | None:
    """A short printable label from a client's file name. The label is never used as a path."""
    return base_name(filename or "") or None
