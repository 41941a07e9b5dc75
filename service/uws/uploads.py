"""Files that UWS clients send with the parameters of a job: ``UPLOAD=name,param:part`` and a part of the form with the file.

Citation: IVOA DALI 1.1 (17 May 2017), standard parameter UPLOAD. The name says what the file is, and determines which
parameter of the job gets the id of the file: ``UPLOAD=image,param:f`` adds the image in the part ``f``, and sets
``image_id``. A file is checked and stored in the same way as by ``POST /v1/images``, ``/v1/transits`` or
``/v1/psfs``. Files at other addresses (``UPLOAD=name,http://...``) are refused: if the service fetched any address,
clients could use it to reach machines that they cannot reach themselves.
"""

from __future__ import annotations

import hashlib
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, BinaryIO

from fastapi import Depends, Request
from fastapi.concurrency import run_in_threadpool
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.requests import ClientDisconnect

from service.http import uploads
from service.http.callers import Caller, Submitting
from service.http.quotas import Allowed
from service.http.state import Shared, State
from service.uws.parameters import MAX_FIELDS, MAX_FORM_BYTES, bad, read_form, single
from workers.contract.kinds import KINDS
from workers.intake.uploads import image_row, transit_row, uploaded_psf_row

# The names in UPLOAD, and for each name the parameter that gets the id of the file.
NAMES = {"image": "image_id", "mask": "mask_id", "transit": "transit_id", "psf": "psf_id"}
INLINE = "param:"
MOST_FILES = len(NAMES)
COUNTED_BYTES = 2**20  # bytes that are counted against the caller's allowance in one step


@dataclass
class Part:
    """A file in a form, received to a temporary path."""

    filename: str | None
    path: Path
    digest: hashlib._Hash = field(default_factory=hashlib.sha256)
    bytes: int = 0

    @property
    def sha256(self) -> str:
        """SHA-256 of the file."""
        return self.digest.hexdigest()


@dataclass(frozen=True)
class Sent:
    """A form: its fields by their names in lower case, the values of UPLOAD, and the files by the names of their parts."""

    fields: dict[str, str]
    wanted: tuple[str, ...] = ()
    parts: Mapping[str, Part] = field(default_factory=dict)


async def _sent(request: Request, caller: Submitting, state: Shared) -> AsyncIterator[Sent]:
    """The form of a request, with its files. The temporary files are removed after the answer."""
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type != "multipart/form-data":
        form = await read_form(request)
        upload = form.pop("upload", None)
        yield Sent(form, () if upload is None else tuple(upload.split(";")))
        return
    with ExitStack() as resources:
        receiver = _Receiver(request, state, Allowed(state, caller), resources)
        pairs = [*request.query_params.multi_items(), *await receiver.receive()]
        wanted = [value for name, value in pairs if name.lower() == "upload" and value]
        fields = single((name, value) for name, value in pairs if name.lower() != "upload")
        yield Sent(fields, tuple(one for value in wanted for one in value.split(";")), receiver.parts)


SentForm = Annotated[Sent, Depends(_sent)]


def ids_of(sent: Sent, kind: str) -> dict[str, str]:
    """The parameters that the files of a form set: the id of each file, by the name of the parameter.

    Raises ``Problem`` if UPLOAD is malformed, names a part that the form does not have, or sets a parameter twice; if
    the kind of job has no such parameter; and if the form contains a file that no UPLOAD names.
    """
    return {NAMES[name]: sent.parts[part].sha256 for name, part in _named(sent, kind).items()}


def keep(state: State, caller: Caller, sent: Sent, kind: str) -> None:
    """Check the files of a form, and add them to the catalogue. If one of them is refused, none is added."""
    named = {name: sent.parts[part] for name, part in _named(sent, kind).items()}
    allowed = Allowed(state, caller)  # the bytes were counted against the caller's rate when they arrived
    additions = [_addition(state, caller.owner, name, part, allowed) for name, part in named.items()]
    for add in additions:
        add()


def _named(sent: Sent, kind: str) -> dict[str, str]:
    """The part of the form for each name in UPLOAD."""
    model = KINDS[kind].parameters
    assert model is not None
    possible = [name for name, parameter in NAMES.items() if parameter in model.model_fields]
    found: dict[str, str] = {}
    for wanted in sent.wanted:
        name, comma, uri = (text.strip() for text in wanted.partition(","))
        name = name.lower()
        if not comma or not uri.startswith(INLINE):
            raise bad(
                f"expected UPLOAD=NAME,{INLINE}PART, and the file in the part PART of a multipart form; got {wanted[:80]!a}: "
                "files at other addresses are not fetched"
            )
        if name not in possible:
            raise bad(
                f"expected UPLOAD of a file that a job of kind {kind} uses ({', '.join(possible) or 'none'}); got {name[:40]!a}"
            )
        part = uri.removeprefix(INLINE)
        if part not in sent.parts:
            raise bad(
                f"expected a part {part[:40]!a} with a file in the form, because UPLOAD names it; got none"
            )
        if name in found or NAMES[name] in sent.fields:
            raise bad(f"expected one {name}; got several: remove an UPLOAD or the parameter {NAMES[name]}")
        found[name] = part
    unused = sent.parts.keys() - found.values()
    if unused:
        part = min(unused)
        raise bad(
            f"expected UPLOAD=NAME,{INLINE}{part[:40]} for the file in the part {part[:40]!a}, with NAME one of {', '.join(possible)}; "
            "got none"
        )
    return found


