"""Texts that no database, no form and no answer expects, in every place of every operation and form that takes a text."""

from __future__ import annotations

import importlib
import json
import pkgutil
import re
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from fastapi import APIRouter
from fastapi.routing import APIRoute
from fastapi.testclient import TestClient

import service.pages
import service.vo
from tests.service.conftest import one_of_everything, upload
from tests.service.keyed import ALL, Keyed, keyed
from tests.whole.stack import Missing, postgres_database
from workers.settings import Settings

TEXTS = {
    "NUL": "a\0b",
    "half of a pair": "a\ud800",
    "odd letters": "\x1b[2J\r\nX: y\x85\U0001f600\u202e\u2028\ufffe",
    "long": "\u00e9" * 10_000,
}
EXAMPLES = (
    "0" * 64,
    "0" * 32,
    "1.0.0",
    "2024-01-01T00:00:00Z",
    "hri_euv",
    "174",
    "/archive/*.fits",
    "WAVELNTH",
)
TEMPLATES = Path(__file__).parents[3] / "service" / "pages" / "templates"
# Fields with which a form of a page is not refused before its other fields are used.
FORM = {
    "pattern": "/archive/*.fits", "method": "richardson-lucy", "steps": "2", "scopes": "read", "reason": "because",
    "instrument": "hri_euv", "interpolated": "true", "status": "deprecated", "KIND": "psf-build",
}  # fmt: skip
# The same for JSON.
BODIES = {path: {"files": [{"glob": "/archive/*.fits"}]} for path in ("/v1/bulk", "/v1/bulk/estimate")}


def schema_of(description: dict[str, Any], schema: dict[str, Any]) -> dict[str, Any]:
    """The schema itself, for a reference."""
    while "$ref" in schema:
        schema = description["components"]["schemas"][schema["$ref"].rpartition("/")[2]]
    return schema


def bodies(description: dict[str, Any], schema: dict[str, Any], mark: str) -> Iterator[tuple[Any, bool]]:
    """Values of a schema, in each of which at most one text is ``mark``; and whether one is. The first has none."""
    schema = schema_of(description, schema)
    if "const" in schema or "enum" in schema:
        yield schema.get("const", schema.get("enum", [None])[0]), False
        yield mark, True
    elif choices := schema.get("oneOf", schema.get("anyOf")):
        plain: list[Any] = []
        for choice in choices:
            for value, marked in bodies(description, choice, mark):
                if marked or schema.get("discriminator"):
                    yield value, marked
                elif not plain:
                    plain.append(value)
                    yield value, False
    elif schema.get("type") == "object":
        given = schema.get("properties", {})
        required = {
            name: next(bodies(description, given[name], mark))[0] for name in schema.get("required", ())
        }
        yield required, False
        for name, inner in given.items():
            for value, marked in bodies(description, inner, mark):
                if marked:
                    yield required | {name: value}, True
        yield required | {mark: "x"}, True
    elif schema.get("type") == "array":
        items = list(bodies(description, schema["items"], mark))
        yield [items[0][0]] * max(1, schema.get("minItems", 1)), False
        yield from (([value], True) for value, marked in items if marked)
    elif schema.get("type") == "string":
        pattern = schema.get("pattern", "")
        yield next((one for one in EXAMPLES if re.search(pattern, one)), "x"), False
        yield mark, True
    else:
        yield {"integer": 1, "number": 1.0, "boolean": True}.get(schema.get("type", "")), False


