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
from typing import Annotated, Any, BinaryIO

from fastapi import Depends, Request

from service.http import uploads
from service.http.callers import Caller, Submitting
from service.http.forms import FORM, FormPart, Piece, media_type_of
from service.http.quotas import Allowed
from service.http.state import Shared, State
from service.uws.parameters import MAX_FORM_BYTES, bad, multipart_pairs, read_form, single
from workers.contract.kinds import KINDS
from workers.files.store import Store

# The names in UPLOAD, and for each name the parameter that gets the id of the file.
NAMES = {"image": "image_id", "mask": "mask_id", "transit": "transit_id", "psf": "psf_id"}
KINDS_OF: dict[str, uploads.Kind[Any]] = {
    "image": uploads.IMAGE,
    "mask": uploads.IMAGE,
    "transit": uploads.TRANSIT,
    "psf": uploads.PSF,
}
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
    if media_type_of(request) != FORM:
        form = await read_form(request)
        upload = form.pop("upload", None)
        yield Sent(form, () if upload is None else tuple(upload.split(";")))
        return
    with ExitStack() as resources:
        files = _Files(state.store, Allowed(state, caller), resources)
        most = MAX_FORM_BYTES + max(state.settings.max_upload_bytes, state.settings.max_transit_bytes)
        pairs = [
            *request.query_params.multi_items(),
            *await multipart_pairs(request, most, files.write),
        ]
        wanted = [value for name, value in pairs if name.lower() == "upload" and value]
        fields = single((name, value) for name, value in pairs if name.lower() != "upload")
        yield Sent(fields, tuple(one for value in wanted for one in value.split(";")), files.parts)


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
    kind = KINDS_OF[name]
    kind.check_size(part.bytes, state)
    row = kind.row(owner, part.sha256, part.bytes, part.filename, kind.inspect(part.path, state))
    return partial(allowed.keep, part.path, part.sha256, row)


class _Files:
    """Writes the files of a form to temporary paths of the store, and counts their bytes.

    parts: the files by the names of their parts.
    """

    def __init__(self, store: Store, take: Callable[[int], None], resources: ExitStack) -> None:
        self._store, self._take, self._resources = store, take, resources
        self._uncounted = 0
        self._open: dict[FormPart, BinaryIO] = {}
        self.parts: dict[str, Part] = {}

    def write(self, pieces: list[Piece]) -> None:
        """Write the bytes of files that have arrived."""
        for sent, data in pieces:
            if sent not in self._open:
                self._begin(sent)
            self._uncounted -= len(data)
            while self._uncounted < 0:
                self._take(COUNTED_BYTES)
                self._uncounted += COUNTED_BYTES
            part, file = self.parts[sent.name], self._open[sent]
            part.digest.update(data)
            part.bytes += len(data)
            file.write(data)
            file.flush()

    def _begin(self, sent: FormPart) -> None:
        if sent.name in self.parts or len(self.parts) == MOST_FILES:
            raise bad(f"expected at most {MOST_FILES} files in parts of different names; got more")
        path = self._resources.enter_context(self._store.temporary())
        self._open[sent] = self._resources.enter_context(path.open("wb"))
        self.parts[sent.name] = Part(uploads.label(sent.filename), path)
