"""Reads the forms of UWS clients, and checks the job parameters, which are texts in a form, against the contract."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from datetime import UTC, datetime
from typing import Annotated, Any
from urllib.parse import parse_qsl

from fastapi import Depends, Request
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails, from_json

from psfcore.errors import DataError
from service.http.forms import FORM, FormPart, Piece, chunks_of, media_type_of, pieces_of
from service.http.problems import Problem
from service.http.quotas import check_room
from service.http.state import State
from service.uws.documents import NO_XML
from workers.contract.kinds import KINDS, REQUESTS
from workers.contract.phases import Phase
from workers.contract.suggestions import did_you_mean, explained
from workers.intake import estimates
from workers.intake.requests import resolve

MAX_FORM_BYTES = 2**20
MAX_FIELDS = 64
SHOWN = 120
# The last four are phases of the standard. Jobs of this service are never in these phases, but clients may
# ask for such jobs.
PHASES = frozenset({*Phase, "HELD", "SUSPENDED", "UNKNOWN", "ARCHIVED"})
INTEGER = re.compile(r"-?[0-9]{1,15}", re.ASCII)


async def read_form(request: Request) -> dict[str, str]:
    """The fields of a form and of the address, by their names in lower case. Raises ``Problem`` if the body is not a form.

    A field without a value counts as not sent.
    """
    return single(await read_pairs(request))


async def read_pairs(request: Request) -> list[tuple[str, str]]:
    """The names and values of the fields of the address and of a form. Raises ``Problem`` if the body is not a form."""
    media_type = media_type_of(request)
    if media_type == FORM:
        sent = await multipart_pairs(request, MAX_FORM_BYTES)
    else:
        body = b""
        async for chunk in chunks_of(request):
            body += chunk
            if len(body) > MAX_FORM_BYTES:
                raise bad(f"expected a form of at most {MAX_FORM_BYTES} bytes, got more", 413)
        if body and media_type not in ("", "application/x-www-form-urlencoded"):
            raise bad(f"expected application/x-www-form-urlencoded, got {media_type}", 415)
        try:
            sent = parse_qsl(
                body.decode(), keep_blank_values=True, errors="strict", max_num_fields=MAX_FIELDS
            )
        except ValueError as error:
            raise bad(f"expected a form of at most {MAX_FIELDS} fields in UTF-8: {error}") from error
    return [*request.query_params.multi_items(), *sent]


Form = Annotated[dict[str, str], Depends(read_form)]


def query_of(request: Request, *several: str) -> dict[str, list[str]]:
    """The fields of the address, by their names in lower case. Only the fields in ``several`` may be repeated."""
    return repeated(request.query_params.multi_items(), *several)


def repeated(pairs: Iterable[tuple[str, str]], *several: str) -> dict[str, list[str]]:
    """The values of the fields, by their names in lower case, without empty ones. Only the fields in ``several`` may be repeated."""
    found: dict[str, list[str]] = {}
    for name, value in pairs:
        if value:
            found.setdefault(name.lower(), []).append(value)
    for name, values in found.items():
        if len(values) > 1 and name not in several:
            raise bad(f"expected {name.upper()} once; got it {len(values)} times")
    return found


def bad(message: str, status: int = 400) -> Problem:
    """The answer to a bad parameter."""
    return Problem(status, "bad-parameter", message)


def kind_of(form: dict[str, str]) -> str:
    """Remove KIND from a form and return it. Raises ``Problem`` if clients cannot request jobs of this kind."""
    kind = form.pop("kind", None)
    if kind is None or kind not in REQUESTS:
        hint = did_you_mean(kind or "", REQUESTS)
        raise bad(f"expected KIND, one of {', '.join(REQUESTS)}; got {_shown(kind)}{hint}")
    return kind


def integer(name: str, text: str, least: int) -> int:
    """A whole number of at least ``least``."""
    if not INTEGER.fullmatch(text) or int(text) < least:
        raise bad(f"expected {name}, a whole number of {least} or more; got {_shown(text)}")
    return int(text)


def moment(name: str, text: str) -> float:
    """Seconds since 1970 of a time in ISO 8601; a time without a zone is UTC."""
    try:
        when = datetime.fromisoformat(text)
        return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError) as error:
        raise bad(f"expected {name}, a time such as 2026-01-31T12:00:00Z; got {_shown(text)}") from error


def phase(text: str) -> str:
    """A phase of the standard."""
    if text not in PHASES:
        raise bad(f"expected PHASE, one of {', '.join(sorted(PHASES))}; got {_shown(text)}")
    return text


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
            raise bad(f"{name}: expected characters that XML can hold, got {_shown(text)}")
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
            message = f"{message}; got {_shown(error['input'])}"
        lines.append(f"{name}: {message}")
    return bad("\n".join(lines))


def _model(kind: str) -> type[BaseModel]:
    model = KINDS[kind].parameters
    assert model is not None
    return model


def _shown(value: object) -> str:
    if value is None:
        return "none"
    text = ascii(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def single(pairs: Iterable[tuple[str, str]]) -> dict[str, str]:
    """The fields of a form by their names in lower case, without empty ones. Raises ``Problem`` if a name occurs twice."""
    found: dict[str, str] = {}
    for name, value in pairs:
        name = name.lower()
        if name in found:
            raise bad(f"expected {_shown(name)} once, got it twice")
        found[name] = value
    return {name: value for name, value in found.items() if value}


async def multipart_pairs(
    request: Request, most_bytes: int, keep: Callable[[list[Piece]], None] | None = None
) -> list[tuple[str, str]]:
    """The names and values of the fields of a multipart form, in their order.

    keep: a function that takes the pieces of the files, and is called in a thread; None: the form must not contain files.
    Raises ``Problem`` if the form is broken or too large.
    """
    texts: dict[FormPart, bytearray] = {}
    got = 0
    async for pieces in pieces_of(request, most_bytes):
        files = [one for one in pieces if one[0].filename is not None]
        for part, piece in pieces:
            if part.filename is None:
                texts.setdefault(part, bytearray()).extend(piece)
                got += len(piece)
        if len(texts) > MAX_FIELDS:
            raise bad(f"expected a form of at most {MAX_FIELDS} fields; got more")
        if got > MAX_FORM_BYTES:
            raise bad(f"expected fields of at most {MAX_FORM_BYTES} bytes in all, got more", 413)
        if files and keep is None:
            raise bad("expected a form of fields without files; got a file")
        if files and keep is not None:
            await run_in_threadpool(keep, files)
    try:
        return [(part.name, text.decode()) for part, text in texts.items()]
    except UnicodeDecodeError as error:
        raise bad(f"expected fields of the form in UTF-8: {error}") from error
