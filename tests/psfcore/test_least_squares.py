"""The scaled inverse is the inverse for any units; undetermined directions get no variance."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.least_squares import scaled_inverse


def normal_matrix(rows: int = 20, columns: int = 4) -> np.ndarray:
    slopes = np.random.default_rng(1).normal(size=(rows, columns))
    return np.asarray(slopes.T @ slopes)


def test_units_do_not_matter() -> None:
    """Units differ by 1e12: a pseudo-inverse of the unscaled matrix would lose two parameters."""
    normal, units = normal_matrix(), np.diag([1e-6, 1.0, 1e3, 1e6])
    expected = np.linalg.inv(units) @ np.linalg.inv(normal) @ np.linalg.inv(units)
    np.testing.assert_allclose(scaled_inverse(units @ normal @ units, weakest=1e-9), expected, rtol=1e-9)
    cut = np.linalg.pinv(units @ normal @ units, rcond=1e-9, hermitian=True)
    assert cut[0, 0] < 1e-3 * expected[0, 0]


def test_an_undetermined_direction_has_no_variance_and_others_keep_theirs() -> None:
    """The data determine only the sum of two parameters: the sum has a variance, the difference has none."""
    normal = np.array([[4.0, 4.0, 0.0], [4.0, 4.0, 0.0], [0.0, 0.0, 25.0]])
    inverse = scaled_inverse(normal, weakest=1e-9)
    total, difference = np.array([1.0, 1.0, 0.0]), np.array([1.0, -1.0, 0.0])
    assert total @ inverse @ total == pytest.approx(1 / 4)
    assert difference @ inverse @ difference == pytest.approx(0, abs=1e-12)
    assert inverse[2, 2] == pytest.approx(1 / 25)


def test_a_parameter_without_influence_has_no_variance() -> None:
    np.testing.assert_allclose(scaled_inverse(np.diag([4.0, 0.0])), np.diag([0.25, 0.0]))
