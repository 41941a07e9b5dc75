"""The limits: found and excluded as often as stated, on data drawn from the linear model; closed forms; effects that look alike."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.stats import chi2, ncx2, norm

from psfcore.gap.evidence.effect_fits import fit_effects
from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.fields import FieldColumns
from psfcore.gap.evidence.likelihood import SCALES
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.verdict.calibration import Calibration
from psfcore.gap.verdict.limits import (
    ALIKE,
    EffectLimits,
    Limits,
    ParameterLimits,
    cumulants,
    limits,
    quantile_of_sum,
    upper_limit,
)
from psfcore.gap.verdict.posterior import NONE, PRIOR, posterior, without_idle
from tests.psfcore.gap.linear_models import drawn, effect_of

THRESHOLD = 0.05
DRAWS = 150  # with 60, noise alone leaves the tested range once in thirty times
ANSWER = Calibration(1.0, (THRESHOLD,) * 9, {})


Of = Callable[..., Limits]


@pytest.fixture(scope="module")
def limits_of(columns: FieldColumns) -> Of:
    """A function that gives the limits of a model for the answer above; further arguments are those of `limits`."""
    return partial(limits, threshold=THRESHOLD, temperature=1.0, fields=columns)


@pytest.fixture(scope="module")
def model(evidence: Evidence) -> LinearModel:
    return LinearModel(evidence, FLOOR, scale_error=0.1)


def strength_of(found: Limits, name: str) -> float:
    strength = found.effects[name].parameters[0].found_90
    assert strength is not None
    return strength


def names_it(model: LinearModel, name: str, columns: FieldColumns) -> bool:
    """Whether the answer that the posterior gives contains the effect and not "no gap"."""
    answer = ANSWER.answer(without_idle(posterior(model, columns).probabilities()))
    return NONE not in answer and (name,) in answer


@pytest.mark.slow  # the strength of a noncentral chi2 below is the fast case, and the fit of the effect that of what is excluded
def test_an_effect_of_this_strength_is_found_nine_times_in_ten_and_rarely_excluded(
    model: LinearModel, columns: FieldColumns, limits_of: Of
) -> None:
    """With noise drawn anew each time, by the answer that the posterior itself gives."""
    for name in ("dark_offset", "column_smear"):
        true = strength_of(limits_of(model), name)
        seen = [drawn(model, {(name, 0): true}, seed) for seed in range(DRAWS)]
        assert 0.82 <= sum(names_it(one, name, columns) for one in seen) / DRAWS <= 0.97, name
        excluded = [limits_of(one).effects[name].parameters[0].excluded_95 for one in seen]
        above = sum(true > one for one in excluded if one is not None)
        assert above / DRAWS <= 0.05 + 2 * math.sqrt(0.05 * 0.95 / DRAWS), name


@pytest.mark.slow
def test_the_rms_of_a_random_field_is_found_and_bounded(
    model: LinearModel, columns: FieldColumns, limits_of: Of
) -> None:
    """The smear as a random field: its two coefficients are drawn anew each time, with the standard deviation that should be found."""
    smear, offset = (effect_of(model.evidence, name) for name in ("column_smear", "dark_offset"))
    # A likely size that these data can show; of a field that is far stronger than its prior, the cause would be "unknown".
    parameters = tuple(replace(one, positive=False, likely=0.1) for one in smear.parameters)
    field = replace(smear, field=True, parameters=parameters)
    random = replace(model, evidence=replace(model.evidence, effects=(offset, field)))
    (limit,) = limits_of(random).effects["column_smear"].parameters
    assert limit.name == "rms" and limit.found_90 is not None
    rng = np.random.default_rng(6)
    found, above = 0, 0
    for seed in range(DRAWS):
        values = limit.found_90 * rng.normal(size=2)
        seen = drawn(random, {("column_smear", k): float(values[k]) for k in (0, 1)}, seed)
        found += names_it(seen, "column_smear", columns)
        (after,) = limits_of(seen).effects["column_smear"].parameters
        assert after.excluded_95 is not None
        above += limit.found_90 > after.excluded_95
    assert 0.82 <= found / DRAWS <= 0.97
    assert above / DRAWS <= 0.05 + 2 * math.sqrt(0.05 * 0.95 / DRAWS)


def test_the_excluded_strength_is_a_quantile_of_the_fitted_one(model: LinearModel, limits_of: Of) -> None:
    for name, true in (("dark_offset", 4.0), ("column_smear", 0.02)):
        seen = drawn(model, {(name, 0): true}, 1)
        value, sigma, _ = next(iter(fit_effects(seen, [effect_of(model.evidence, name)]).values.values()))
        excluded = limits_of(seen).effects[name].parameters[0].excluded_95
        assert excluded == pytest.approx(value + norm.ppf(0.95) * sigma, abs=0.6 * sigma), name


def test_the_found_strength_is_that_of_a_noncentral_chi2(model: LinearModel, limits_of: Of) -> None:
    """With one effect in the library, and against "no effect" alone, the strength follows from one noncentral chi2 variable."""
    (column,), base = model.evidence.columns["dark_offset"], list(model.evidence.base)
    offset = effect_of(model.evidence, "dark_offset")
    evidence = replace(model.evidence, effects=(offset,), columns={"dark_offset": (column,)})
    alone = replace(model, evidence=evidence, scale_error=1e-3)
    prior = dict(PRIOR) | {"unknown": 1e-12}
    strength = strength_of(limits_of(alone, prior=prior), "dark_offset")
    normal = alone.equations()[0]
    absorbed = normal[column, base] @ np.linalg.solve(normal[np.ix_(base, base)], normal[base, column])
    information = float(normal[column, column] - absorbed)

    def log_odds(z2: float) -> float:
        grown = [information * (scale * offset.parameters[0].likely) ** 2 for scale in SCALES]
        weights = [math.exp(z2 / 2 * g / (1 + g)) / math.sqrt(1 + g) for g in grown]
        return math.log(prior["single"] / prior["none"] * sum(weights) / len(weights))

    least = next(z2 for z2 in np.arange(0.0, 60.0, 0.01) if log_odds(z2) > math.log(1 / THRESHOLD - 1))
    assert float(ncx2.sf(least, 1, information * strength**2)) == pytest.approx(0.9, abs=0.02)
    usual, strict, lax, warm = (
        strength_of(limits_of(model, **changes), "dark_offset")
        for changes in ({}, {"threshold": 0.01}, {"threshold": 0.2}, {"temperature": 3.0})
    )
    assert strict > usual > lax and warm > usual


def test_the_quantiles_of_a_sum_of_noncentral_variables_and_of_a_strength() -> None:
    for weights, d2 in (([1.0], [20.0]), ([0.9, 0.5, 0.1], [8.0, 3.0, 0.0]), ([1.0, 1.0], [0.0, 0.0])):
        w, d = np.array(weights), np.array(d2)
        of_sum = np.array([[np.sum(w**r * (1 + r * d)) for r in (1, 2, 3)]])
        rng = np.random.default_rng(1)
        sums = ((rng.normal(size=(200_000, w.size)) + np.sqrt(d)) ** 2) @ w
        exact = np.quantile(sums, 0.1)
        assert quantile_of_sum(of_sum, 0.1)[0] == pytest.approx(exact, rel=0.04, abs=0.05), weights
    plain = np.array([[5.0, 5.0, 5.0]])  # chi2 with five degrees of freedom
    assert quantile_of_sum(plain, 0.1)[0] == pytest.approx(chi2.ppf(0.1, 5), rel=0.01)
    # The cumulants of a random field, from sums drawn with random coefficients; they leave out the factors 1, 2 and 8.
    rng = np.random.default_rng(3)
    values, score, strength = np.array([6.0, 2.0, 0.5]), rng.normal(size=(3, 4)), 1.7
    changed = rng.normal(size=(400_000, 3)) * np.sqrt(values)
    changed += strength * rng.normal(size=(400_000, 4)) @ score.T
    sums = (changed**2) @ (1 / (1 + values))
    third = float(np.mean((sums - sums.mean()) ** 3))
    found = cumulants(values, score, random=True) @ strength ** (2 * np.arange(4))
    assert found == pytest.approx([sums.mean(), sums.var() / 2, third / 8], rel=0.05)
    assert upper_limit(0.0, 2.0, False) == pytest.approx(2 * norm.ppf(0.975))
    assert upper_limit(0.0, 2.0, True) == pytest.approx(2 * norm.ppf(0.975))
    assert upper_limit(-30.0, 1.0, False) == pytest.approx(30 + norm.ppf(0.95))
    assert upper_limit(30.0, 1.0, True) == pytest.approx(30 + norm.ppf(0.95))
    assert 0 < upper_limit(-4.0, 1.0, True) < 1.0


def test_two_effects_with_one_form_are_alike_and_others_are_not(model: LinearModel, limits_of: Of) -> None:
    evidence = model.evidence
    offset = effect_of(evidence, "dark_offset")
    twin = replace(offset, name="twin", settled_by="a twin's observation")
    columns = evidence.columns | {"twin": evidence.columns["dark_offset"]}
    same = replace(evidence, effects=(*evidence.effects, twin), columns=columns)
    found = limits_of(replace(model, evidence=same))
    assert found.distances["dark_offset", "twin"] == pytest.approx(0.0, abs=0.5)
    first = found.alike[0]
    assert first.pair == ("dark_offset", "twin")
    assert offset.settled_by in first.would_separate and twin.settled_by in first.would_separate
    assert [one.distance for one in found.alike] == sorted(one.distance for one in found.alike)
    apart = limits_of(model)
    assert apart.distances["dark_offset", "column_smear"] > ALIKE and not apart.alike


def test_the_limits_as_json_and_their_leading_parameter(model: LinearModel, limits_of: Of) -> None:
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


def test_after_a_refit_the_excluded_strength_is_that_of_the_refit(model: LinearModel, limits_of: Of) -> None:
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
