"""Uploads that continue after a cut of the connection, by the tus protocol 1.0: ``/v1/uploads``.

Extensions: creation, termination, expiration, checksum. See https://tus.io/protocols/resumable-upload. The metadata
``kind`` says what is uploaded ("transit" or "image"). If the metadata ``sha256`` declares the SHA-256 of the whole
file, the service checks it, and a second request for the same file gets the upload that is open already.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from email.utils import formatdate
from typing import Annotated, Any, BinaryIO

from fastapi import APIRouter, Path, Request, Response
from fastapi.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from psfcore.files import sha256_of
from service.http import files
from service.http.callers import Caller, Submitting
from service.http.gate import in_turn
from service.http.problems import RESPONSES, Problem, as_problems
from service.http.quotas import Allowed, check_length
from service.http.state import Shared, State
from workers.files.partial_uploads import PartialUpload, PartialUploads
from workers.intake.uploads import Upload

router = APIRouter(prefix="/v1/uploads", tags=["uploads"], responses=RESPONSES)
UploadId = Annotated[str, Path(pattern=r"^[0-9a-f]{32}$")]
VERSION = "1.0.0"
EXTENSIONS = "creation,termination,expiration,checksum"
ALGORITHMS = {
    "sha256": hashlib.sha256,
    "sha1": hashlib.sha1,
    "md5": hashlib.md5,
}
PART = "application/offset+octet-stream"
KINDS: dict[str, files.UploadKind[Any]] = {"transit": files.TRANSIT, "image": files.IMAGE}


def _header(name: str, description: str | None = None, *, required: bool = True) -> dict[str, object]:
    """The OpenAPI description of a header."""
    described = {} if description is None else {"description": description}
    return {"name": name, "in": "header", "required": required, "schema": {"type": "string"}, **described}


_PART_BODY = {
    "parameters": [
        _header("Tus-Resumable"),
        _header("Upload-Offset"),
        _header("Upload-Checksum", required=False),
    ],
    "requestBody": {"required": True, "content": {PART: {"schema": {"type": "string", "format": "binary"}}}},
}
_METADATA = (
    "kind (transit, which is the default, or image), filename and sha256, each with its value in base64"
)
_CREATION = {
    "parameters": [
        _header("Tus-Resumable", VERSION),
        _header("Upload-Length", "size of the file, bytes"),
        _header("Upload-Metadata", _METADATA, required=False),
    ]
}


@router.options("", status_code=204, summary="What this service supports of tus", response_class=Response)
def tus_options(caller: Submitting, state: Shared) -> Response:
    """The version and the extensions of tus, and the largest upload."""
    headers = {
        "Tus-Resumable": VERSION,
        "Tus-Version": VERSION,
        "Tus-Extension": EXTENSIONS,
        "Tus-Checksum-Algorithm": ",".join(ALGORITHMS),
        "Tus-Max-Size": str(state.settings.max_transit_bytes),
    }
    return Response(status_code=204, headers=headers)


@in_turn(
    router.post(
        "",
        status_code=201,
        summary="Begin a resumable upload",
        response_class=Response,
        openapi_extra=_CREATION,
        responses={200: {"description": "An upload of the same file is open; the answer is that upload."}},
    )
)
def begin_upload(request: Request, caller: Submitting, state: Shared) -> Response:
    """Begin an upload. `Location` is its address; send the bytes there with `PATCH`.

    If the file with the declared `sha256` was uploaded before, the answer has its address in `Content-Location`, and no
    bytes are needed.
    """
    _check_version(request)
    length = _number(request, "upload-length")
    metadata: dict[str, str] = {}  # pairs of a key and its value in base64
    for pair in filter(
        None, (part.strip() for part in request.headers.get("upload-metadata", "").split(","))
    ):
        key, _, value = pair.partition(" ")
        metadata[key] = _decoded(value.strip()).decode("utf-8", "replace")
    name, sha256 = metadata.get("kind", "transit"), metadata.get("sha256")
    if name not in KINDS:
        raise Problem(422, "bad-upload", f"expected the kind {' or '.join(KINDS)}; got {name[:40]!r}")
    kind = KINDS[name]
    if sha256 is not None and not (len(sha256) == 64 and set(sha256) <= set("0123456789abcdef")):
        raise Problem(422, "bad-upload", f"expected a SHA-256 of 64 hexadecimal digits; got {sha256[:80]!r}")
    kind.check_size(length, state)
    open_uploads = PartialUploads(state.settings.data_dir)
    if sha256 is not None:
        row = state.catalogue.get(kind.table, sha256, caller.owner)
        if row is not None and state.store.size(sha256) == length:
            location = f"{kind.address}/{sha256}"
            return _answer(200, {"Content-Location": location, "Upload-Offset": str(length)})
    with open_uploads.one_at_a_time():
        if sha256 is not None:
            equal = open_uploads.equal(caller.owner, name, length, sha256)
            if equal is not None:
                with _while_open(equal.id):
                    return _described(200, open_uploads, equal)
        check_length(state, caller, length)
        with as_problems():
            filename = files.label(metadata.get("filename"))
            upload = open_uploads.create(caller.owner, name, length, filename, sha256)
        return _described(201, open_uploads, upload)


@router.head("/{upload_id}", status_code=200, summary="How much has arrived", response_class=Response)
def upload_offset(upload_id: UploadId, request: Request, caller: Submitting, state: Shared) -> Response:
    """`Upload-Offset`: number of bytes that the service has. Continue from there."""
    with _while_open(upload_id):
        answer = _described(200, *_open_upload(upload_id, request, caller, state))
    answer.headers["Cache-Control"] = "no-store"
    return answer


@router.patch(
    "/{upload_id}",
    status_code=204,
    summary="Send the next bytes",
    response_class=Response,
    openapi_extra=_PART_BODY,
)
async def send_part(upload_id: UploadId, request: Request, caller: Submitting, state: Shared) -> Response:
    """Send the bytes from `Upload-Offset` on. The answer to the last bytes has the address of the file in
    `Content-Location`.

    If the connection is cut, the bytes that arrived are kept; those of a request with `Upload-Checksum` are not,
    because they cannot be checked. The answer is 409 if the offset is another one, 460 if the checksum does not fit,
    and 423 if another request sends bytes now.
    """
    if request.headers.get("content-type", "") != PART:
        raise Problem(415, "bad-upload", f"expected Content-Type: {PART}; got another one")
    with _while_open(upload_id), ExitStack() as held:
        open_uploads, upload = await run_in_threadpool(_open_upload, upload_id, request, caller, state)
        with as_problems():
            file = held.enter_context(open_uploads.opened(upload))
        offset = file.tell()
        if (sent := _number(request, "upload-offset")) != offset:
            raise Problem(409, "wrong-offset", f"expected bytes from {offset} on; got bytes from {sent} on")
        await _append(request, file, upload, Allowed(state, caller, upload.id))
        if file.tell() < upload.length:
            return _described(204, open_uploads, upload)
        location = await state.pixels.run(caller.owner, _complete, open_uploads, upload, caller, state)
    return _answer(204, {"Upload-Offset": str(upload.length), "Content-Location": location})


@router.delete("/{upload_id}", status_code=204, summary="Delete an open upload", response_class=Response)
def delete_upload(upload_id: UploadId, request: Request, caller: Submitting, state: Shared) -> Response:
    """Delete the bytes that have arrived. The upload cannot be continued."""
    open_uploads, upload = _open_upload(upload_id, request, caller, state)
    open_uploads.remove(upload)
    return _answer(204, {})


async def _append(request: Request, file: BinaryIO, upload: PartialUpload, take: Allowed) -> None:
    """Append the body to the received bytes. Raises ``Problem`` 413 and 460; then the bytes of this request are
    removed.
    """
    offset, declared, whole = file.tell(), request.headers.get("upload-checksum"), False
    algorithm, _, value = (declared or "").partition(" ")
    if declared is not None and algorithm not in ALGORITHMS:
        raise Problem(
            400, "bad-upload", f"expected a checksum by {', '.join(ALGORITHMS)}; got {algorithm[:20]!r}"
        )
    checksum = None if declared is None else _decoded(value)
    digest = None if declared is None else ALGORITHMS[algorithm]()
    try:
        async for chunk in request.stream():
            if file.tell() + len(chunk) > upload.length:
                raise Problem(
                    413, "too-large", f"expected {upload.length} bytes in all; got more: start a new upload"
                )
            if chunk:
                await run_in_threadpool(take, len(chunk))
                file.write(chunk)
                if digest is not None:
                    digest.update(chunk)
        if digest is not None and digest.digest() != checksum:
            raise Problem(
                460,
                "wrong-checksum",
                "expected bytes with the declared checksum; got bytes with another checksum: send this part again",
            )
        whole = True
    except ClientDisconnect as error:
        whole = checksum is None
        raise Problem(
            400,
            "upload-ended-early",
            "expected all announced bytes; the connection closed before: ask for the offset, then continue there",
        ) from error
    finally:
        if not whole:
            file.truncate(offset)
            file.seek(offset)
        file.flush()


def _complete(open_uploads: PartialUploads, upload: PartialUpload, caller: Caller, state: State) -> str:
    """Check a complete file and add it to the catalogue; returns its address.

    A file that cannot be used is removed. If the store or the database is away, the upload stays open.
    """
    path = open_uploads.path(upload)
    sha256 = sha256_of(path)
    try:
        if upload.sha256 not in (None, sha256):
            raise Problem(
                422,
                "wrong-checksum",
                f"expected a file with the SHA-256 {upload.sha256}; got one with {sha256}: upload it again",
            )
        kind = KINDS[upload.kind]
        summary = kind.inspect(path, state)
        row = kind.row(Upload(caller.owner, sha256, upload.length, upload.filename), summary)
        Allowed(state, caller).keep(path, sha256, row)
    except Problem:
        open_uploads.remove(upload)
        raise
    open_uploads.remove(upload)
    return f"{kind.address}/{sha256}"


def _open_upload(
    upload_id: str, request: Request, caller: Caller, state: State
) -> tuple[PartialUploads, PartialUpload]:
    """All open uploads, and the upload of a request. Raises ``Problem`` 412 for another version of tus, and 404."""
    _check_version(request)
    open_uploads = PartialUploads(state.settings.data_dir)
    upload = open_uploads.find(upload_id, caller.owner)
    if upload is None:
        raise _not_open(upload_id)
    return open_uploads, upload


@contextmanager
def _while_open(upload_id: str) -> Iterator[None]:
    """Raise ``Problem`` 404 if another request completes or deletes the upload during the ``with`` block."""
    try:
        yield
    except FileNotFoundError as error:
        raise _not_open(upload_id) from error


def _not_open(upload_id: str) -> Problem:
    return Problem(
        404,
        "no-such-upload",
        f"expected the id of an open upload; got {upload_id}, which was completed, deleted or has expired: begin the "
        "upload again",
    )


def _described(status: int, open_uploads: PartialUploads, upload: PartialUpload) -> Response:
    headers = {
        "Location": f"/v1/uploads/{upload.id}",
        "Upload-Offset": str(open_uploads.offset(upload)),
        "Upload-Length": str(upload.length),
        "Upload-Expires": formatdate(open_uploads.expires_at(upload), usegmt=True),
    }
    return _answer(status, headers)


def _answer(status: int, headers: dict[str, str]) -> Response:
    return Response(status_code=status, headers={"Tus-Resumable": VERSION, **headers})


def _check_version(request: Request) -> None:
    sent = request.headers.get("tus-resumable")
    if sent != VERSION:
        raise Problem(
            412,
            "tus-version",
            f"expected the header Tus-Resumable: {VERSION}; got {'none' if sent is None else repr(sent[:20])}",
        )


def _number(request: Request, name: str) -> int:
    text = request.headers.get(name, "")
    if not (text.isascii() and text.isdecimal() and len(text) < 16):
        raise Problem(
            400, "bad-upload", f"expected a number of bytes in the header {name.title()}; got {text[:40]!r}"
        )
    return int(text)


def _decoded(text: str) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise Problem(400, "bad-upload", f"expected a value in base64; got {text[:40]!r}") from error
