"""Closure, gap and deviance, compared with calculations by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.verdict.closure import (
    FORM_ERROR,
    HeldOut,
    _along_errors,
    _deviance,
    _spread,
    closure,
    fall,
    gap,
    hold_out,
    time_blocks,
)
from psfcore.gap.verdict.correction import _with_noise_of


def test_percentages_refer_to_the_observed_light_after_a_subtraction(evidence: Evidence) -> None:
    """After the subtraction of an effect a disc may have a negative mean."""
    taken_out = replace(
        evidence, discs=tuple(replace(disc, residual=-1.5 * disc.expected) for disc in evidence.discs)
    )
    assert all(disc.observed < 0 for disc in taken_out.discs)
    before, after = evidence, _with_noise_of(evidence, taken_out)
    assert [disc.level for disc in after.discs] == [disc.level for disc in before.discs]
    for one in (after, taken_out):
        model = LinearModel(one, FLOOR)
        held_out = hold_out(model, (), time_blocks(model))
        assert held_out is not None and held_out.noise_pct.min() > 0


def test_closure_and_gap_by_hand() -> None:
    rng = np.random.default_rng(1)
    ones = np.ones(4)

    def held_out(chi2: list[float], residual: list[float]) -> HeldOut:
        return HeldOut((0, 1, 2, 3), np.array(chi2), 10 * ones, 0 * ones, 0 * ones, np.array(residual), ones)

    before, after = held_out([110.0] * 4, [5.0] * 4), held_out([20.0] * 4, [1.0] * 4)
    found = closure(before, after, rng)
    assert found is not None and found.value == pytest.approx(0.9)  # 1 - 10 / 100
    assert gap(before, rng).value == pytest.approx(np.sqrt(24.0))
    assert gap(after, rng).value == 0.0
    assert closure(held_out([9.0] * 4, [0.0] * 4), after, rng) is None


def test_the_spread_is_the_chi2_that_errors_of_the_parameters_add() -> None:
    rng = np.random.default_rng(3)
    root = rng.standard_normal((3, 3))
    covariance, jacobian = root @ root.T, rng.standard_normal((3, 40))
    spread = _spread(_along_errors(jacobian, covariance))
    assert spread.sum() == pytest.approx(np.trace(jacobian.T @ covariance @ jacobian))
    drawn = rng.multivariate_normal(np.zeros(3), covariance, 20_000) @ jacobian
    assert np.var(np.sum(drawn**2, axis=1)) == pytest.approx(2 * np.sum(spread**2), rel=0.1)


def test_the_interval_of_closure_contains_its_known_errors() -> None:
    ones = np.ones(6)

    def held_out(chi2: float, expected: float, unocculted: float = 0.0) -> HeldOut:
        return HeldOut(
            tuple(range(6)), chi2 * ones, expected * ones, unocculted * ones, 0 * ones, 0 * ones, ones
        )

    before, after = held_out(110.0, 10.0), held_out(30.0, 10.0)
    # All images are equal, so the interval contains only the error of form.
    same = closure(before, after, np.random.default_rng(1))
    assert same is not None
    assert (same.low, same.value, same.high) == pytest.approx((0.80, 0.80, 0.80 + FORM_ERROR**2))
    # Of the remaining 20, 15 come from errors of the parameters.
    unsure = closure(before, held_out(30.0, 25.0), np.random.default_rng(1))
    assert unsure is not None and (unsure.value, unsure.high) == pytest.approx((0.80, 1.0))
    # If all of it comes from one direction, it is often more than its mean: up to 3.8 times.
    one_direction = {tuple(range(6)): (np.array([30.0]), np.array([30.0]))}  # the sum over six images is 30
    drawn = closure(before, replace(held_out(60.0, 15.0), spread=one_direction), np.random.default_rng(1))
    assert drawn is not None and drawn.value == pytest.approx(0.50)
    assert drawn.high == pytest.approx(0.50 + 3.84 * 30 / 600 + FORM_ERROR**2, abs=0.02)
    # A noise scale with an error of 20 % widens the interval on both sides.
    wide = closure(before, after, np.random.default_rng(1), 0.2)
    assert wide is not None and wide.low < same.low - 0.02 and same.high + 0.02 < wide.high <= 1
    # The unocculted blocks count if they show more of the gap and the effect explains them.
    for unocculted_before, unocculted_after, closed in (
        (900.0, 0.0, 0.9),
        (90.0, 0.0, 0.0),
        (900.0, 800.0, 0.0),
    ):
        found = closure(
            held_out(110.0, 10.0, unocculted_before),
            held_out(110.0, 10.0, unocculted_after),
            np.random.default_rng(1),
        )
        assert found is not None and found.value == pytest.approx(closed)


def test_deviance_is_the_log_likelihood_of_a_fold() -> None:
    rng = np.random.default_rng(2)
    left, jacobian, root = rng.normal(size=7), rng.normal(size=(3, 7)), rng.normal(size=(3, 3))
    covariance = root @ root.T
    spread = np.eye(7) + jacobian.T @ covariance @ jacobian
    expected = -2 * multivariate_normal(cov=spread).logpdf(left) - 7 * np.log(2 * np.pi)
    assert _deviance(left, _along_errors(jacobian, covariance)) == pytest.approx(expected)
    assert _deviance(left, _along_errors(jacobian[:0], covariance[:0, :0])) == pytest.approx(left @ left)


def test_a_decrease_of_deviance_uses_the_common_folds() -> None:
    ones = np.ones(2)
    before, after = (
        HeldOut((0, 1), ones, ones, ones, ones, ones, ones, of_folds)
        for of_folds in ({(0,): 30.0, (1,): 20.0}, {(0,): 12.0, (2,): 1.0})
    )
    assert fall(before, after) == 18.0
