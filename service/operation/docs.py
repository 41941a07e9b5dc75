"""The API as a page to read: ``/docs``. The description for programs is at ``/openapi.json``.

This page runs no script. The known viewers load scripts from other hosts, or need a copy of the scripts that is kept up to
date here.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request, Response

PAGE_POLICY = "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'; base-uri 'none'"
_BOUNDS = {
    "minimum": "≥",
    "exclusiveMinimum": ">",
    "maximum": "≤",
    "exclusiveMaximum": "<",
    "pattern": "like",
}
METHODS = ("get", "post", "put", "patch", "delete")
router = APIRouter(include_in_schema=False)


@router.get("/docs")
def docs(request: Request) -> Response:
    """The page (HTML)."""
    description = request.app.openapi()
    page = _template().render(info=description["info"], groups=_groups(description))
    headers = {"Content-Security-Policy": PAGE_POLICY}
    return Response(page, media_type="text/html; charset=utf-8", headers=headers)


@lru_cache(maxsize=1)
def _template() -> Any:
    from jinja2 import Environment, StrictUndefined  # only this page needs it

    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(Path(__file__).with_name("docs.html").read_text("utf-8"))


def _groups(description: dict[str, Any]) -> dict[str, list[dict[str, Any]]]:
    """The operations, grouped by tag, in the order of the application."""
    schemas = description.get("components", {}).get("schemas", {})
    groups: dict[str, list[dict[str, Any]]] = {}
    for path, operations in description["paths"].items():
        for method in METHODS:
            if method in operations:
                operation = operations[method]
                groups.setdefault(operation.get("tags", ["other"])[0], []).append(
                    _operation(path, method, operation, schemas)
                )
    return groups


def _operation(path: str, method: str, operation: dict[str, Any], schemas: dict[str, Any]) -> dict[str, Any]:
    scopes = [scope for way in operation.get("security", []) for asked in way.values() for scope in asked]
    bodies = operation.get("requestBody", {}).get("content", {})
    return {
        "method": method.upper(),
        "path": path,
        "summary": operation.get("summary", ""),
        "text": operation.get("description", ""),
        "scope": scopes[0] if scopes else None,
        "parameters": [
            {
                "name": one["name"],
                "in": one["in"],
                "needed": one.get("required", False),
                "kind": _kind(one.get("schema", {}), schemas),
                "text": one.get("description") or one.get("schema", {}).get("description", ""),
            }
            for one in operation.get("parameters", [])
        ],
        "bodies": {
            media_type: _fields(content.get("schema", {}), schemas) for media_type, content in bodies.items()
        },
    }


def _fields(schema: dict[str, Any], schemas: dict[str, Any]) -> list[dict[str, str]]:
    """The fields of a body, two levels deep; ``/openapi.json`` has the deeper levels."""
    resolved = _resolved(schema, schemas)
    if "oneOf" in resolved:
        return [field for one in resolved["oneOf"] for field in _fields(one, schemas)]
    found = []
    for name, field in resolved.get("properties", {}).items():
        inner = _resolved(field, schemas)
        text = inner.get("description", "")
        found.append({"name": name, "kind": _kind(field, schemas), "text": text})
        for inside, part in inner.get("properties", {}).items():
            about = part.get("description") or _resolved(part, schemas).get("description", "")
            found.append({"name": f"{name}.{inside}", "kind": _kind(part, schemas), "text": about})
    return found


def _resolved(schema: dict[str, Any], schemas: dict[str, Any]) -> dict[str, Any]:
    if "$ref" in schema:
        return dict(schemas[schema["$ref"].rpartition("/")[2]])
    return schema


def _kind(schema: dict[str, Any], schemas: dict[str, Any]) -> str:
    """A type in words."""
    if "$ref" in schema:
        return _kind(_resolved(schema, schemas), schemas)
    for several in ("anyOf", "oneOf"):
        if several in schema:
            return " or ".join(dict.fromkeys(_kind(one, schemas) for one in schema[several]))
    if "const" in schema:
        return repr(schema["const"])
    if "enum" in schema:
        return ", ".join(map(str, schema["enum"]))
    kind = str(schema.get("type", "anything"))
    bounds = [f"{sign} {schema[key]}" for key, sign in _BOUNDS.items() if key in schema]
    return f"{kind} {' '.join(bounds)}".strip()
