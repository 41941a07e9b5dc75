"""Requests for jobs: the table of kinds, parameters that are refused, and names that were meant."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from psfcore.deconvolve.assess.error_planes import SMALLEST_DRAWS
from workers.contract.bulk import BulkRequest, BulkWork
from workers.contract.kinds import KINDS, REQUESTS, JobRequest, kind_of_origin, load
from workers.contract.requests import Deconvolve, Report
from workers.contract.suggestions import did_you_mean, explained


def test_every_row_names_a_task_and_a_resolver_that_exist() -> None:
    for name, kind in KINDS.items():
        assert callable(kind.load_task()) and callable(load(kind.resolver)), name
        assert (kind.load_assistant() is None) == (kind.assistant is None), name
        assert kind.origin is None or kind_of_origin(kind.origin) is kind, "a rerun finds the kind"


def test_every_kind_but_bulk_can_be_requested() -> None:
    assert set(REQUESTS) == set(KINDS) - {"bulk"}
    tables: Any = TypeAdapter(JobRequest).validate_python(
        {"kind": "psf-tables", "queue": "bulk", "parameters": {"psf_id": "a" * 64}}
    )
    assert isinstance(tables, REQUESTS["psf-tables"]) and tables.queue == "bulk"
    for name, model in REQUESTS.items():
        assert KINDS[name].parameters is model.model_fields["parameters"].annotation
        assert KINDS[name].resolved is not None


A = "a" * 64


MALFORMED: tuple[dict[str, object], ...] = (
    {},
    {"kind": "bake", "parameters": {}},
    {"kind": "deconvolve", "parameters": {}},
    {"kind": "deconvolve", "parameters": {"image_id": "../../etc/passwd"}},
    {"kind": "deconvolve", "parameters": {"image_id": A, "method": {"name": "magic"}}},
    {"kind": "deconvolve", "parameters": {"image_id": A, "method": {"steps": 0}}},
    {"kind": "deconvolve", "parameters": {"image_id": A, "stepz": 3}},
    {"kind": "psf-build", "parameters": {"instrument": "hri_euv", "size": 63}},
    {"kind": "psf-build", "parameters": {"instrument": "hri_euv", "size": 1_000_000}},
)
WRONG_NOISE: tuple[dict[str, object], ...] = (
    {"photon_gain_dn": 6.0},
    {"photon_gain_dn": 6.0, "read_noise_dn": -1.0},
    {"photon_gain_dn": 6.0, "read_noise_dn": True},
    {"photon_gain_dn": 6.0, "read_noise_dn": 2.0, "gain": "low"},
)


def test_malformed_requests_are_refused() -> None:
    requests = TypeAdapter[JobRequest](JobRequest)
    for body in MALFORMED:
        with pytest.raises(ValidationError):
            requests.validate_python(body)
    for noise in WRONG_NOISE:
        with pytest.raises(ValidationError):
            Deconvolve.model_validate({"image_id": A, "noise": noise})
    figures = Deconvolve.model_validate(
        {"image_id": A, "noise": {"photon_gain_dn": 6, "read_noise_dn": 2.0}}
    ).noise
    assert figures is not None
    assert (figures.noise().photon_gain_dn, figures.noise().read_noise_dn) == (6.0, 2.0)


def test_error_draws_are_zero_or_enough_to_show_a_spread() -> None:
    asked = {"image_id": "a" * 64, "psf_id": "b" * 64, "method": {"name": "linear"}}
    for draws in range(SMALLEST_DRAWS + 1):
        if 0 < draws < SMALLEST_DRAWS:
            with pytest.raises(ValidationError, match="the spread cannot be estimated"):
                Deconvolve.model_validate(asked | {"error_draws": draws})
            with pytest.raises(ValidationError, match="the spread cannot be estimated"):
                BulkWork.model_validate({"parameters": {"error_draws": draws}})
        else:
            assert Deconvolve.model_validate(asked | {"error_draws": draws}).error_draws == draws


def test_shapes_are_compared_only_where_the_transit_is_fitted() -> None:
    assert Report.model_validate({"transit_id": A, "shapes": True}).shapes
    assert not Report.model_validate({"transit_id": A, "psf_id": A}).shapes
    with pytest.raises(ValidationError, match="leave out psf_id"):
        Report.model_validate({"transit_id": A, "psf_id": A, "shapes": True})


def messages(model: Any, body: object) -> str:
    with pytest.raises(ValidationError) as refused:
        TypeAdapter(model).validate_python(body)
    return "\n".join(message for _, message in explained(refused.value.errors(), model))


def test_only_a_close_name_is_suggested() -> None:
    assert did_you_mean("stepz", ["name", "steps"]) == "; did you mean 'steps'?"
    assert did_you_mean("zzz", ["name", "steps"]) == ""


CHANGES: tuple[tuple[dict[str, Any], str], ...] = (
    ({"kind": "deconvolv"}, "deconvolve"),
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
