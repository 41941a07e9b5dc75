"""Linear fits of effects: which parameters they keep, and p-values of an effect and of a gap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from psfcore.gap.evidence.effect_fits import fit_effects, label_of, left_chi2, p_value_of_gap
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.evidence.responses import Evidence, gather
from psfcore.gap.library.detector import EFFECTS
from psfcore.scatter.reconstruction import Solution
from tests.psfcore.gap.linear_models import (
    discs_only,
    drawn,
    effect_of,
    sigma_of,
    with_left,
    with_residuals,
)


def test_a_fit_finds_values_errors_units_and_names(
    evidence: Evidence,
) -> None:
    model = with_residuals(evidence, {"dark_offset": 3.0})
    dark = effect_of(evidence, "dark_offset")
    fit = fit_effects(model, [dark])
    value, sigma, unit = fit.values["offset"]
    assert unit == "DN" and sigma == pytest.approx(sigma_of(evidence, "dark_offset"))
    assert value == pytest.approx(3.0, rel=0.01)  # its prior, of 20 DN, holds it back a little
    assert fit.names == ("dark_offset",) and fit.label == "dark_offset"
    before, after = left_chi2(model, model.base), left_chi2(model, fit.step)
    assert after.sum() < 0.01 * before.sum()
    assert before.sum() - after.sum() == pytest.approx(fit.gain, rel=0.01)
    # A p-value pays for the search.
    model = with_residuals(evidence, {"dark_offset": 5 * sigma})
    once = fit_effects(model, [dark])
    assert once.p_value == pytest.approx(float(chi2.sf(once.gain, 1)))
    assert fit_effects(model, [replace(dark, trials=100)]).p_value == pytest.approx(100 * once.p_value)
    assert fit_effects(model, [replace(dark, trials=10**9)]).p_value == 1.0
    strong = {name: 20 * sigma_of(evidence, name) for name in ("dark_offset", "column_smear")}
    model = with_residuals(evidence, strong)
    both = fit_effects(model, evidence.effects)
    assert {"dark_offset.offset", "column_smear.share_below"} <= set(both.values)
    assert both.label == label_of(both.names) == " + ".join(both.names)
    assert both.gain > max(fit_effects(model, [effect]).gain for effect in evidence.effects)


def test_a_fit_leaves_out_a_share_of_light_that_it_finds_negative(evidence: Evidence) -> None:
    smear, dark = (effect_of(evidence, name) for name in ("column_smear", "dark_offset"))
    sigma = sigma_of(evidence, "column_smear")
    lost = with_residuals(evidence, {"column_smear": -20 * sigma})
    fit = fit_effects(lost, [smear])
    assert "share_below" not in fit.values
    assert all(value > 0 for value, _, _ in fit.values.values())
    free = fit_effects(lost, [smear], any_sign=True)
    assert free.values["share_below"][0] < 0 and free.gain > fit.gain
    # A parameter of any sign is kept.
    assert fit_effects(with_residuals(evidence, {"dark_offset": -3.0}), [dark]).values["offset"][0] < 0
    # A fit of no parameter explains nothing.
    both = list(evidence.columns["column_smear"])
    nothing = fit_effects(
        with_left(lost, lambda disc: -20 * sigma * disc.jacobian[both].sum(axis=0)), [smear]
    )
    assert nothing.values == {} and (nothing.gain, nothing.p_value) == (0.0, 1.0)


def test_p_values_of_noise_are_uniform(solution: Solution) -> None:
    """Of a free parameter, and of the many parameters of a random field."""
    draws = 50
    for name in ("dark_offset", "flat_field_residual"):
        bare = discs_only(gather(solution, [effect for effect in EFFECTS if effect.name == name]))
        model = LinearModel(bare, FLOOR)
        values = np.array(
            [fit_effects(drawn(model, {}, seed), bare.effects).p_value for seed in range(draws)]
        )
        for level in (0.5, 0.1):
            error = np.sqrt(level * (1 - level) / draws)
            assert np.mean(values < level) == pytest.approx(level, abs=3 * error), (name, level)


def test_the_p_value_of_a_gap_is_hardly_ever_small_for_noise(evidence: Evidence) -> None:
    """The smallest of three p-values times three is at least as large as a uniform number."""
    draws = 50
    model = LinearModel(evidence, FLOOR)
    values = np.array([p_value_of_gap(drawn(model, {}, seed)) for seed in range(draws)])
    for level in (0.3, 0.1, 0.02):
        assert np.mean(values < level) <= level + 2 * np.sqrt(level * (1 - level) / draws), level
    assert values.max() <= 1.0 and np.mean(values < 0.9) > 0.3


def test_a_gap_in_the_discs_or_in_the_unocculted_field_has_a_tiny_p_value(evidence: Evidence) -> None:
    model = LinearModel(evidence, FLOOR)
    strong = [p_value_of_gap(drawn(model, {("dark_offset", 0): dn}, 1)) for dn in (3.0, 10.0)]
    assert strong[1] < strong[0] < 1e-8
    # In the discs alone: the unocculted field is not used.
    assert p_value_of_gap(with_residuals(evidence, {"dark_offset": 10.0}, noise=1.0)) < 1e-8
    # In the unocculted field alone: a tenth of the light of each second block flickers; the discs are noise.
    noise = drawn(model, {}, 1)
    blocks = noise.evidence.unocculted
    images, across = np.indices(blocks.levels.shape)
    levels = blocks.levels * (1 + 0.1 * (-1.0) ** images * (across % 2))
    changed = replace(noise, evidence=replace(noise.evidence, unocculted=replace(blocks, levels=levels)))
    assert p_value_of_gap(noise) > 1e-3 > 1e-8 > p_value_of_gap(changed)