def operations(running: Keyed, ids: dict[str, str], text: str) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Each operation of the description with the text in one place; no stream of events."""
    description, models = running.api.get("/openapi.json").json(), set()
    for path, methods in description["paths"].items():
        known = {**ids, "job_id": ids["uws"]} if path.startswith("/uws") else ids
        for method, operation in methods.items():
            yield from in_path(method, path, known, text)
            here, stream = path.format(**known), path.endswith("/events")
            for parameter in operation.get("parameters", ()):
                if stream or method == "delete" or parameter["in"] == "path":
                    continue
                place = "params" if parameter["in"] == "query" else "headers"
                if place == "params" or text.isprintable():
                    value = text if place == "params" else text.encode()
                    yield method, here, {place: {parameter["name"]: value}}
            for media_type, content in operation.get("requestBody", {}).get("content", {}).items():
                schema = schema_of(description, content["schema"])
                if media_type == "application/json" and schema["title"] not in models:
                    models.add(schema["title"])
                    for body, marked in bodies(description, schema, text):
                        if marked:
                            body = {**BODIES.get(path, {}), **body}
                            yield (
                                method,
                                here,
                                {
                                    "content": json.dumps(body).encode(),
                                    "headers": {"Content-Type": media_type},
                                },
                            )
                elif "form" in media_type and not path.endswith("jobs/{job_id}"):
                    yield from in_form(method, here, {*schema["properties"], text}, text)


def hidden_routes() -> Iterator[APIRoute]:
    """The routes of pages, and others that the description leaves out."""
    for package in (service.pages, service.vo):
        for module in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
            for router in vars(importlib.import_module(module.name)).values():
                for route in router.routes if isinstance(router, APIRouter) else ():
                    if not (router.include_in_schema and route.include_in_schema) and route.path != "/logout":
                        yield route


def in_path(
    method: str, path: str, known: dict[str, str], text: str
) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """An address with the text in place of each of its ids."""
    for name in re.findall(r"\{(\w+)\}", path):
        yield method, path.format(**known | {name: quote(text, safe="", errors="replace")}), {}


def in_form(
    method: str, address: str, names: set[str], text: str
) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """A form with the text in one of its fields, in both ways in which forms are sent."""
    for name in sorted(names):
        try:
            yield method, address, {"data": FORM | {name: text}}
            yield method, address, {"data": FORM, "files": {name: (text, b"x")}}
        except UnicodeEncodeError:
            continue


def pages(running: Keyed, ids: dict[str, str], text: str) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Each page with the text in its address, in its query, and in the fields of a form."""
    names = {
        name for file in TEMPLATES.glob("*.html") for name in re.findall(r'name="(\w+)"', file.read_text())
    }
    names |= {"next", "key", "cursor", "owner", "kind"}
    form = FORM | {"choice": f"psf:{ids['psf_id']}"}
    known = {**ids, "of_version": "1", "number": "0", "change": "pause"}
    for route in hidden_routes():
        here = route.path.format(**known)
        for method in route.methods:
            yield from in_path(method, route.path, known, text)
            place, base = ("params", {}) if method == "GET" else ("data", form)
            yield method, here, {place: base | dict.fromkeys(names, text[:200])}


def whole_things(ann: TestClient, folder: Path, ids: dict[str, str]) -> dict[str, str]:
    """Ids of things that pages can show."""
    for name, where in (("image", "images"), ("psf", "psfs"), ("transit", "transits")):
        file = next(folder.glob(f"{name}.[ft]*"))
        ids |= {f"{name}_id": upload(ann, file, f"/v1/{where}")}
    asked = {"image_id": ids["image_id"], "psf_id": ids["psf_id"]}
    job = ann.post("/v1/jobs", json={"kind": "deconvolve", "parameters": asked}).json()
    run = ann.post("/v1/bulk", json={"images": [ids["image_id"]], "psf_id": ids["psf_id"]}).json()
    return ids | {"job_id": job["id"], "bulk_id": run["id"], "other_id": ids["psf_id"]}


@pytest.fixture
def strict(settings: Settings) -> Iterator[Settings]:
    """The settings of a service on PostgreSQL, which refuses more texts; on SQLite if there is no PostgreSQL."""
    with ExitStack() as held:
        with suppress(Missing):
            url = held.enter_context(postgres_database())
            settings = settings.model_copy(update={"database_url": url})
        yield settings


@pytest.mark.parametrize(
    "what", ["NUL", *(pytest.param(name, marks=pytest.mark.slow) for name in TEXTS if name != "NUL")]
)
def test_no_text_makes_the_service_fail(strict: Settings, tmp_path: Path, what: str) -> None:
    limits = {"reads_per_minute": 0, "submissions_per_minute": 0, "bulk_roots": "/archive"}
    failed, count = set(), 0
    with keyed(strict, **limits) as running:
        ann, bea = (running.client(owner, *ALL) for owner in ("ann", "bea"))
        ids = one_of_everything(running, tmp_path)
        shown = whole_things(bea, tmp_path, dict(ids))
        text = TEXTS[what]
        for client, requests in (
            (ann, operations(running, ids, text)),
            (bea, pages(running, shown, text)),
        ):
            for method, address, sent in requests:
                try:
                    answer = client.request(method.upper(), address, follow_redirects=False, **sent)
                except UnicodeEncodeError:  # this client cannot send half of a pair there
                    continue
                count += 1
                if answer.status_code >= 500:
                    failed.add(f"{answer.status_code}: {what} in {method} {address[:90]} {str(sent)[:200]}")
    assert count > 250
    assert not failed, "\n".join(sorted(failed)[:20])
