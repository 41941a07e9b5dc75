"""Identities: equal requests are equal, and whatever changes a result changes them."""

from __future__ import annotations

import pytest
from pydantic import TypeAdapter, ValidationError

from psfcore.deconvolve.assess.error_planes import SMALLEST_DRAWS
from psfcore.errors import DataError
from workers.contract.contract import (
    Deconvolve,
    JobRequest,
    PsfBuild,
    ResolvedDeconvolve,
    RichardsonLucy,
    canonical_hash,
    product_identity,
    psf_identity,
)

A, B = "a" * 64, "b" * 64


def test_the_hash_does_not_depend_on_the_order_of_keys() -> None:
    assert canonical_hash({"a": 1, "b": 2}) == canonical_hash({"b": 2, "a": 1})


def identity(**changes: object) -> str:
    base = {"image_id": A, "psf_id": B, "method": {"name": "richardson-lucy"}}
    return product_identity(ResolvedDeconvolve.model_validate(base | changes))


def test_everything_that_changes_the_result_changes_the_identity(monkeypatch: pytest.MonkeyPatch) -> None:
    base = identity()
    assert base == identity(method={"name": "richardson-lucy", "steps": 20})
    recipe = {"instrument": "hri_euv"}
    assert base == identity(psf_recipe=recipe), "how a PSF would be made is in its id"
    others = {
        identity(image_id=B),
        identity(psf_id=A),
        identity(method={"name": "richardson-lucy", "steps": 19}),
        identity(method={"name": "richardson-lucy", "edges": "zero"}),
        identity(method={"name": "linear"}),
        identity(noise={"photon_gain_dn": 6.0, "read_noise_dn": 2.0}),
        identity(saturation_dn=4000.0),
        identity(error_draws=8),
    }
    monkeypatch.setattr(RichardsonLucy, "algorithm_version", RichardsonLucy.algorithm_version + 1)
    others.add(identity())
    assert len(others) == 9 and base not in others


def test_a_built_psf_is_identified_by_its_parameters() -> None:
    small, large = PsfBuild(instrument="hri_euv", size=256), PsfBuild(instrument="hri_euv")
    assert psf_identity(small) != psf_identity(large)
    with pytest.raises(DataError, match="hri_euv"):
        psf_identity(PsfBuild(instrument="no_such"))


@pytest.mark.parametrize(
    "body",
    [
        {},
        {"kind": "bake", "parameters": {}},
        {"kind": "deconvolve", "parameters": {}},
        {"kind": "deconvolve", "parameters": {"image_id": "../../etc/passwd"}},
        {"kind": "deconvolve", "parameters": {"image_id": A, "method": {"name": "magic"}}},
        {"kind": "deconvolve", "parameters": {"image_id": A, "method": {"steps": 0}}},
        {"kind": "deconvolve", "parameters": {"image_id": A, "stepz": 3}},
        {"kind": "psf-build", "parameters": {"instrument": "hri_euv", "size": 63}},
        {"kind": "psf-build", "parameters": {"instrument": "hri_euv", "size": 1_000_000}},
    ],
)
def test_requests_that_cannot_be_meant_are_refused(body: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        TypeAdapter(JobRequest).validate_python(body)


def test_draws_of_errors_are_none_or_as_many_as_show_a_spread() -> None:
    asked = {"image_id": "a" * 64, "psf_id": "b" * 64, "method": {"name": "linear"}}
    for draws in range(SMALLEST_DRAWS + 1):
        if 0 < draws < SMALLEST_DRAWS:
            with pytest.raises(ValidationError, match="shows no spread"):
                Deconvolve.model_validate(asked | {"error_draws": draws})
        else:
            assert Deconvolve.model_validate(asked | {"error_draws": draws}).error_draws == draws
