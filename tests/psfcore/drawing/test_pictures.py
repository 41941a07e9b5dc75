"""Colours, units, small pictures and plots show what the pixels hold, for any shape."""

from __future__ import annotations

import dataclasses
import re
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from matplotlib.figure import Figure
from matplotlib.image import imread

from psfcore.drawing import plots, thumbnail
from psfcore.drawing.plots import GOLD, curves_of, preview_png, psf_figure, psf_png, write_png
from psfcore.drawing.thumbnail import (
    DECADES,
    EUV_POINTS,
    NO_DATA,
    SOFTENING,
    euv_levels,
    levels_of,
    png_of_weights,
    reduced,
    rgb,
    write_thumbnail,
)
from psfcore.fits.units import rate_label, unit_label
from psfcore.image import Image
from tests.psfcore.conftest import gaussian, make_psf

# --- colours ---------------------------------------------------------------------------------------------


def lightness(levels: np.ndarray) -> np.ndarray:
    """CIELAB L* (D65) of sRGB levels 0 to 255, shape (n, 3): IEC 61966-2-1, CIE 15."""
    share = levels / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    y = linear @ np.array([0.2126, 0.7152, 0.0722])
    return np.where(y > (6 / 29) ** 3, 116 * np.cbrt(y) - 16, y * (29 / 3) ** 3)


def test_a_brighter_level_is_lighter_and_all_are_those_of_the_plots() -> None:
    white_grey_black = np.array([[255, 255, 255], [119, 119, 119], [0, 0, 0]])
    assert lightness(white_grey_black) == pytest.approx([100.0, 50.0, 0.0], abs=0.1)
    for count in (256, 255):
        levels = euv_levels(count)
        assert levels.shape == (count, 3) and levels.dtype == np.uint8
        assert np.diff(lightness(levels)).min() > 0
        assert lightness(levels)[[0, -1]] == pytest.approx([0, 99], abs=1)
    red, _, blue = rgb(NO_DATA)
    assert blue > red and (euv_levels()[:, 0] >= euv_levels()[:, 2]).all()
    levels = euv_levels(1001)
    assert [tuple(levels[round(share * 1000)]) for share, _ in EUV_POINTS] == [
        rgb(colour) for _, colour in EUV_POINTS
    ]
    drawn = GOLD(np.arange(256), bytes=True)[:, :3].astype(int)
    assert np.abs(drawn - euv_levels()).max() <= 1  # Matplotlib rounds otherwise


# --- units -----------------------------------------------------------------------------------------------


def test_the_label_is_the_unit_of_the_header() -> None:
    cases: list[tuple[str | None, float | None, dict[str, str], str, str]] = [
        ("DN/s", 2.0, {}, "DN/s", "DN/s"),
        ("DN", 2.000096, {}, "DN in 2 s", "DN/s"),
        ("DN", None, {}, "DN, exposure unknown", "DN/s"),
        (None, 2.0, {"PIXLUNIT": "DN"}, "DN in 2 s", "DN/s"),
        (None, 2.0, {}, "unit unknown", "unit unknown, per s"),
        ("counts", 0.5, {}, "counts in 0.5 s", "counts/s"),
        ("W m-2 sr-1", 2.0, {}, "W m-2 sr-1", "W m-2 sr-1"),
        (r"$\frac{$", 2.0, {}, r"\frac{", r"\frac{"),
        ("$", 2.0, {}, "unit unknown", "unit unknown, per s"),
    ]
    for unit, exposure_s, cards, label, rate in cases:
        image = Image(np.ones((16, 16)), np.zeros((16, 16), np.uint8), fits.Header(cards), unit, exposure_s)
        assert (unit_label(image), rate_label(image)) == (label, rate)


# --- small pictures --------------------------------------------------------------------------------------


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


def test_pixels_are_means_of_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thumbnail, "LONGER_SIDE_PX", 24)  # the slow means take seconds for 192 px
    for shape, small, dtype in (
        ((210, 170), (24, 19), np.float32),
        ((61, 400), (4, 24), np.float64),
        ((23, 16), (23, 16), np.float32),
    ):
        pixels = np.random.default_rng(1).gamma(2.0, 50.0, shape).astype(dtype)
        np.testing.assert_allclose(reduced(pixels), slow_means(pixels, small), rtol=1e-5)
        pixels[3:20, 5:25] = pixels[22, ::7] = np.nan
        np.testing.assert_allclose(reduced(pixels), slow_means(pixels, small), rtol=1e-5)
    assert reduced(np.ones((2, 5000))).shape == (1, 24), "a very long image keeps a row"


