"""The colours of EUV images: black, deep gold, yellow, white, as images at 174 angstrom are often shown.

heliopsf defines its own colour map. The lightness (CIELAB L*) increases from level to level, so brighter pixels never
look darker.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Control points: a position in the range (0 to 1), and its colour. Between them, colours are interpolated linearly in
# sRGB.
EUV_POINTS = (
    (0.0, "#000000"),
    (0.18, "#2e1500"),
    (0.40, "#7d4400"),
    (0.62, "#c98612"),
    (0.82, "#f3c34d"),
    (1.0, "#fffbe8"),
)
NO_DATA = "#3a4a5a"  # a blue grey, which the map does not contain


def rgb(colour: str) -> tuple[int, int, int]:
    """Red, green and blue (0 to 255) of a colour #rrggbb."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue


def euv_levels(count: int = 256) -> NDArray[np.uint8]:
    """The map as ``count`` levels of equal steps, shape (count, 3): red, green and blue, 0 to 255."""
    shares = [share for share, _ in EUV_POINTS]
    colours = np.array([rgb(colour) for _, colour in EUV_POINTS], dtype=np.float64)
    at = np.linspace(0.0, 1.0, count)
    levels = np.stack([np.interp(at, shares, channel) for channel in colours.T], axis=1)
    return np.round(levels).astype(np.uint8)
