"""Closure, gap, deviance and the shares of axes, compared with calculations by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.evidence.responses import Evidence
from psfcore.gap.verdict.axes import ranked_axes, shapley
from psfcore.gap.verdict.closure import FORM_ERROR, HeldOut, closure, fall, gap, hold_out, time_blocks
from tests.psfcore.gap.linear_models import discs_only, with_left, with_residuals


def test_percentages_refer_to_the_observed_light_before_a_subtraction(evidence: Evidence) -> None:
    """After the subtraction of an effect a disc may have a negative mean."""
    plain = LinearModel(evidence, FLOOR)
    after = with_left(plain, lambda disc: -1.5 * disc.expected)
    assert all(disc.observed < 0 for disc in after.evidence.discs)
    levels = {disc.index: disc.level for disc in evidence.discs}
    discs = tuple(replace(disc, level_before=levels[disc.index]) for disc in after.evidence.discs)
    of_before = replace(after, evidence=replace(after.evidence, discs=discs))
    pct = [hold_out(model, (), time_blocks(model)) for model in (after, of_before)]
    assert pct[0] is not None and pct[1] is not None and pct[0].noise_pct.min() > 0
    ratio = [abs(disc.observed) / levels[disc.index] for disc in after.evidence.discs]
    at = [disc.index for disc in discs]
    assert pct[1].residual_pct / pct[0].residual_pct == pytest.approx(
        [ratio[at.index(n)] for n in pct[0].images]
    )


def test_a_fold_is_predicted_by_a_fit_to_the_other_images(evidence: Evidence) -> None:
    """chi2, its expected value, deviance and spread of one fold, from the whitened residuals of its images."""
    model = LinearModel(discs_only(evidence), FLOOR)
    columns = evidence.columns["dark_offset"]
    fold = time_blocks(model)[0]
    held_out = hold_out(model, columns, [fold])
    assert held_out is not None
    step = model.fit(columns, model.equations(fold.fitted))
    discs = {disc.index: disc for disc in model.discs}
    here = list(step.columns)
    left = [discs[n].residual - discs[n].jacobian[here].T @ step.values for n in held_out.images]
    jacobians = [discs[n].jacobian[here] for n in held_out.images]
    errors = [np.trace(j.T @ step.covariance @ j) for j in jacobians]
    assert held_out.chi2 == pytest.approx([one @ one for one in left])
    assert held_out.expected == pytest.approx([one.size + e for one, e in zip(left, errors, strict=True)])
    whole, jacobian = np.concatenate(left), np.concatenate(jacobians, axis=1)
    covariance = np.eye(whole.size) + jacobian.T @ step.covariance @ jacobian
    ((images, deviance),) = held_out.deviance.items()
    assert images == held_out.images
    ln_l = multivariate_normal(cov=covariance).logpdf(whole)
    assert deviance == pytest.approx(-2 * ln_l - whole.size * np.log(2 * np.pi))
    of_discs, of_all = held_out.spread[images]
    assert of_discs.sum() == pytest.approx(sum(errors)) and of_all == pytest.approx(of_discs)
    # chi2 that errors of the parameters add: its variance is that of independent parts.
    rng = np.random.default_rng(3)
    drawn = rng.multivariate_normal(np.zeros(len(here)), step.covariance, 20_000) @ jacobian
    assert np.var(np.sum(drawn**2, axis=1)) == pytest.approx(2 * np.sum(of_discs**2), rel=0.1)


def of_images(chi2: float, expected: float, blocks: float = 0.0, residual_pct: float = 0.0) -> HeldOut:
    """The results of six held-out images that are all equal."""
    ones = np.ones(6)
    return HeldOut(
        tuple(range(6)), chi2 * ones, expected * ones, blocks * ones, 0 * ones, residual_pct * ones, ones
    )


def test_closure_its_interval_gap_and_fall_by_hand() -> None:
    rng = np.random.default_rng(1)
    before, after = of_images(110.0, 10.0, residual_pct=5.0), of_images(20.0, 10.0, residual_pct=1.0)
    found = closure(before, after, rng)
    assert found is not None and found.value == pytest.approx(0.9)  # 1 - 10 / 100
    assert gap(before.residual_pct, before.noise_pct, rng).value == pytest.approx(np.sqrt(24.0))
    assert gap(after.residual_pct, after.noise_pct, rng).value == 0.0
    assert closure(of_images(9.0, 10.0), after, rng) is None
    # A decrease of deviance uses the common folds.
    first = replace(before, deviance={(0,): 30.0, (1,): 20.0})
    assert fall(first, replace(after, deviance={(0,): 12.0, (2,): 1.0})) == 18.0

    def interval_of(
        after: HeldOut, scale_error: float = 0.0, blocks: float = 0.0
    ) -> tuple[float, float, float]:
        interval = closure(of_images(110.0, 10.0, blocks), after, np.random.default_rng(1), scale_error)
        assert interval is not None
        return interval.low, interval.value, interval.high

    # All images are equal, so the interval contains only the error of form.
    same = interval_of(of_images(30.0, 10.0))
    assert same == pytest.approx((0.80, 0.80, 0.80 + FORM_ERROR**2))
    # Of the remaining 20, 15 come from errors of the parameters.
    assert interval_of(of_images(30.0, 25.0))[1:] == pytest.approx((0.80, 1.0))
    # If all of it comes from one direction, it is often more than its mean: up to 3.8 times.
    one_direction = {tuple(range(6)): (np.array([30.0]), np.array([30.0]))}  # the sum over six images is 30
    low, value, high = interval_of(replace(of_images(60.0, 15.0), spread=one_direction))
    assert value == pytest.approx(0.50)
    assert high == pytest.approx(0.50 + 3.84 * 30 / 600 + FORM_ERROR**2, abs=0.02)
    # A noise scale with an error of 20 % widens the interval on both sides.
    low, _, high = interval_of(of_images(30.0, 10.0), 0.2)
    assert low < same[0] - 0.02 and same[2] + 0.02 < high <= 1
    # The unocculted blocks count if they show more of the gap and the effect explains them.
    for shown, left, closed in ((900.0, 0.0, 0.9), (90.0, 0.0, 0.0), (900.0, 800.0, 0.0)):
        assert interval_of(of_images(110.0, 10.0, left), blocks=shown)[1] == pytest.approx(closed), shown
    # No cause closes more than the gap: what an estimate is above 1 widens the interval, which contains 1.
    assert interval_of(of_images(4.0, 10.0)) == pytest.approx((1.0, 1.0, 1.0))
    low, *others = interval_of(of_images(4.0, 10.0), 0.2)
    assert low < 0.98 and others == [1.0, 1.0]


def test_shares_of_axes_are_averages_over_orders_and_the_axis_of_a_gap_is_first(evidence: Evidence) -> None:
    worth = {(): 0.0, ("a",): 1.0, ("b",): 2.0, ("a", "b"): 2.5}
    shares = shapley(["a", "b"], worth)
    assert shares == pytest.approx({"a": 0.75, "b": 1.75})  # (1 + 0.5) / 2 and (2 + 1.5) / 2
    noise = with_residuals(evidence, {}, noise=1.0)
    rings = with_left(noise, lambda disc: disc.residual + 0.5 * disc.expected * (disc.radius - 0.6))
    axes, of_noise = (ranked_axes(model, np.random.default_rng(1)) for model in (rings, noise))
    assert axes[0].name == "radius_in_disc" and axes[0].share > 0.4
    assert sum(axis.share for axis in axes) == pytest.approx(1.0)
    # Of nine discs, few sign flips differ.
    assert axes[0].p_value < 0.1 < min(axis.p_value for axis in of_noise)
