"""What UWS clients send: forms, and job parameters as text, read against the contract."""

from __future__ import annotations

import re
from collections.abc import AsyncGenerator, Iterable
from contextlib import suppress
from datetime import UTC, datetime
from typing import Annotated, Any, get_args
from urllib.parse import parse_qsl

from fastapi import Depends, Request
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails, from_json
from python_multipart.exceptions import FormParserError
from starlette.formparsers import MultiPartException, MultiPartParser

from psfcore.errors import DataError
from service.http.problems import Problem
from service.http.quotas import check_room
from service.http.state import State
from service.uws.documents import NO_XML
from workers.contract.contract import JobRequest, Phase
from workers.intake import estimates
from workers.intake.requests import resolve

MAX_FORM_BYTES = 2**20
MAX_FIELDS = 64
SHOWN = 120
# Phases that the standard has and jobs here never reach; clients may ask for them all the same.
PHASES = frozenset({*Phase, "HELD", "SUSPENDED", "UNKNOWN", "ARCHIVED"})
INTEGER = re.compile(r"-?[0-9]{1,15}", re.ASCII)
REQUESTS: dict[str, type[BaseModel]] = {
    get_args(request.model_fields["kind"].annotation)[0]: request
    for request in get_args(get_args(JobRequest)[0])
}


async def read_form(request: Request) -> dict[str, str]:
    """The fields of a form and of the address, by their names in small letters; ``Problem`` where it cannot be read.

    A field without a value is one that was not sent.
    """
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type == "multipart/form-data":
        sent = await _multipart(request)
    else:
        body = b"".join([chunk async for chunk in _bounded(request)])
        if body and media_type not in ("", "application/x-www-form-urlencoded"):
            raise bad(f"expected application/x-www-form-urlencoded, got {media_type}", 415)
        try:
            sent = parse_qsl(
                body.decode(), keep_blank_values=True, errors="strict", max_num_fields=MAX_FIELDS
            )
        except ValueError as error:
            raise bad(f"expected a form of at most {MAX_FIELDS} fields in UTF-8: {error}") from error
    return _single([*request.query_params.multi_items(), *sent])


Form = Annotated[dict[str, str], Depends(read_form)]


def query_of(request: Request, *several: str) -> dict[str, list[str]]:
    """The fields of the address by their names in small letters; those not in ``several`` may come once."""
    found: dict[str, list[str]] = {}
    for name, value in request.query_params.multi_items():
        if value:
            found.setdefault(name.lower(), []).append(value)
    for name, values in found.items():
        if len(values) > 1 and name not in several:
            raise bad(f"expected {name.upper()} once, got it {len(values)} times")
    return found


def bad(message: str, status: int = 400) -> Problem:
    """A refusal of what the client sent."""
    return Problem(status, "bad-parameter", message)


def kind_of(form: dict[str, str]) -> str:
    """Takes KIND out of a form."""
    kind = form.pop("kind", None)
    if kind not in REQUESTS:
        raise bad(f"expected KIND, one of {', '.join(REQUESTS)}; got {_shown(kind)}")
    return kind


def integer(name: str, text: str, least: int) -> int:
    """A whole number of at least ``least``."""
    if not INTEGER.fullmatch(text) or int(text) < least:
        raise bad(f"expected {name}, a whole number of {least} or more; got {_shown(text)}")
    return int(text)


def moment(name: str, text: str) -> float:
    """Seconds since 1970 of a time in ISO 8601; without a zone it is UTC."""
    try:
        when = datetime.fromisoformat(text)
        return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError) as error:
        raise bad(f"expected {name}, a time as 2026-01-31T12:00:00Z; got {_shown(text)}") from error


def phase(text: str) -> str:
    """A phase of the standard."""
    if text not in PHASES:
        raise bad(f"expected PHASE, one of {', '.join(sorted(PHASES))}; got {_shown(text)}")
    return text


def check(kind: str, given: dict[str, str]) -> None:
    """``Problem`` where a parameter of a job that is still set up is wrong in itself; others may be missing yet."""
    _values, errors = _understood(kind, given)
    wrong = [e for e in errors if e["loc"] and not (e["type"] == "missing" and len(e["loc"]) == 1)]
    if wrong:
        raise _wrong(kind, wrong)


def resolved(
    state: State, owner: str, kind: str, given: dict[str, str]
) -> tuple[dict[str, Any], str, dict[str, Any]]:
    """A job's parameters with nothing left open, the identity of what it makes, and what it is expected to need.

    ``Problem`` 400 where they are wrong, or ask for more than a job may need; 507 where there is no room.
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
    """Values as the contract takes them, and what is wrong with them.

    A text stays a text where the contract takes it, as numbers, names and true or false; else it is read as JSON.
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
    model = REQUESTS[kind].model_fields["parameters"].annotation
    assert isinstance(model, type) and issubclass(model, BaseModel)
    try:
        model.model_validate(values)
    except ValidationError as error:
        return error.errors(include_url=False, include_context=False)
    return []


def _wrong(kind: str, errors: Iterable[ErrorDetails]) -> Problem:
    model = REQUESTS[kind].model_fields["parameters"].annotation
    assert isinstance(model, type) and issubclass(model, BaseModel)
    told = []
    for error in errors:
        name = "/".join(map(str, error["loc"])) or kind
        if error["type"] == "extra_forbidden":
            message = f"no parameter of {kind}; expected {', '.join(model.model_fields)}"
        elif error["type"] == "missing":
            message = "expected a value, got none"
        else:
            message = f"{error['msg']}; got {_shown(error['input'])}"
        told.append(f"{name}: {message}")
    return bad("\n".join(told))


def _shown(value: object) -> str:
    if value is None:
        return "none"
    text = ascii(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def _single(pairs: Iterable[tuple[str, str]]) -> dict[str, str]:
    found: dict[str, str] = {}
    for name, value in pairs:
        name = name.lower()
        if name in found:
            raise bad(f"expected {_shown(name)} once, got it twice")
        found[name] = value
    return {name: value for name, value in found.items() if value}


async def _bounded(request: Request) -> AsyncGenerator[bytes, None]:
    """The body, as far as a form may be long."""
    got = 0
    async for chunk in request.stream():
        got += len(chunk)
        if got > MAX_FORM_BYTES:
            raise bad(f"expected a form of at most {MAX_FORM_BYTES} bytes, got more", 413)
        yield chunk


async def _multipart(request: Request) -> list[tuple[str, str]]:
    parser = MultiPartParser(
        request.headers,
        _bounded(request),
        max_files=0,
        max_fields=MAX_FIELDS,
        max_part_size=MAX_FORM_BYTES,
    )
    try:
        form = await parser.parse()
    except (MultiPartException, FormParserError) as error:
        raise bad(f"expected a form of fields without files: {error or type(error).__name__}") from error
    return [(name, value) for name, value in form.multi_items() if isinstance(value, str)]
