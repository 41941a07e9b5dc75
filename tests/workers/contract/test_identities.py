"""Identities: identical requests have the same one, and whatever changes a result changes it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from psfcore.errors import DataError
from workers.contract import identities
from workers.contract.identities import (
    canonical_hash,
    corrected_psf_identity,
    gap_identity,
    interpolated_psf_identity,
    product_identity,
    psf_fit_identity,
    psf_identity,
    report_identity,
    request_identity,
)
from workers.contract.requests import (
    METHOD_MODELS,
    CrossValidate,
    GapDiagnose,
    Parameters,
    PsfBuild,
    PsfFit,
    PsfInterpolate,
    PsfTables,
    Report,
    ResolvedCrossValidate,
    ResolvedDeconvolve,
    ResolvedGapDiagnose,
    ResolvedPsfFit,
    ResolvedReport,
)

A, B, T = "a" * 64, "b" * 64, "c" * 64


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
    between = {
        "before_psf_id": A,
        "before_time": "2021-01-01",
        "after_psf_id": T,
        "after_time": "2022-01-01",
        "time": "2021-06-01",
    }
    assert base == identity(psf_interpolation=between), "how a PSF would be interpolated is in its id"
    assert base == identity(again=True), "this only allows the deconvolution"
    others = {
        identity(image_id=B),
        identity(psf_id=A),
        identity(method={"name": "richardson-lucy", "steps": 19}),
        identity(method={"name": "richardson-lucy", "edges": "zero"}),
        identity(method={"name": "linear"}),
        identity(noise={"photon_gain_dn": 6.0, "read_noise_dn": 2.0}),
        identity(saturation_dn=4000.0),
        identity(error_draws=8),
        identity(other_channel=True),
    }
    monkeypatch.setattr(METHOD_MODELS["richardson-lucy"], "algorithm_version", 99)
    others.add(identity())
    assert len(others) == 10 and base not in others


def test_an_interpolated_psf_is_identified_by_its_ends_and_times(monkeypatch: pytest.MonkeyPatch) -> None:
    known = {
        "before_psf_id": A,
        "before_time": "2021-01-01",
        "after_psf_id": B,
        "after_time": "2022-01-01",
        "time": "2021-06-01",
    }
    changes = (
        {},
        {"before_psf_id": T},
        {"after_psf_id": T},
        {"before_time": "2021-01-02"},
        {"after_time": "2022-01-02"},
        {"time": "2021-06-02"},
    )
    found = {interpolated_psf_identity(PsfInterpolate.model_validate(known | change)) for change in changes}
    monkeypatch.setattr(PsfInterpolate, "algorithm_version", PsfInterpolate.algorithm_version + 1)
    found.add(interpolated_psf_identity(PsfInterpolate.model_validate(known)))
    assert len(found) == len(changes) + 1


def test_a_built_psf_is_identified_by_its_parameters() -> None:
    small, large = PsfBuild(instrument="hri_euv", size=256), PsfBuild(instrument="hri_euv")
    assert psf_identity(small) != psf_identity(large)
    with pytest.raises(DataError, match="hri_euv"):
        psf_identity(PsfBuild(instrument="no_such"))


NOISE = {"photon_gain_dn": 6.0, "read_noise_dn": 2.0}
INSTRUMENT = "x = 1\n"
RECIPE = {"instrument_file": INSTRUMENT, "component": "diffraction"}


def _fit(**parameters: Any) -> str:
    return psf_fit_identity(ResolvedPsfFit.model_validate({"transit_id": T} | parameters))


def _gap(**parameters: Any) -> str:
    return gap_identity(ResolvedGapDiagnose.model_validate({"transit_id": T} | parameters))


def _cross_validation() -> str:
    given = {"transit_id": T, "noise": NOISE, "diffraction_recipe": RECIPE}
    return psf_fit_identity(ResolvedCrossValidate.model_validate(given))


def _masked() -> str:
    return psf_identity(PsfBuild(instrument_file=INSTRUMENT, size=256, component="diffraction", mask_id=A))


OPTIONS: dict[str, Any] = {
    "picked_for": "hri_euv",
    "context_id": "ctx",
    "noise": NOISE,
    "saturation_dn": 4000.0,
    "error_draws": 8,
    "method": {"name": "linear", "steps": 7, "edges": "zero"},
}
FIT: dict[str, Any] = {"noise": NOISE, "seed": 3, "shape": "knee", "as_published": True, "saturation_dn": 1.5}
# The first 16 digits of ids. The id of a result that exists must not change.
FROZEN: list[tuple[Callable[[], str], str]] = [
    (identity, "17e6708fd0c2995c"),
    (lambda: identity(changes_picture=True), "c43f1b57e5b41dcd"),
    (lambda: identity(**OPTIONS), "99226d1e87980f3c"),
    (lambda: psf_identity(PsfBuild(instrument_file=INSTRUMENT)), "77833efb52eb6c2c"),
    (_masked, "fdbe2fad028d94d3"),
    (lambda: _fit(diffraction_recipe=RECIPE), "1ef68522eb129759"),
    (lambda: _fit(**FIT), "c9fa98e30cbb058c"),
    (_cross_validation, "3e43fc58cebff856"),
    (lambda: request_identity("psf-tables")(PsfTables(psf_id=B)), "9d664534c5deabe0"),
    (lambda: _gap(psf_id=B, diffraction_recipe=RECIPE), "8923caaf92865339"),
    (lambda: _gap(added_effects=("m",), added_effects_sha256=(A,)), "d110c7d06f82695b"),
    (lambda: corrected_psf_identity(A), "3f5c6acb05b9d855"),
]


# With these versions the ids were computed. Whoever raises a version wants other ids, and need not change this test.
VERSIONS: dict[type[Parameters], int] = {
    METHOD_MODELS["richardson-lucy"]: 2,
    METHOD_MODELS["linear"]: 1,
    PsfBuild: 2,
    PsfFit: 1,
    CrossValidate: 2,
    PsfTables: 1,
    GapDiagnose: 4,
}


def test_identities_do_not_change_until_a_version_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(identities, "library_sha256", lambda: A)
    for model, version in VERSIONS.items():
        monkeypatch.setattr(model, "algorithm_version", version)
    assert [compute()[:16] for compute, _ in FROZEN] == [frozen for _, frozen in FROZEN]
    for model, version in VERSIONS.items():
        with monkeypatch.context() as patched:
            patched.setattr(model, "algorithm_version", version + 1)
            assert [compute()[:16] for compute, _ in FROZEN] != [frozen for _, frozen in FROZEN], model


def test_the_library_of_effects_is_part_of_a_diagnosis(monkeypatch: pytest.MonkeyPatch) -> None:
    before = _gap(), _fit()
    monkeypatch.setattr(identities, "library_sha256", lambda: B)
    after = _gap(), _fit()
    assert after[0] != before[0] and after[1] == before[1]


NOISY = {"noise": {"photon_gain_dn": 1.0, "read_noise_dn": 2.0}}
COMMON: tuple[dict[str, Any], ...] = (
    {"seed": 2},
    {"psf_id": B},
    {"saturation_dn": 9.0},
    NOISY,
    {"transit_id": B},
)


def test_other_parameters_of_a_transit_make_another_report_and_diagnosis() -> None:
    for model, compute, own in (
        (ResolvedReport, report_identity, ({"dark_offsets": False}, {"shapes": True})),
        (
            ResolvedGapDiagnose,
            gap_identity,
            (
                {"coverage": 0.8},
                {"correct": False},
                {"added_effects": ("mine",)},
                {"added_effects": ("mine",), "added_effects_sha256": (A,)},
            ),
        ),
    ):
        changes: tuple[dict[str, Any], ...] = ({}, *COMMON, *own)
        found = {compute(model.model_validate({"transit_id": T} | change)) for change in changes}
        assert len(found) == len(changes)
    with pytest.raises(ValueError, match="added_effects"):
        GapDiagnose(transit_id=A, added_effects=("mine",))  # type: ignore[call-arg]
    assert Report(transit_id=A).dark_offsets
