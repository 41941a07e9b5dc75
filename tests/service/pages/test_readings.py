"""Readings of stored reports: the map of a gap report and its plot."""

from __future__ import annotations

import pytest

from service.pages.readings import ABOVE, BELOW, MAP_PX, gap_map, rerun_makers


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
