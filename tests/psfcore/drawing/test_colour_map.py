"""The colours of EUV images."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.drawing.colour_map import EUV_POINTS, NO_DATA, euv_levels, rgb
from psfcore.drawing.plots import GOLD


def lightness(levels: np.ndarray) -> np.ndarray:
    """CIELAB L* (D65) of sRGB levels 0 to 255, shape (n, 3): IEC 61966-2-1, CIE 15."""
    share = levels / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    y = linear @ np.array([0.2126, 0.7152, 0.0722])
    return np.where(y > (6 / 29) ** 3, 116 * np.cbrt(y) - 16, y * (29 / 3) ** 3)


def test_lightness_of_white_and_grey() -> None:
    assert lightness(np.array([[255, 255, 255], [119, 119, 119], [0, 0, 0]])) == pytest.approx(
        [100.0, 50.0, 0.0], abs=0.1
    )


@pytest.mark.parametrize("count", [256, 255])
def test_a_brighter_level_is_lighter(count: int) -> None:
    levels = euv_levels(count)
    assert levels.shape == (count, 3) and levels.dtype == np.uint8
    assert np.diff(lightness(levels)).min() > 0
    assert lightness(levels)[[0, -1]] == pytest.approx([0, 99], abs=1)


def test_the_levels_pass_through_the_control_points_and_are_the_map_of_the_plots() -> None:
    levels = euv_levels(1001)
    assert [tuple(levels[round(share * 1000)]) for share, _ in EUV_POINTS] == [
        rgb(colour) for _, colour in EUV_POINTS
    ]
    drawn = GOLD(np.arange(256), bytes=True)[:, :3].astype(int)
    assert np.abs(drawn - euv_levels()).max() <= 1  # Matplotlib rounds otherwise


def test_no_level_looks_like_a_pixel_without_data() -> None:
    red, _, blue = rgb(NO_DATA)
    assert blue > red and (euv_levels()[:, 0] >= euv_levels()[:, 2]).all()
