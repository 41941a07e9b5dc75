"""Linear fits of effects: which parameters they keep, and p-values of noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from psfcore.gap.effect import Effect
from psfcore.gap.evidence.effect_fits import COST_OF_NUMBERS, fit_effects, label_of, left_chi2
from psfcore.gap.evidence.evidence import Evidence, gather
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.library.detector import EFFECTS
from psfcore.scatter.inversion import Solution
from tests.psfcore.gap.linear_models import drawn, with_residuals

DRAWS = 200


def effect_of(evidence: Evidence, name: str) -> Effect:
    return next(effect for effect in evidence.effects if effect.name == name)


def sigma_of(evidence: Evidence, name: str) -> float:
    """The error of the first parameter of an effect."""
    plain = with_residuals(evidence, {})
    return float(np.sqrt(plain.fit([evidence.columns[name][0]]).covariance[-1, -1]))


def test_a_fit_finds_values_errors_and_units(evidence: Evidence) -> None:
    model = with_residuals(evidence, {"dark_offset": 3.0})
    fit = fit_effects(model, [effect_of(evidence, "dark_offset")])
    value, sigma, unit = fit.values["offset"]
    assert unit == "DN" and sigma == pytest.approx(sigma_of(evidence, "dark_offset"))
    assert value == pytest.approx(3.0, rel=0.01)  # its prior, of 20 DN, holds it back a little
    assert fit.names == ("dark_offset",) and fit.label == "dark_offset"
    before, after = left_chi2(model, model.base), left_chi2(model, fit.step)
    assert after.sum() < 0.01 * before.sum()
    assert before.sum() - after.sum() == pytest.approx(fit.gain, rel=0.01)


def test_parameters_of_effects_that_are_fitted_together_have_the_name_of_their_effect(
    evidence: Evidence,
) -> None:
    strong = {name: 20 * sigma_of(evidence, name) for name in ("dark_offset", "column_smear")}
    model = with_residuals(evidence, strong)
    both = fit_effects(model, evidence.effects)
    assert {"dark_offset.offset", "column_smear.share_below"} <= set(both.values)
    assert both.label == label_of(both.names) == " + ".join(both.names)
    assert both.gain > max(fit_effects(model, [effect]).gain for effect in evidence.effects)


def test_a_fit_leaves_out_a_share_of_light_that_it_finds_negative(evidence: Evidence) -> None:
    smear = effect_of(evidence, "column_smear")
    lost = with_residuals(evidence, {"column_smear": -20 * sigma_of(evidence, "column_smear")})
    fit = fit_effects(lost, [smear])
    assert "share_below" not in fit.values
    assert all(value > 0 for value, _, _ in fit.values.values())
    free = fit_effects(lost, [smear], any_sign=True)
    assert free.values["share_below"][0] < 0 and free.gain > fit.gain
    # A parameter of any sign is kept.
    dark = effect_of(evidence, "dark_offset")
    assert fit_effects(with_residuals(evidence, {"dark_offset": -3.0}), [dark]).values["offset"][0] < 0


@pytest.mark.parametrize("worth", [True, False])
def test_a_measured_change_must_gain_what_its_numbers_cost(evidence: Evidence, worth: bool) -> None:
    (column,) = evidence.columns["dark_offset"]
    dark = effect_of(evidence, "dark_offset")
    model = with_residuals(evidence, {"dark_offset": 10 * sigma_of(evidence, "dark_offset")})
    gain = fit_effects(model, [dark]).gain
    numbers = int(gain / COST_OF_NUMBERS) + (-2 if worth else 2)
    measured = replace(model, evidence=replace(model.evidence, numbers={column: numbers}))
    fit = fit_effects(measured, [dark])
    assert set(fit.values) == ({"offset"} if worth else set())
    assert fit.gain == pytest.approx(gain if worth else 0.0)
    # The p-value allows for the gain of every number from noise.
    assert fit.p_value == pytest.approx(float(chi2.sf(gain, 1 + numbers)) if worth else 1.0)


def test_a_fit_of_no_parameter_explains_nothing(evidence: Evidence) -> None:
    smear = effect_of(evidence, "column_smear")
    below, above = evidence.columns["column_smear"]
    model = with_residuals(evidence, {})
    theta = np.zeros(evidence.size)
    theta[[below, above]] = -20 * sigma_of(evidence, "column_smear")
    discs = tuple(replace(disc, residual=disc.jacobian.T @ theta) for disc in model.evidence.discs)
    fit = fit_effects(replace(model, evidence=replace(model.evidence, discs=discs)), [smear])
    assert fit.values == {} and fit.gain == 0.0 and fit.p_value == 1.0


@pytest.mark.parametrize("name", ["dark_offset", "flat_field_residual"])
def test_p_values_of_noise_are_uniform(solution: Solution, name: str) -> None:
    """Of a free parameter, and of the many parameters of a random field."""
    found = gather(solution, [effect for effect in EFFECTS if effect.name == name])
    bare = replace(
        found, unocculted=replace(found.unocculted, part=np.zeros(len(found.image_info), dtype=bool))
    )
    model = LinearModel(bare, FLOOR)
    values = np.array([fit_effects(drawn(model, {}, seed), bare.effects).p_value for seed in range(DRAWS)])
    for level in (0.5, 0.1):
        error = np.sqrt(level * (1 - level) / DRAWS)
        assert np.mean(values < level) == pytest.approx(level, abs=3 * error)


def test_a_p_value_pays_for_the_search(evidence: Evidence) -> None:
    model = with_residuals(evidence, {"dark_offset": 5 * sigma_of(evidence, "dark_offset")})
    dark = effect_of(evidence, "dark_offset")
    once = fit_effects(model, [dark])
    assert once.p_value == pytest.approx(float(chi2.sf(once.gain, 1)))
    assert fit_effects(model, [replace(dark, trials=100)]).p_value == pytest.approx(100 * once.p_value)
    assert fit_effects(model, [replace(dark, trials=10**9)]).p_value == 1.0
