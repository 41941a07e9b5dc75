"""Plots: their tables hold the numbers from which a script draws the curves."""

from __future__ import annotations

from itertools import pairwise

import pytest

from service.pages.plots import FINE_TO_PX, RATIO, Plot, Series, shown_radii, with_errors, written


def test_the_table_holds_x_the_values_and_the_ends_of_the_band() -> None:
    series = [
        with_errors("a", [9.0, 2.0, 4.0], [9.0, 0.5, 1.0], [1, 2]),
        with_errors("b", [None, 1e-5], None),
    ]
    plot = Plot("t", "x", "y", [1.0, 2.0], series)
    assert [(heading, role) for heading, _, role, _ in plot.columns] == [
        ("a", "line"),
        ("a, low", "low"),
        ("a, high", "high"),
        ("b", "line"),
    ]
    assert plot.rows == [(None, ["1", "2", "1.5", "2.5", ""]), (None, ["2", "4", "3", "5", "1e-05"])]


def test_rows_of_unequal_length_are_refused() -> None:
    with pytest.raises(ValueError, match="expected 2 numbers in each row; got 1"):
        Plot("t", "x", "y", [1.0, 2.0], [Series("a", [1.0])])
    with pytest.raises(ValueError, match="expected 1 numbers"):
        Plot("t", "x", "y", [1.0], [Series("a", [1.0])], names=["one", "two"])


def test_radii_are_shown_densely_near_the_centre_and_in_ratios_farther_out() -> None:
    radii = [float(radius) for radius in range(1500)]
    shown = [radii[at] for at in shown_radii(radii)]
    assert shown[: int(FINE_TO_PX) + 1] == radii[: int(FINE_TO_PX) + 1] and shown[-1] == radii[-1]
    far = [radius for radius in shown[:-1] if radius > FINE_TO_PX]
    assert all(b / a >= RATIO for a, b in pairwise(far)) and len(shown) < 150
    assert shown_radii([]) == []


def test_numbers_are_written_so_that_a_script_reads_them(subtests: pytest.Subtests) -> None:
    for value, text in ((None, ""), (float("nan"), ""), (0.0, "0"), (1234567.0, "1.2346e+06")):
        with subtests.test(str((value, text))):
            assert written(value) == text
