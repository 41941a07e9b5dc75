"""Small pictures of images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from psfcore.drawing.colour_map import NO_DATA, euv_levels, rgb
from psfcore.drawing.thumbnail import SOFTENING, levels_of, reduced, write_thumbnail


def slow_means(pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Block after block: the first row and column of block n is the whole part of n * side / count."""
    edges = [
        [n * side // count for n in range(count + 1)] for side, count in zip(pixels.shape, shape, strict=True)
    ]
    out = np.full(shape, np.nan)
    for y in range(shape[0]):
        for x in range(shape[1]):
            block = pixels[edges[0][y] : edges[0][y + 1], edges[1][x] : edges[1][x + 1]]
            if np.isfinite(block).any():
                out[y, x] = np.nanmean(block)
    return out


@pytest.mark.parametrize(
    ("shape", "small"), [((500, 400), (192, 154)), ((301, 1000), (58, 192)), ((40, 30), (40, 30))]
)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("with_nan", [False, True])
def test_pixels_are_means_of_blocks(
    shape: tuple[int, int], small: tuple[int, int], dtype: type, with_nan: bool
) -> None:
    pixels = np.random.default_rng(1).gamma(2.0, 50.0, shape).astype(dtype)
    if with_nan:
        pixels[3:20, 5:25] = np.nan
        pixels[30, ::7] = np.inf
        pixels[np.isinf(pixels)] = np.nan
    np.testing.assert_allclose(reduced(pixels), slow_means(pixels, small), rtol=1e-5)


def test_a_very_long_image_keeps_a_row() -> None:
    assert reduced(np.ones((2, 5000))).shape == (1, 192)


def test_the_stretch_is_asinh() -> None:
    pixels = np.linspace(-10.0, 100.0, 10_001).reshape(73, 137)
    levels = levels_of(pixels).astype(int)
    top = np.percentile(pixels, 99.7)
    expected = 254 * np.arcsinh(np.clip(pixels / top, 0, 1) / SOFTENING) / np.arcsinh(1 / SOFTENING)
    assert np.abs(levels - expected).max() <= 0.5
    assert levels.min() == 0 and levels.max() == 254


@pytest.mark.parametrize("value", [0.0, -3.0])
def test_an_image_without_light_is_black(value: float) -> None:
    assert not levels_of(np.full((5, 4), value)).any()


def test_the_picture_has_row_0_at_the_bottom_and_marks_pixels_without_data(tmp_path: Path) -> None:
    pixels = np.zeros((96, 80))
    pixels[0, 0], pixels[95, 79] = 1000.0, np.nan
    pixels[0, 1:9] = 1000.0
    path = tmp_path / "small.png"
    write_thumbnail(pixels, path)
    picture = np.round(imread(path)[..., :3] * 255).astype(np.uint8)
    levels = euv_levels(255)
    assert picture.shape == (96, 80, 3)
    assert (picture[-1, :9] == levels[-1]).all() and (picture[-1, 9:] == levels[0]).all()
    assert tuple(picture[0, 79]) == rgb(NO_DATA) and (picture[0, :79] == levels[0]).all()
    again = tmp_path / "again.png"
    write_thumbnail(pixels, again)
    assert again.read_bytes() == path.read_bytes()


def test_an_image_without_finite_pixels_has_a_picture(tmp_path: Path) -> None:
    write_thumbnail(np.full((300, 300), np.nan), tmp_path / "none.png")
    picture = np.round(imread(tmp_path / "none.png")[..., :3] * 255)
    assert picture.shape == (192, 192, 3) and (picture == rgb(NO_DATA)).all()
