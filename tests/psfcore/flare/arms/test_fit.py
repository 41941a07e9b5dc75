"""The fit's splines, its Jacobian and its solver."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.flare.arms import fit
from psfcore.flare.arms.orders import Geometry, Orders, orders_between, select_pixels

GEOMETRY = Geometry((50.2, 49.7), 4.0, (15.0, 40.0))
PATTERN = np.array([0.1, 1.6, 9.3])


def fitted_orders() -> Orders:
    arm, k = orders_between(PATTERN, GEOMETRY.radii_px)
    plane = np.zeros((101, 101))
    return select_pixels(plane, plane == 0, plane + 1, GEOMETRY, PATTERN, arm, k)


def test_the_splines_sum_to_1_and_their_slope_is_the_derivative() -> None:
    t = np.linspace(-2.5, 2.5, 101)
    inside = np.linspace(-0.5, 0.5, 11)
    np.testing.assert_allclose(sum(fit._spline(inside - knot) for knot in range(-3, 4)), 1.0)
    slope = (fit._spline(t + 1e-6) - fit._spline(t - 1e-6)) / 2e-6
    np.testing.assert_allclose(fit._spline_slope(t), slope, atol=1e-5)


def test_the_jacobian_is_the_derivative_of_the_model() -> None:
    orders = fitted_orders()
    rng = np.random.default_rng(0)
    source = GEOMETRY.source(rng.random(int(GEOMETRY.disc.sum())))
    state = fit.FitState(PATTERN, rng.random(orders.k.size) + 0.5, source)
    bases = fit._bases(orders, GEOMETRY, state.pattern)
    jacobian = np.hstack(
        (
            fit._columns_of_pattern(orders, bases, state),
            fit._columns_of_stamps(orders, bases, bases.stamps(state.source)),
            fit._columns_of_source(orders, bases, GEOMETRY, state.amplitude),
        )
    )

    def light(step: np.ndarray) -> np.ndarray:
        moved = state.moved(step, GEOMETRY)
        return fit._light(orders, fit._bases(orders, GEOMETRY, moved.pattern), moved)

    for column in (0, 1, 2, 3, 3 + orders.k.size, jacobian.shape[1] - 1):
        step = np.zeros(jacobian.shape[1])
        step[column] = 1e-6
        derivative = (light(step) - light(-step)) / 2e-6
        np.testing.assert_allclose(jacobian[:, column], derivative, atol=1e-5)


def test_undetermined_combinations_stay_zero() -> None:
    columns = np.array([[1.0, 1.0], [2.0, 2.0], [0.5, 0.5]])
    solution, _, rank = fit._solve(columns, columns @ np.array([3.0, 1.0]))
    assert rank == 1
    assert solution == pytest.approx([2.0, 2.0])
