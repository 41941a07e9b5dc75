"""Reads the parameters of requests by the rules of IVOA DALI, and answers errors as DALI says.

Citation: IVOA DALI 1.1 (17 May 2017), sections 2.1, 3 and 4.4. The names of parameters may have upper or lower case;
they are in the address or in a form. A parameter that an endpoint does not know is ignored. An answer that is a VOTable
reports an error as a VOTable with QUERY_STATUS=ERROR; other answers report it as plain text.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Coroutine, Iterable, Mapping
from datetime import UTC, datetime
from typing import Annotated, Any, NoReturn
from urllib.parse import parse_qsl

from fastapi import Depends, Request, Response
from fastapi.responses import PlainTextResponse
from fastapi.routing import APIRoute

from service.http.forms import FORM, URL_ENCODED, FormPart, chunks_of, media_type_of, pieces_of
from service.http.problems import Descriptions, Problem

MAX_FORM_BYTES = 2**20
MAX_FIELDS = 64
SHOWN = 120
# What to do instead of sending a file with a job (DALI's UPLOAD).
UPLOAD_FIRST = (
    "upload each input of a job first, by POST /v1/images, /v1/psfs or /v1/transits, and send its id in the field "
    "image_id, mask_id, psf_id or transit_id"
)
# Characters that XML 1.0 cannot contain.
NO_XML = re.compile("[^\t\n\r\u0020-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
VOTABLE_TYPE, JSON_TYPE = "application/x-votable+xml", "application/json"
VOTABLE, JSON = "votable", "json"
# The values of RESPONSEFORMAT that name each format, without parameters of the media type.
FORMATS = {VOTABLE: (VOTABLE, VOTABLE_TYPE, "text/xml"), JSON: (JSON, JSON_TYPE)}
_INTEGER = re.compile(r"-?[0-9]{1,15}", re.ASCII)


async def read_pairs(request: Request) -> list[tuple[str, str]]:
    """The names and values of the fields of the address and of a form, in their order.

    Raises ``Problem`` if the body is not a form, is too large, or contains a file.
    """
    media_type = media_type_of(request)
    if media_type == FORM:
        sent = await _multipart_pairs(request)
    else:
        body = b"".join([chunk async for chunk in chunks_of(request)])  # service.http.guard bounds its size
        if body and media_type not in ("", URL_ENCODED):
            raise bad(f"expected {URL_ENCODED}, got {media_type}", 415)
        try:
            sent = parse_qsl(
                body.decode(), keep_blank_values=True, errors="strict", max_num_fields=MAX_FIELDS
            )
        except ValueError as error:
            raise bad(f"expected a form of at most {MAX_FIELDS} fields in UTF-8: {error}") from error
    return [*request.query_params.multi_items(), *sent]


async def _multipart_pairs(request: Request) -> list[tuple[str, str]]:
    texts: dict[FormPart, bytearray] = {}
    async for pieces in pieces_of(request, MAX_FORM_BYTES):
        for part, piece in pieces:
            if part.filename is not None:
                raise bad(
                    f"expected a form without files; got a file in the part {shown(part.name)}: {UPLOAD_FIRST}"
                )
            texts.setdefault(part, bytearray()).extend(piece)
        if len(texts) > MAX_FIELDS:
            raise bad(f"expected a form of at most {MAX_FIELDS} fields; got more")
    try:
        return [(part.name, text.decode()) for part, text in texts.items()]
    except UnicodeDecodeError as error:
        raise bad(f"expected fields of the form in UTF-8: {error}") from error


def values_of(pairs: Iterable[tuple[str, str]], *several: str) -> dict[str, list[str]]:
    """The values of the fields, by their names in lower case, without empty ones.

    Raises ``Problem`` if a field occurs twice that is not in ``several``.
    """
    fields: dict[str, list[str]] = {}
    for name, value in pairs:
        if value:
            fields.setdefault(name.lower(), []).append(value)
    for name, values in fields.items():
        if len(values) > 1 and name not in several:
            raise bad(f"expected {name.upper()[:SHOWN]} once; got it {len(values)} times")
    return fields


def single(pairs: Iterable[tuple[str, str]]) -> dict[str, str]:
    """The value of each field, by its name in lower case. Raises ``Problem`` if a field occurs twice."""
    return {name: value for name, [value] in values_of(pairs).items()}


async def _fields(request: Request) -> dict[str, list[str]]:
    return values_of(await read_pairs(request), "id")


async def _form(request: Request) -> dict[str, str]:
    return single(await read_pairs(request))


# The fields of the address and of a form, by their names in lower case. A field without a value counts as not sent.
Fields = Annotated[dict[str, list[str]], Depends(_fields)]  # only ID may be repeated
Form = Annotated[dict[str, str], Depends(_form)]


# Values ---------------------------------------------------------------------------------------------


def bad(message: str, status: int = 400) -> Problem:
    """The answer to a bad parameter."""
    return Problem(status, "bad-parameter", message)


def refuse(name: str, expected: str, got: str | None) -> NoReturn:
    """Raise the ``Problem`` for a wrong or missing parameter."""
    raise bad(f"expected {name}, {expected}; got {shown(got)}")


def shown(value: object) -> str:
    """A value as a message shows it: in ASCII, and not too long; None as "none"."""
    text = "none" if value is None else ascii(value)
    return text if len(text) <= SHOWN else f"{text[:SHOWN]}..."


def one(fields: Mapping[str, list[str]], name: str) -> str | None:
    """The value of a parameter; None if it was not sent."""
    return fields[name][0] if name in fields else None


def integer(name: str, text: str, least: int) -> int:
    """A whole number of at least ``least``."""
    if not _INTEGER.fullmatch(text) or int(text) < least:
        refuse(name, f"a whole number of {least} or more", text)
    return int(text)


def moment(name: str, text: str) -> float:
    """Seconds since 1970 of a time in ISO 8601; a time without a zone is UTC."""
    try:
        when = datetime.fromisoformat(text)
        return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
    except (ValueError, OverflowError):
        refuse(name, "a time such as 2026-01-31T12:00:00Z", text)


def format_of(fields: Mapping[str, list[str]], *allowed: str) -> str:
    """The format that RESPONSEFORMAT names, one of ``allowed``; default: the first of them."""
    sent = one(fields, "responseformat")
    if sent is None:
        return allowed[0]
    name = sent.partition(";")[0].strip().lower()
    for known in allowed:
        if name in FORMATS[known]:
            return known
    refuse("RESPONSEFORMAT", " or ".join(allowed), sent)


# Answers --------------------------------------------------------------------------------------------


# OpenAPI description of the errors of routes of the class PlainErrors.
PLAIN_ERRORS: Descriptions = {
    "4XX": {
        "content": {"text/plain": {}, "application/problem+json": {}},
        "description": "What was expected, what was received, and what to do next; as problem details if the request "
        "is not permitted from its origin or under this host name.",
    }
}


class PlainErrors(APIRoute):
    """Errors as plain text, which clients of the Virtual Observatory show to their users."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handle = super().get_route_handler()

        async def answer(request: Request) -> Response:
            try:
                return await handle(request)
            except Problem as problem:
                return await self.error(problem)

        return answer

    async def error(self, problem: Problem) -> Response:
        """The answer that reports an error."""
        return PlainTextResponse(f"{problem.detail}\n", problem.status, headers=problem.headers)


def base_url(request: Request) -> str:
    """The address of the service, without a slash at the end."""
    return str(request.base_url).rstrip("/")


def query(**parameters: str) -> dict[str, object]:
    """OpenAPI description of parameters that a request has in its address."""
    return {
        "parameters": [
            {
                "name": name,
                "in": "query",
                "required": False,
                "schema": {"type": "string"},
                "description": text,
            }
            for name, text in parameters.items()
        ]
    }