def _addition(
    state: State, owner: str, name: str, part: Part, allowed: Allowed
) -> Callable[[], tuple[object, bool]]:
    """A function that stores a file and adds its row to the catalogue. Raises ``Problem`` 413, 415 or 422 if the file cannot be used."""
    settings, file = state.settings, (owner, part.sha256, part.bytes, part.filename)
    keep = partial(allowed.keep, part.path, part.sha256)
    if name == "transit":
        uploads.check_size(part.bytes, settings.max_transit_bytes)
        contents = uploads.archive_contents(part.path, settings.archive_limits)
        return partial(keep, transit_row(*file, contents))
    uploads.check_size(part.bytes, settings.max_upload_bytes)
    if name == "psf":
        return partial(keep, uploaded_psf_row(*file, uploads.psf_summary(part.path, state.limits)))
    return partial(keep, image_row(*file, uploads.fits_summary(part.path, state.limits)))


class _Receiver:
    """Receives a multipart form: fields into memory, files to temporary paths of the store."""

    def __init__(
        self, request: Request, state: State, take: Callable[[int], None], resources: ExitStack
    ) -> None:
        self._request, self._store, self._take, self._resources = request, state.store, take, resources
        self._most_bytes = MAX_FORM_BYTES + max(
            state.settings.max_upload_bytes, state.settings.max_transit_bytes
        )
        self.parts: dict[str, Part] = {}
        self._fields: list[tuple[str, str]] = []
        self._field_bytes, self._uncounted = 0, 0
        self._header, self._value = b"", b""
        self._name, self._text = "", b""
        self._filename: str | None = None
        self._file: BinaryIO | None = None
        self._arrived: list[tuple[Part, BinaryIO, bytes]] = []
        self._whole = False

    async def receive(self) -> list[tuple[str, str]]:
        """The fields of the form, in their order. Raises ``Problem`` if the form is broken or too large."""
        _, options = parse_options_header(self._request.headers.get("content-type", ""))
        if not options.get(b"boundary"):
            raise bad("expected a boundary in the multipart Content-Type, got none")
        parser = MultipartParser(
            options[b"boundary"],
            {
                "on_part_begin": self._begin,
                "on_header_field": self._header_name,
                "on_header_value": self._header_value,
                "on_header_end": self._header_end,
                "on_headers_finished": self._headers_finished,
                "on_part_data": self._data,
                "on_part_end": self._part_end,
                "on_end": self._end,
            },
        )
        got = 0
        try:
            async for chunk in self._request.stream():
                got += len(chunk)
                if got > self._most_bytes:
                    raise bad(f"expected a form of at most {self._most_bytes} bytes, got more", 413)
                parser.write(chunk)
                await run_in_threadpool(self._write)
        except FormParserError as error:
            raise bad(f"expected multipart/form-data: {error}") from error
        except UnicodeDecodeError as error:
            raise bad(f"expected names and fields of the form in UTF-8: {error}") from error
        except ClientDisconnect as error:
            raise bad(
                "expected the complete form; the connection closed before its end: send it again"
            ) from error
        if not self._whole:
            raise bad("expected the complete form; it ended before its last boundary: send it again")
        return self._fields

    def _write(self) -> None:
        """Write the bytes of files that have arrived, and count them."""
        arrived, self._arrived = self._arrived, []
        for part, file, data in arrived:
            self._uncounted -= len(data)
            while self._uncounted < 0:
                self._take(COUNTED_BYTES)
                self._uncounted += COUNTED_BYTES
            part.digest.update(data)
            part.bytes += len(data)
            file.write(data)
            file.flush()

    def _begin(self) -> None:
        self._name, self._filename, self._text, self._file = "", None, b"", None

    def _header_name(self, data: bytes, start: int, end: int) -> None:
        self._header += data[start:end]

    def _header_value(self, data: bytes, start: int, end: int) -> None:
        self._value += data[start:end]

    def _header_end(self) -> None:
        if self._header.lower() == b"content-disposition":
            _, options = parse_options_header(self._value)
            self._name = options.get(b"name", b"").decode()
            if b"filename" in options:
                self._filename = options[b"filename"].decode()
        self._header, self._value = b"", b""

    def _headers_finished(self) -> None:
        if not self._name:
            raise bad("expected a name for every part of the form; got a part without one")
        if self._filename is None:
            return
        if self._name in self.parts or len(self.parts) == MOST_FILES:
            raise bad(f"expected at most {MOST_FILES} files in parts of different names; got more")
        path = self._resources.enter_context(self._store.temporary())
        self._file = self._resources.enter_context(path.open("wb"))
        self.parts[self._name] = Part(uploads.label(self._filename), path)

    def _data(self, data: bytes, start: int, end: int) -> None:
        if self._file is not None:
            self._arrived.append((self.parts[self._name], self._file, data[start:end]))
            return
        self._field_bytes += end - start
        if self._field_bytes > MAX_FORM_BYTES:
            raise bad(f"expected fields of at most {MAX_FORM_BYTES} bytes in all, got more", 413)
        self._text += data[start:end]

    def _part_end(self) -> None:
        if self._file is None:
            if len(self._fields) == MAX_FIELDS:
                raise bad(f"expected a form of at most {MAX_FIELDS} fields; got more")
            self._fields.append((self._name, self._text.decode()))

    def _end(self) -> None:
        self._whole = True
