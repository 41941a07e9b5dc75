"""Parameters of job kinds: what is refused."""

from __future__ import annotations

import pytest
from pydantic import TypeAdapter, ValidationError

from psfcore.deconvolve.assess.error_planes import SMALLEST_DRAWS
from workers.contract.bulk import BulkWork
from workers.contract.kinds import JobRequest
from workers.contract.requests import Deconvolve, Report

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
