"""The evidence of parameters that cannot be negative, compared with integrals on a grid."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np
import pytest
from scipy.integrate import trapezoid

from psfcore.gap.evidence.one_sided import log_odds_above_zero, log_odds_at_zero, log_of_any_number

WIDTH = 0.7


@pytest.mark.parametrize("best", [-3.0, -0.4, 0.0, 0.4, 3.0])
def test_the_odds_are_the_integral_over_all_values_above_zero(best: float) -> None:
    """ln L is a parabola around `best` with the curvature 4; the odds are relative to the value 0."""
    curvature = 4.0
    values = np.linspace(0, 10, 200001)
    prior = math.sqrt(2 / math.pi) / WIDTH * np.exp(-((values / WIDTH) ** 2) / 2)
    gain = curvature * (best * values - values**2 / 2)
    wanted = math.log(trapezoid(prior * np.exp(gain), values))
    total = curvature + WIDTH**-2
    with_prior = curvature * best / total
    if best <= 0:
        one = log_odds_at_zero(np.array([curvature * best]), np.array([curvature]), np.array([WIDTH]))
    else:
        one = log_odds_above_zero(np.array([with_prior]), np.array([total**-0.5]), np.array([WIDTH]))
    assert one[0] == pytest.approx(wanted, abs=1e-4)


def test_the_sum_is_over_every_choice_of_the_parameters_that_act() -> None:
    odds = np.array([8.0, 0.3, 1e-4, 2.0])
    each_number = [np.mean([math.prod(some) for some in combinations(odds, k)]) for k in range(1, 5)]
    assert log_of_any_number(np.log(odds)) == pytest.approx(math.log(np.mean(each_number)))
    with_none = np.mean([1.0, *each_number])
    assert log_of_any_number(np.log(odds), least=0) == pytest.approx(math.log(with_none))
    assert log_of_any_number(np.log(odds[:1])) == pytest.approx(math.log(8.0)), (
        "a single parameter always acts"
    )


def test_sides_without_light_cost_little_beside_a_side_with_light() -> None:
    """If all sides had to act, eleven dark sides with odds of 1e-3 each would cost ln 1e33."""
    dark = np.full(11, math.log(1e-3))
    bright = 50.0
    assert log_of_any_number(np.append(dark, bright)) == pytest.approx(bright - math.log(12 * 12), abs=0.02)
