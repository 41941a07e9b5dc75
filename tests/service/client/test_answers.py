"""The forms of the answers that the client declares are those of the OpenAPI document."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from pydantic import TypeAdapter

from service.api.bulk import Result
from service.client import answers

OPENAPI = json.loads((Path(__file__).parents[3] / "openapi" / "openapi.json").read_text("utf-8"))
SCHEMAS = OPENAPI["components"]["schemas"]
FORMS = {
    "Affected": "AffectedView",
    "Ancestor": "Ancestor",
    "AnnulusAnswer": "AnnulusAnswer",
    "Bulk": "BulkView",
    "BulkEstimate": "BulkEstimate",
    "BulkFailure": "Failed",
    "BulkLine": "BulkLine",
    "Choice": "Choice",
    "ComparisonAnswer": "ComparisonAnswer",
    "Context": "WholeContext",
    "ContextLine": "ContextView",
    "CurveAnswer": "CurveAnswer",
    "DefaultContext": "DefaultView",
    "EncircledAnswer": "EncircledAnswer",
    "HduHeader": "HduHeader",
    "Health": "Health",
    "Identified": "Identified",
    "Image": "ImageView",
    "Job": "JobView",
    "JobEstimate": "EstimateView",
    "Key": "KeyView",
    "MadeKey": "MadeKey",
    "Product": "ProductView",
    "ProfileAnswer": "ProfileAnswer",
    "Psf": "PsfView",
    "PsfStatus": "StatusView",
    "Report": "ReportView",
    "Series": "SeriesView",
    "SeriesLine": "SeriesSummary",
    "Transit": "TransitDetails",
}


def flat(schema: dict, schemas: dict, at: str = "", above: tuple[str, ...] = ()) -> Iterator[str]:
    """Every value of a form: its path and its type, as text."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        if name not in above:  # a form may contain itself
            yield from flat(schemas[name], schemas, at, (*above, name))
    elif "anyOf" in schema:
        for one in schema["anyOf"]:
            yield from flat(one, schemas, at, above)
    elif "properties" in schema:
        for key, value in schema["properties"].items():
            yield from flat(value, schemas, f"{at}/{key}", above)
    elif schema.get("type") == "array":
        for one in schema.get("prefixItems") or [schema["items"]]:
            yield from flat(one, schemas, f"{at}[]", above)
    elif isinstance(schema.get("additionalProperties"), dict):
        yield from flat(schema["additionalProperties"], schemas, f"{at}{{}}", above)
    else:
        yield f"{at}: {schema.get('type', 'string' if 'const' in schema else 'any')}"


def form(kind: object) -> set[str]:
    schema = TypeAdapter(kind).json_schema(mode="serialization", ref_template="{model}")
    return set(flat(schema, schema.get("$defs", {})))


@pytest.mark.parametrize("name", FORMS)
def test_a_form_has_the_keys_and_types_of_the_openapi_document(name):
    assert form(getattr(answers, name)) == set(flat({"$ref": f"#/{FORMS[name]}"}, SCHEMAS))


def test_a_line_of_the_results_of_a_bulk_run_has_the_form_that_is_declared():
    assert form(answers.BulkResult) == form(Result)


def test_the_operations_without_a_service_answer_with_parts_of_these_forms():
    for kind in (answers.Image, answers.Transit, answers.Psf, answers.Product):
        assert form(answers.Uploaded) <= form(kind)
    assert form(answers.Submitted) | form(answers.Ended) <= form(answers.Job)
