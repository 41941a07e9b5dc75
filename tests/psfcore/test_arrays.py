"""Comparison of two arrays that are equal, close, far apart or of different shapes; the scaled inverse for any
units."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.arrays import compare, scaled_inverse

IMAGE = np.array([[1.0, -4.0], [np.nan, 0.0]])


def test_an_array_equals_its_copy_for_any_memory_layout() -> None:
    for again in (IMAGE.copy(), np.asfortranarray(IMAGE), IMAGE.astype(">f8")):
        found = compare(IMAGE, again)
        assert found.same and (found.largest_relative, found.values_that_differ) == (0.0, 0)
        assert found.sha256[0] == found.sha256[1]


def test_a_difference_is_relative_to_the_largest_value() -> None:
    again = IMAGE.copy()
    again[0, 0] += 0.02
    found = compare(IMAGE, again)
    assert not found.same and found.values_that_differ == 1
    assert found.largest_relative == pytest.approx(0.02 / 4.0)
    assert found.sha256[0] != found.sha256[1]
    again = IMAGE.copy()
    again[1, 1] = -0.0
    found = compare(IMAGE, again)
    assert not found.same and (found.largest_relative, found.values_that_differ) == (0.0, 0)
    found = compare(np.ones(3, "f4"), np.ones(3, "f8"))
    assert not found.same and found.largest_relative == 0.0
    assert compare(IMAGE, IMAGE[:1]).largest_relative is None
    assert compare(IMAGE, IMAGE[:1]).values_that_differ is None
    filled = np.nan_to_num(IMAGE)
    found = compare(IMAGE, filled)
    assert not found.same and found.largest_relative is None and found.values_that_differ == 1
    assert compare(np.zeros(3), np.ones(3)).largest_relative is None


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


def test_an_undetermined_direction_has_no_variance() -> None:
    """The data determine only the sum of two parameters: the sum has a variance, the difference has none."""
    normal = np.array([[4.0, 4.0, 0.0], [4.0, 4.0, 0.0], [0.0, 0.0, 25.0]])
    inverse = scaled_inverse(normal, weakest=1e-9)
    total, difference = np.array([1.0, 1.0, 0.0]), np.array([1.0, -1.0, 0.0])
    assert total @ inverse @ total == pytest.approx(1 / 4)
    assert difference @ inverse @ difference == pytest.approx(0, abs=1e-12)
    assert inverse[2, 2] == pytest.approx(1 / 25)
    np.testing.assert_allclose(scaled_inverse(np.diag([4.0, 0.0])), np.diag([0.25, 0.0]))
