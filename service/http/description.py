"""Corrects the OpenAPI description, because the framework describes some answers wrongly."""

from __future__ import annotations

import re
from typing import Any

from fastapi import FastAPI

from service.http import problems
from workers.contract.short_ids import FEWEST_DIGITS

SHORT = re.compile(r"\^\[0-9a-f\]\{(32|64)\}\$")
PROBLEM = f"#/components/schemas/{problems.ProblemDocument.__name__}"


def install(app: FastAPI) -> None:
    """Describe errors as problem documents on every route, and say that ids in addresses may be shortened."""
    generate = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            _correct(generate())
        assert app.openapi_schema is not None
        return app.openapi_schema

    app.openapi = openapi  # type: ignore[method-assign]


def _correct(description: dict[str, Any]) -> None:
    for operations in description["paths"].values():
        for operation in operations.values():
            for parameter in operation.get("parameters", ()):
                _shorten(parameter)
            for response in operation["responses"].values():
                content = response.get("content", {})
                if content.get("application/json", {}).get("schema", {}).get("$ref") == PROBLEM:
                    content[problems.MEDIA_TYPE] = content.pop("application/json")


def _shorten(parameter: dict[str, Any]) -> None:
    """Describe an id in a path: the first digits of the id are accepted too, see ``service.http.short_ids``."""
    whole = SHORT.fullmatch(parameter["schema"].get("pattern", ""))
    if parameter["in"] == "path" and whole is not None:
        parameter["schema"]["pattern"] = f"^[0-9a-f]{{{FEWEST_DIGITS},{whole[1]}}}$"
        parameter["description"] = (
            f"an id, or its first {FEWEST_DIGITS} or more digits if no other id begins with them"
        )
