"""Plots: their tables hold the numbers from which a script draws the curves; and readings of stored reports."""

from __future__ import annotations

from itertools import pairwise

import pytest

from service.pages.plots import (
    ABOVE,
    BELOW,
    FINE_TO_PX,
    MAP_PX,
    RATIO,
    Plot,
    Series,
    gap_map,
    rerun_makers,
    shown_radii,
    with_errors,
    written,
)


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
    with pytest.raises(ValueError, match="longer than"):
        _ = Plot("t", "x", "y", [1.0, 2.0], [Series("a", [1.0])], names=["one"]).rows


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


def image(number: int, residual: float | None, after: float | None = None) -> dict[str, object]:
    return {
        "file": f"{number:03d}.fits",
        "fov": 1,
        "x_px": 10.0 * number,
        "y_px": 20.0,
        "time_s": 100.0 - number,
        "residual_pct": residual,
        "noise_pct": None if residual is None else 0.5,
        "residual_after_pct": after,
        "noise_after_pct": None if after is None else 0.25,
    }


def test_discs_have_their_places_colours_and_rows() -> None:
    found = gap_map({"shape": [100, 200], "images": [image(1, 4.0, 1.0), image(2, -4.0), image(3, None)]})
    assert found is not None and (found.width, found.height, found.largest) == (MAP_PX, MAP_PX / 2, 4.0)
    late, early = found.discs  # in the order of time
    assert (late.name, late.row, late.x, late.y) == ("002.fits, pointing 1", 0, 40.0, 160.0)
    assert early.told == "001.fits, pointing 1: +4.00 ± 0.50 %"
    assert [disc.colour for disc in found.discs] == ["#" + bytes(BELOW).hex(), "#" + bytes(ABOVE).hex()]
    fitted, after = found.residuals.series
    assert (fitted.values, fitted.low, fitted.high) == ([-4.0, 4.0], [-4.5, 3.5], [-3.5, 4.5])
    assert (after.values, after.low) == ([None, 1.0], [None, 0.75])
    assert list(found.residuals.x) == [98.0, 99.0]


def test_without_held_out_images_there_is_no_map(subtests: pytest.Subtests) -> None:
    for images in ([], [image(1, None)]):
        with subtests.test(str(images)):
            assert gap_map({"shape": [64, 64], "images": images}) is None


def test_only_what_differs_between_two_runs_is_listed() -> None:
    first = {"created_at": 1.0, "name": "a", "libraries": {"numpy": "1", "scipy": "2"}}
    again = {"created_at": 2.0, "name": "a", "libraries": {"numpy": "3", "scipy": "2"}, "id": "x"}
    assert rerun_makers({"first": first, "again": again}) == [("library numpy", "1", "3")]
