"""Reads and checks the forms of UWS clients: the parameters of a job, and files that are sent with them.

Each parameter of a job is a text in a form; it is checked against the contract. A file is in a part of a multipart form, and
``UPLOAD=name,param:part`` names it.

Citation: IVOA DALI 1.1 (17 May 2017), standard parameter UPLOAD. The name says what the file is, and determines which
parameter of the job gets the id of the file: ``UPLOAD=image,param:f`` adds the image in the part ``f``, and sets
``image_id``. A file is checked and stored in the same way as by ``POST /v1/images``, ``/v1/transits`` or
``/v1/psfs``. Files at other addresses (``UPLOAD=name,http://...``) are refused: if the service fetched any address,
clients could use it to reach machines that they cannot reach themselves.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from typing import Annotated, Any

from fastapi import Depends, Request
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails, from_json

from psfcore.errors import DataError
from service.http.callers import Caller, Submitting
from service.http.files import IMAGE, PSF, TRANSIT, Kind, RequestFile, label
from service.http.forms import FORM, FormPart, Piece, media_type_of
from service.http.problems import Problem
from service.http.quotas import Allowed, check_room
from service.http.state import Shared, State
from service.vo.parameters import (
    MAX_FORM_BYTES,
    NO_XML,
    bad,
    multipart_pairs,
    read_pairs,
    shown,
    single,
)
from workers.contract.kinds import KINDS, REQUESTS
from workers.contract.suggestions import did_you_mean, explained
from workers.files.store import Store
from workers.intake import estimates
from workers.intake.requests import resolve

# The names in UPLOAD, and for each name the parameter that gets the id of the file.
NAMES = {"image": "image_id", "mask": "mask_id", "transit": "transit_id", "psf": "psf_id"}
KINDS_OF: dict[str, Kind[Any]] = {
    "image": IMAGE,
    "mask": IMAGE,
    "transit": TRANSIT,
    "psf": PSF,
}
INLINE = "param:"
MOST_FILES = len(NAMES)
COUNTED_BYTES = 2**20  # bytes that are counted against the caller's allowance in one step


def kind_of(form: dict[str, str]) -> str:
    """Remove KIND from a form and return it. Raises ``Problem`` if clients cannot request jobs of this kind."""
    kind = form.pop("kind", None)
    if kind is None or kind not in REQUESTS:
        hint = did_you_mean(kind or "", REQUESTS)
        raise bad(f"expected KIND, one of {', '.join(REQUESTS)}; got {shown(kind)}{hint}")
    return kind


def check(kind: str, given: dict[str, str]) -> None:
    """Raise ``Problem`` for a wrong parameter of a PENDING job; parameters may still be missing."""
    _values, errors = _understood(kind, given)
    wrong = [e for e in errors if e["loc"] and not (e["type"] == "missing" and len(e["loc"]) == 1)]
    if wrong:
        raise _wrong(kind, wrong)


def resolved(
    state: State, owner: str, kind: str, given: dict[str, str]
) -> tuple[dict[str, Any], str, dict[str, Any]]:
    """Resolved parameters of a job, the identity of its result, and its estimate.

    Raises ``Problem`` 400 if the parameters are wrong or the job would exceed the limits on memory or time, and 507 if the
    owner's quota is full.
    """
    check_room(state, owner)
    values, errors = _understood(kind, given)
    if errors:
        raise _wrong(kind, errors)
    asked: Any = REQUESTS[kind].model_validate({"kind": kind, "parameters": values})
    try:
        parameters, key = resolve(asked, state.catalogue, owner, added_effects=state.settings.added_effects)
        return parameters, key, estimates.checked(kind, parameters, state.catalogue, owner, state.settings)
    except DataError as error:
        raise bad(error.message) from error


def _understood(kind: str, given: dict[str, str]) -> tuple[dict[str, Any], list[ErrorDetails]]:
    """The parameters, and an error for each parameter that the contract does not accept.

    Each parameter is a text. If the contract accepts the text as it is (a name, a number, true or false), the text is
    kept. Otherwise the text is read as JSON.
    """
    for name, text in given.items():
        if NO_XML.search(text):
            raise bad(f"{name}: expected characters that XML can hold, got {shown(text)}")
    values: dict[str, Any] = dict(given)
    for name in {str(error["loc"][0]) for error in _errors(kind, values) if error["loc"]} & given.keys():
        with suppress(ValueError):
            values[name] = from_json(given[name], allow_inf_nan=False)
    return values, _errors(kind, values)


def _errors(kind: str, values: dict[str, Any]) -> list[ErrorDetails]:
    try:
        _model(kind).model_validate(values)
    except ValidationError as error:
        return error.errors(include_url=False)
    return []


def _wrong(kind: str, errors: Iterable[ErrorDetails]) -> Problem:
    lines = []
    for error, message in explained(errors, _model(kind)):
        name = "/".join(map(str, error["loc"])) or kind
        if error["type"] == "missing":
            message = "expected a value, got none"
        elif error["type"] not in ("extra_forbidden", "union_tag_invalid"):
            message = f"{message}; got {shown(error['input'])}"
        lines.append(f"{name}: {message}")
    return bad("\n".join(lines))


def _model(kind: str) -> type[BaseModel]:
    model = KINDS[kind].parameters
    assert model is not None
    return model


# Files ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sent:
    """A form: its fields by their names in lower case, the values of UPLOAD, and the files by the names of their parts."""

    fields: dict[str, str]
    uploads: tuple[str, ...] = ()
    parts: Mapping[str, RequestFile] = field(default_factory=dict)


async def _sent(request: Request, caller: Submitting, state: Shared) -> AsyncIterator[Sent]:
    """The form of a request, with its files. The temporary files are removed after the answer."""
    if media_type_of(request) != FORM:
        form = single(await read_pairs(request))
        upload = form.pop("upload", None)
        yield Sent(form, () if upload is None else tuple(upload.split(";")))
        return
    with ExitStack() as resources:
        files = _Files(state.store, Allowed(state, caller), resources)
        most = MAX_FORM_BYTES + max(state.settings.max_upload_bytes, state.settings.max_transit_bytes)
        pairs = [*request.query_params.multi_items(), *await multipart_pairs(request, most, files.write)]
        named = [value for name, value in pairs if name.lower() == "upload" and value]
        fields = single((name, value) for name, value in pairs if name.lower() != "upload")
        yield Sent(fields, tuple(one for value in named for one in value.split(";")), files.parts)


SentForm = Annotated[Sent, Depends(_sent)]


def files_of(sent: Sent, kind: str) -> dict[str, RequestFile]:
    """The file for each name in UPLOAD.

    Raises ``Problem`` if UPLOAD is malformed, names a part that the form does not have, or sets a parameter twice; if
    the kind of job has no such parameter; and if the form contains a file that no UPLOAD names.
    """
    possible = [name for name, parameter in NAMES.items() if parameter in _model(kind).model_fields]
    parts: dict[str, str] = {}
    for upload in sent.uploads:
        name, comma, uri = (text.strip() for text in upload.partition(","))
        name = name.lower()
        if not comma or not uri.startswith(INLINE):
            raise bad(
                f"expected UPLOAD=NAME,{INLINE}PART, and the file in the part PART of a multipart form; got {upload[:80]!a}: "
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
        if name in parts or NAMES[name] in sent.fields:
            raise bad(f"expected one {name}; got several: remove an UPLOAD or the parameter {NAMES[name]}")
        parts[name] = part
    unused = sent.parts.keys() - parts.values()
    if unused:
        part = min(unused)
        raise bad(
            f"expected UPLOAD=NAME,{INLINE}{part[:40]} for the file in the part {part[:40]!a}, with NAME one of {', '.join(possible)}; "
            "got none"
        )
    return {name: sent.parts[part] for name, part in parts.items()}


def ids_of(files: Mapping[str, RequestFile]) -> dict[str, str]:
    """The parameters that the files of a form set: the id of each file, by the name of the parameter."""
    return {NAMES[name]: file.sha256 for name, file in files.items()}


def keep(state: State, caller: Caller, files: Mapping[str, RequestFile]) -> None:
    """Check the files of a form, and add them to the catalogue. If one of them is refused, none is added.

    Raises ``Problem`` 413, 415 or 422 if a file cannot be used.
    """
    rows: list[Any] = []
    for name, file in files.items():
        kind = KINDS_OF[name]
        kind.check_size(file.bytes, state)
        summary = kind.inspect(file.path, state)
        rows.append(kind.row(caller.owner, file.sha256, file.bytes, label(file.filename), summary))
    allowed = Allowed(state, caller)  # the bytes were counted against the caller's rate when they arrived
    for file, row in zip(files.values(), rows, strict=True):
        allowed.keep(file.path, file.sha256, row)


class _Files:
    """Writes the files of a form to temporary paths of the store, and counts their bytes.

    parts: the files by the names of their parts.
    """

    def __init__(self, store: Store, take: Callable[[int], None], resources: ExitStack) -> None:
        self._store, self._take, self._resources = store, take, resources
        self._uncounted = 0
        self._open: dict[FormPart, RequestFile] = {}
        self.parts: dict[str, RequestFile] = {}

    def write(self, pieces: list[Piece]) -> None:
        """Write the bytes of files that have arrived."""
        for sent, data in pieces:
            if sent not in self._open:
                self._begin(sent)
            self._uncounted -= len(data)
            while self._uncounted < 0:
                self._take(COUNTED_BYTES)
                self._uncounted += COUNTED_BYTES
            self._open[sent].write(data)

    def _begin(self, sent: FormPart) -> None:
        if sent.name in self.parts or len(self.parts) == MOST_FILES:
            raise bad(f"expected at most {MOST_FILES} files in parts of different names; got more")
        path = self._resources.enter_context(self._store.temporary())
        file = self._resources.enter_context(RequestFile(path, sent.filename))
        self._open[sent] = self.parts[sent.name] = file
