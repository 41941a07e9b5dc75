"""Corrects the OpenAPI description where the framework describes the answers wrongly."""

from __future__ import annotations

from typing import Any

from fastapi import FastAPI

from service.http import problems

PROBLEM = f"#/components/schemas/{problems.ProblemDocument.__name__}"


def install(app: FastAPI) -> None:
    """Describe errors as problem documents on every route."""
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
            for response in operation["responses"].values():
                content = response.get("content", {})
                if content.get("application/json", {}).get("schema", {}).get("$ref") == PROBLEM:
                    content[problems.MEDIA_TYPE] = content.pop("application/json")