def test_the_stretch_is_asinh_and_logarithmic_for_the_weights_of_a_psf(tmp_path: Path) -> None:
    pixels = np.linspace(-10.0, 100.0, 10_001).reshape(73, 137)
    levels = levels_of(pixels).astype(int)
    top = np.percentile(pixels, 99.7)
    expected = 254 * np.arcsinh(np.clip(pixels / top, 0, 1) / SOFTENING) / np.arcsinh(1 / SOFTENING)
    assert np.abs(levels - expected).max() <= 0.5
    assert levels.min() == 0 and levels.max() == 254
    for value in (0.0, -3.0):
        assert not levels_of(np.full((5, 4), value)).any(), "an image without light is black"
    weights = np.array([[0.1, 0.1 * 10 ** (-DECADES / 2)], [0.0, -1.0]])
    (tmp_path / "psf.png").write_bytes(png_of_weights(weights))
    picture = np.round(imread(tmp_path / "psf.png")[::-1, :, :3] * 255)
    levels = euv_levels(255)
    assert (picture[0] == [levels[-1], levels[127]]).all() and (picture[1] == levels[0]).all()
    assert png_of_weights(np.zeros((2, 2))), "no weight is no error"


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
    write_thumbnail(pixels, tmp_path / "again.png")
    assert (tmp_path / "again.png").read_bytes() == path.read_bytes()
    write_thumbnail(np.full((300, 300), np.nan), path)
    picture = np.round(imread(path)[..., :3] * 255)
    assert picture.shape == (192, 192, 3) and (picture == rgb(NO_DATA)).all()


# --- plots -----------------------------------------------------------------------------------------------


def colour_at(path: Path, x: float, y: float) -> np.ndarray:
    """Colour of a PNG at a fraction of its width and, from the top, of its height."""
    picture = imread(path)
    return np.asarray(picture[int(y * picture.shape[0]), int(x * picture.shape[1]), :3])


def test_the_panels_before_after_and_of_the_change(tmp_path: Path) -> None:
    before = np.full((128, 128), 100.0)
    after = before.copy()
    after[:, :64] = 180.0
    after[:, 64:] = 20.0
    preview_png(before, after, tmp_path / "p.png", title="halves", unit="DN")
    gained, lost = (colour_at(tmp_path / "p.png", x, 0.5) for x in (0.72, 0.90))
    assert gained[0] > 0.6 > gained[2]
    assert lost[2] > lost[0]
    plane = np.random.default_rng(0).random((64, 64)) + 1
    preview_png(plane, plane, tmp_path / "p.png", title="same", unit="DN")
    left, right = (colour_at(tmp_path / "p.png", x, 0.5) for x in (0.1, 0.1 + 0.318))
    np.testing.assert_allclose(left, right, atol=0.02)
    for shape in ((16, 16), (33, 900)):
        before = np.ones(shape)
        before[0, 0], before[1, 1] = np.nan, -4.0
        preview_png(before, np.full(shape, np.nan), tmp_path / "p.png", title="holes", unit="DN")
        assert imread(tmp_path / "p.png").shape[1] == 1560


def test_pictures_are_drawn_without_pyplot_and_names_with_dollar_signs_as_they_are(tmp_path: Path) -> None:
    """The name raises an error where Matplotlib reads it as a formula."""
    sys.modules.pop("matplotlib.pyplot", None)
    name, plane = "$\\frac{$ and $\\nothing$", np.arange(64.0 * 64).reshape(64, 64)
    preview_png(plane, plane * 1.1, tmp_path / "p.png", title=name, unit=name)
    assert imread(tmp_path / "p.png").shape[1] == 1560
    parts = {"SCATTER": gaussian(64, 5.0), "AIRY": gaussian(64, 1.0), "A_NAME_OF_ITS_OWN": gaussian(64, 3.0)}
    psf = dataclasses.replace(make_psf(0.9 * gaussian(64, 2.0), components=parts), name=name, version=name)
    psf_png(psf, tmp_path / "psf.png")
    assert imread(tmp_path / "psf.png").std() > 0.05
    assert "matplotlib.pyplot" not in sys.modules


def test_the_numbers_of_a_logarithmic_axis_stay_powers(tmp_path: Path) -> None:
    figure = Figure()
    axes = figure.subplots()
    axes.loglog([1, 1000], [1, 1000])
    axes.set_title("$x$")
    write_png(figure, tmp_path / "p.png")
    assert axes.xaxis.get_major_ticks()[0].label1.get_parse_math()
    assert not axes.title.get_parse_math()


def test_every_picture_is_written_by_the_function_that_draws_names_as_they_are() -> None:
    here = Path(plots.__file__)
    package = here.parents[1]
    wrong = [
        path.name
        for path in package.rglob("*.py")
        if path != here and re.search(r"print_png|savefig|FigureCanvasAgg", path.read_text("utf-8"))
    ]
    assert wrong == []


def test_curves_that_coincide_are_drawn_once_and_named_together() -> None:
    weights, wide = gaussian(33, 1.5), gaussian(33, 4.0)
    psf = dataclasses.replace(
        make_psf(weights), components={"ENTRANCE_MESH": wide, "ENTRANCE": wide.copy(), "DIFFRACTION": weights}
    )
    assert list(curves_of(psf)) == [("ENTRANCE_MESH", "ENTRANCE"), ("TOTAL", "DIFFRACTION")]
    figure = psf_figure(psf)
    named = {text.get_text() for text in figure.legends[0].get_texts()}
    assert named == {"Total, diffraction", "Entrance mesh, entrance"}
    assert [len(axes.lines) for axes in figure.axes[1:3]] == [2, 2]
