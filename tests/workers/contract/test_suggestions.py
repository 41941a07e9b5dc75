"""Errors about unknown names: which names are known, and which was probably meant."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from workers.contract.bulk import BulkRequest
from workers.contract.kinds import JobRequest
from workers.contract.suggestions import did_you_mean, explained

A = "a" * 64


def messages(model: Any, body: object) -> str:
    with pytest.raises(ValidationError) as refused:
        TypeAdapter(model).validate_python(body)
    return "\n".join(message for _, message in explained(refused.value.errors(), model))


def test_only_a_close_name_is_suggested() -> None:
    assert did_you_mean("stepz", ["name", "steps"]) == "; did you mean 'steps'?"
    assert did_you_mean("zzz", ["name", "steps"]) == ""
    assert did_you_mean("evaluate", ["report"]) == "; did you mean 'report'?"
    assert did_you_mean("evaluate", ["name"]) == "", (
        "a former name is suggested only where the new one is known"
    )


CHANGES: tuple[tuple[dict[str, Any], str], ...] = (
    ({"kind": "evaluate"}, "report"),
    ({"kind": "deconvolv"}, "deconvolve"),
    ({"parameters": {"image_id": A, "effects_picture": True}}, "changes_picture"),
    ({"parameters": {"image_id": A, "eror_draws": 4}}, "error_draws"),
    ({"parameters": {"image_id": A, "method": {"name": "linar"}}}, "linear"),
    ({"parameters": {"image_id": A, "method": {"name": "linear", "stepz": 4}}}, "steps"),
    ({"quue": "bulk"}, "queue"),
)


def test_the_name_that_was_meant_is_suggested() -> None:
    for change, suggested in CHANGES:
        body = {"kind": "deconvolve", "parameters": {"image_id": A}} | change
        assert f"did you mean '{suggested}'?" in messages(JobRequest, body), change
    assert "gap-diagnose" in messages(JobRequest, {}), "a missing kind is told with the known ones"
    listed = {"files": [{"glob": "/data/*", "were": {}}], "psf_id": A}
    assert "did you mean 'where'?" in messages(BulkRequest, listed)
