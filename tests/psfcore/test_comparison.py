"""Comparison of two arrays: equal, close, far apart, and of different shapes."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.comparison import compare

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


def test_zero_of_the_other_sign_differs_only_in_its_bits() -> None:
    again = IMAGE.copy()
    again[1, 1] = -0.0
    found = compare(IMAGE, again)
    assert not found.same and (found.largest_relative, found.values_that_differ) == (0.0, 0)


def test_a_difference_that_is_not_defined_is_none() -> None:
    assert compare(IMAGE, IMAGE[:1]).largest_relative is None
    assert compare(IMAGE, IMAGE[:1]).values_that_differ is None
    filled = np.nan_to_num(IMAGE)
    found = compare(IMAGE, filled)
    assert not found.same and found.largest_relative is None and found.values_that_differ == 1
    assert compare(np.zeros(3), np.ones(3)).largest_relative is None


def test_equal_values_of_another_number_type_are_not_the_same_bits() -> None:
    found = compare(np.ones(3, "f4"), np.ones(3, "f8"))
    assert not found.same and found.largest_relative == 0.0
