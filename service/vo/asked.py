"""Reads the parameters of requests by the rules of IVOA DALI, and answers errors as DALI says.

Citation: IVOA DALI 1.1 (17 May 2017), sections 2.1, 3 and 4.4. The names of parameters may have upper or lower case; they are in
the address or in a form. A parameter that an endpoint does not know is ignored. An answer that is a VOTable
reports an error as a VOTable with QUERY_STATUS=ERROR; other answers report it as plain text.
"""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Mapping
from typing import Annotated, Any, NoReturn

from fastapi import Depends, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.routing import APIRoute

from service.http.problems import Problem
from service.uws.parameters import bad, read_pairs, repeated

VOTABLE_TYPE, JSON_TYPE = "application/x-votable+xml", "application/json"
VOTABLE, JSON = "votable", "json"
# The values of RESPONSEFORMAT that name each format, without parameters of the media type.
FORMATS = {VOTABLE: (VOTABLE, VOTABLE_TYPE, "text/xml"), JSON: (JSON, JSON_TYPE)}
SHOWN = 80


async def _fields(request: Request) -> dict[str, list[str]]:
    """The parameters of a request, by their names in lower case. Only ID may be repeated."""
    return repeated(await read_pairs(request), "id")


Fields = Annotated[dict[str, list[str]], Depends(_fields)]


class VotableErrors(APIRoute):
    """Errors as VOTables, which clients of the Virtual Observatory show to their users."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handle = super().get_route_handler()

        async def answer(request: Request) -> Response:
            try:
                return await handle(request)
            except Problem as problem:
                content = await run_in_threadpool(_error_document, problem.detail)
                return Response(content, problem.status, headers=problem.headers, media_type=VOTABLE_TYPE)

        return answer


def base_url(request: Request) -> str:
    """The address of the service, without a slash at the end."""
    return str(request.base_url).rstrip("/")


def one(fields: Mapping[str, list[str]], name: str) -> str | None:
    """The value of a parameter; None if it was not sent."""
    return fields[name][0] if name in fields else None


def format_of(fields: Mapping[str, list[str]], *allowed: str) -> str:
    """The format that RESPONSEFORMAT names, one of ``allowed``; default: the first of them."""
    sent = one(fields, "responseformat")
    if sent is None:
        return allowed[0]
    name = sent.partition(";")[0].strip().lower()
    for known in allowed:
        if name in FORMATS[known]:
            return known
    refused("RESPONSEFORMAT", " or ".join(allowed), sent)


def refused(name: str, expected: str, got: str | None) -> NoReturn:
    """Raise the ``Problem`` for a wrong or missing parameter."""
    shown = "none" if got is None else ascii(got if len(got) <= SHOWN else f"{got[:SHOWN]}...")
    raise bad(f"expected {name}, {expected}; got {shown}")


def described(**parameters: str) -> dict[str, Any]:
    """OpenAPI description of parameters that a GET request has in its address."""
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


def _error_document(message: str) -> bytes:
    from service.vo.votables import error_document  # loads the numerical libraries

    return error_document(message)
