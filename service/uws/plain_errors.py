"""Errors of UWS addresses as plain text, and the OpenAPI description of their fields."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

from fastapi import Request, Response
from fastapi.responses import PlainTextResponse, RedirectResponse
from fastapi.routing import APIRoute

from service.http.problems import Problem
from service.uws.documents import MEDIA_TYPE


class PlainErrors(APIRoute):
    """Errors as plain text, which clients of the Virtual Observatory show to their users."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handle = super().get_route_handler()

        async def answer(request: Request) -> Response:
            try:
                return await handle(request)
            except Problem as problem:
                return PlainTextResponse(f"{problem.detail}\n", problem.status, headers=problem.headers)

        return answer


def query(**described: str) -> dict[str, Any]:
    """OpenAPI description of query parameters. Their names may be written in upper or lower case."""
    return {
        "parameters": [
            {
                "name": name,
                "in": "query",
                "required": False,
                "schema": {"type": "string"},
                "description": text,
            }
            for name, text in described.items()
        ]
    }


def form(*, files: bool = False, **described: str) -> dict[str, Any]:
    """OpenAPI description of the fields of a form. files: whether a multipart form may contain files."""
    fields = {name: {"type": "string", "description": text} for name, text in described.items()}
    schema = {"type": "object", "properties": fields, "additionalProperties": {"type": "string"}}
    content = {"application/x-www-form-urlencoded": {"schema": schema}}
    if files:
        content["multipart/form-data"] = {"schema": schema}
    return {"requestBody": {"content": content}}


TEXT: dict[str, Any] = {"response_class": PlainTextResponse}
XML: dict[str, Any] = {
    "response_class": Response,
    "responses": {200: {"content": {MEDIA_TYPE: {}}, "description": "A document of UWS 1.1"}},
}
TO_JOB: dict[str, Any] = {"status_code": 303, "response_class": RedirectResponse}
