"""The limits: found and excluded as often as stated, on data drawn from the linear model; effects that look alike."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from psfcore.gap.evidence.closed_form import ClosedForm
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.evidence.responses import Evidence
from psfcore.gap.verdict.answer import FLOOR as FLOOR_OF_NONE
from psfcore.gap.verdict.answer import NONE, ONE, prior_of
from psfcore.gap.verdict.limits import ALIKE, EffectLimits, Limits, ParameterLimits, limits, upper_limit
from tests.psfcore.gap.linear_models import drawn, effect_of, use_fields

DRAWS = 60


@pytest.fixture(autouse=True, scope="module")
def _one_field() -> Iterator[None]:
    """The limits of effects do not depend on the fields, except by the prior of each effect."""
    with pytest.MonkeyPatch.context() as patched:
        use_fields(patched)
        yield


@pytest.fixture(scope="module")
def model(evidence: Evidence) -> LinearModel:
    return LinearModel(evidence, FLOOR)


def limits_of(model: LinearModel, *, observed: bool = True) -> Limits:
    return limits(ClosedForm(model), observed=observed)


def parameter_of(found: Limits, name: str) -> ParameterLimits:
    return found.effects[name].parameters[0]


def share_found(model: LinearModel, name: str, strengths: np.ndarray) -> float:
    """How often the effect alone is FLOOR times as probable as no cause. strengths: (coefficients, draws)."""
    rng, blocks, own = np.random.default_rng(8), model.evidence.unocculted, model.evidence.columns[name]
    mean = np.concatenate([disc.jacobian[list(own)].T for disc in model.discs])
    discs = mean @ strengths + rng.normal(size=(len(mean), strengths.shape[1]))
    noise = np.sqrt(blocks.variance)[..., None] * rng.normal(size=(*blocks.levels.shape, strengths.shape[1]))
    bright = blocks.gain_width * rng.normal(size=(len(blocks.levels), 1, strengths.shape[1]))
    levels = (
        np.tensordot(blocks.errors[list(own)], strengths, axes=(0, 0))
        + noise
        + blocks.means[..., None] * bright
    )
    closed = ClosedForm(model, draws=(discs, levels))
    (form,) = (form for form in closed.forms if form.effect == name)
    least = math.log(FLOOR_OF_NONE * NONE / (ONE * prior_of(closed.forms)[form]))
    return float(np.mean(closed.of_form(form)[0] > least))


def test_an_effect_of_this_strength_is_found_nine_times_in_ten_and_rarely_excluded(
    model: LinearModel,
) -> None:
    before = limits_of(model)
    for name in ("dark_offset", "column_smear"):
        true = parameter_of(before, name).found_90
        assert true is not None
        strengths = np.zeros((len(model.evidence.columns[name]), 600))
        strengths[0] = true
        assert 0.82 <= share_found(model, name, strengths) <= 0.97, name
        seen = (parameter_of(limits_of(drawn(model, {(name, 0): true}, seed)), name) for seed in range(DRAWS))
        above = sum(true > one.excluded_95 for one in seen if one.excluded_95 is not None)
        assert above / DRAWS <= 0.05 + 2 * math.sqrt(0.05 * 0.95 / DRAWS), name


def test_the_rms_of_a_random_field_is_found_and_bounded(model: LinearModel) -> None:
    """The smear as a random field: its two coefficients are drawn anew each time."""
    smear, offset = (effect_of(model.evidence, name) for name in ("column_smear", "dark_offset"))
    parameters = tuple(replace(one, positive=False, likely=0.1) for one in smear.parameters)
    field = replace(smear, field=True, parameters=parameters)
    random = replace(model, evidence=replace(model.evidence, effects=(offset, field)))
    limit = parameter_of(limits_of(random), "column_smear")
    assert limit.name == "rms" and limit.found_90 is not None
    values = limit.found_90 * np.random.default_rng(6).normal(size=(2, 600))
    assert 0.82 <= share_found(random, "column_smear", values) <= 0.97
    above = 0
    for seed in range(DRAWS):
        seen = drawn(random, {("column_smear", k): float(values[k, seed]) for k in (0, 1)}, seed)
        after = parameter_of(limits_of(seen), "column_smear").excluded_95
        assert after is not None
        above += limit.found_90 > after
    assert above / DRAWS <= 0.05 + 2 * math.sqrt(0.05 * 0.95 / DRAWS)


def test_the_excluded_strength_is_a_quantile_of_the_fitted_one(model: LinearModel) -> None:
    closed = ClosedForm(drawn(model, {("dark_offset", 0): 4.0, ("column_smear", 0): 0.05}, 1))
    offset, smear = (
        next(form for form in closed.forms if form.effect == name).variants[-1]
        for name in ("dark_offset", "column_smear")
    )
    (value, *_), covariance = closed.fitted([offset, smear])
    excluded = parameter_of(limits(closed, [offset, smear]), "dark_offset").excluded_95
    assert excluded == pytest.approx(upper_limit(value, math.sqrt(covariance[0, 0]), False), rel=1e-6)
    alone = parameter_of(limits(closed), "dark_offset").excluded_95
    assert alone != pytest.approx(excluded, rel=1e-3), "the told causes are fitted beside it"
    assert upper_limit(0.0, 2.0, False) == pytest.approx(2 * norm.ppf(0.975))
    assert upper_limit(0.0, 2.0, True) == pytest.approx(2 * norm.ppf(0.975))
    assert upper_limit(-30.0, 1.0, False) == pytest.approx(30 + norm.ppf(0.95))
    assert upper_limit(30.0, 1.0, True) == pytest.approx(30 + norm.ppf(0.95))
    assert 0 < upper_limit(-4.0, 1.0, True) < 1.0


def test_two_effects_with_one_form_are_alike_and_others_are_not(model: LinearModel) -> None:
    evidence = model.evidence
    offset = effect_of(evidence, "dark_offset")
    twin = replace(offset, name="twin", settled_by="a twin's observation")
    columns = evidence.columns | {"twin": evidence.columns["dark_offset"]}
    same = replace(evidence, effects=(*evidence.effects, twin), columns=columns)
    found = limits_of(replace(model, evidence=same))
    assert found.distances["dark_offset", "twin"] == pytest.approx(0.0, abs=0.5)
    first = found.alike[0]
    assert first.pair == ("dark_offset", "twin")
    assert (
        first.would_separate
        == "a dark exposure; or a series of exposure times at one pointing; or a twin's observation"
    )
    assert [one.distance for one in found.alike] == sorted(one.distance for one in found.alike)
    apart = limits_of(model)
    assert apart.distances["dark_offset", "column_smear"] > ALIKE and not apart.alike


def test_the_limits_as_json_and_their_leading_parameter(model: LinearModel) -> None:
    evidence = replace(model.evidence, untestable={"ghost": "the mirror is missing"})
    found = limits_of(replace(model, evidence=evidence)).as_json()
    offset = found["limits"]["dark_offset"]
    assert (offset["parameter"], offset["unit"]) == ("offset", "DN")
    assert 0 < offset["excluded_95"] < offset["found_90"]
    assert set(found["limits"]["column_smear"]["parameters"]) == {"share_below", "share_above"}
    assert found["untestable"] == [{"name": "ghost", "why": "the mirror is missing"}]
    before = limits_of(model, observed=False).as_json()["limits"]["dark_offset"]
    assert before["excluded_95"] is None and before["found_90"] == offset["found_90"]
    # An effect of any size has no limit.
    dark, smear = (effect_of(evidence, name) for name in ("dark_offset", "column_smear"))
    dark = replace(dark, parameters=tuple(replace(p, likely=math.inf) for p in dark.parameters))
    of_any_size = limits_of(replace(model, evidence=replace(evidence, effects=(dark, smear))))
    assert set(of_any_size.effects) == {"column_smear"}
    assert "is infinite" in of_any_size.untestable["dark_offset"]

    def leading(**strengths: float | None) -> ParameterLimits:
        parameters = (ParameterLimits(name, "", 2.0, found, None) for name, found in strengths.items())
        return EffectLimits(tuple(parameters)).leading

    assert leading(a=5.0, b=1.9, c=0.1).name == "b"
    assert leading(a=None, b=9.0, c=3.0).name == "c"
    assert leading(a=None).found_90 is None


def test_after_a_refit_the_excluded_strength_is_that_of_the_refit(model: LinearModel) -> None:
    """Only of the parameters that the refit fitted; the strengths that would be found stay."""
    before = limits_of(model)
    smear = effect_of(model.evidence, "column_smear")
    after = before.after_refit(smear, {"share_below": (0.02, 0.001)})
    below, above = after.effects["column_smear"].parameters
    assert below.excluded_95 == pytest.approx(0.02 + 0.001 * norm.ppf(0.95), rel=1e-6)
    assert above == before.effects["column_smear"].parameters[1]
    assert below.found_90 == before.effects["column_smear"].parameters[0].found_90
    assert after.effects["dark_offset"] == before.effects["dark_offset"]
    # A parameter that cannot be negative is excluded above 0, although the refit found less.
    negative = before.after_refit(smear, {"share_below": (-0.01, 0.001)})
    assert 0 < negative.effects["column_smear"].parameters[0].excluded_95 < 0.001  # type: ignore[operator]
