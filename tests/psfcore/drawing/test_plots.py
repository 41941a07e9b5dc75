"""Previews and PSF plots show what their pixels hold, for any shape, and quickly."""

from __future__ import annotations

import dataclasses
import re
import sys
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from matplotlib.figure import Figure

from psfcore.drawing import plots
from psfcore.drawing.plots import preview_png, psf_png, write_png
from tests.psfcore.conftest import gaussian, make_psf


def colour_at(path: Path, x: float, y: float) -> np.ndarray:
    """Colour of a PNG at a fraction of its width and, from the top, of its height."""
    picture = matplotlib.image.imread(path)
    return np.asarray(picture[int(y * picture.shape[0]), int(x * picture.shape[1]), :3])


def test_the_change_panel_is_red_for_more_light_and_blue_for_less(tmp_path: Path) -> None:
    before = np.full((128, 128), 100.0)
    after = before.copy()
    after[:, :64] = 180.0
    after[:, 64:] = 20.0
    preview_png(before, after, tmp_path / "p.png", title="halves", unit="DN")
    gained, lost = (colour_at(tmp_path / "p.png", x, 0.5) for x in (0.72, 0.90))
    assert gained[0] > 0.6 > gained[2]
    assert lost[2] > lost[0]


def test_before_and_after_use_the_same_stretch(tmp_path: Path) -> None:
    plane = np.random.default_rng(0).random((64, 64)) + 1
    preview_png(plane, plane, tmp_path / "p.png", title="same", unit="DN")
    left, right = (colour_at(tmp_path / "p.png", x, 0.5) for x in (0.1, 0.1 + 0.318))
    np.testing.assert_allclose(left, right, atol=0.02)


@pytest.mark.parametrize("shape", [(16, 16), (700, 701), (33, 900)])
def test_any_shape_and_missing_pixels_are_drawn(tmp_path: Path, shape: tuple[int, int]) -> None:
    before = np.ones(shape)
    before[0, 0], before[1, 1] = np.nan, -4.0
    preview_png(before, np.full(shape, np.nan), tmp_path / "p.png", title="holes", unit="DN")
    assert matplotlib.image.imread(tmp_path / "p.png").shape[1] == 1560


def test_a_full_image_is_drawn(tmp_path: Path) -> None:
    plane = np.random.default_rng(0).random((2048, 2048)) * 1000
    preview_png(plane, plane * 1.1, tmp_path / "p.png", title="full", unit="DN")
    assert matplotlib.image.imread(tmp_path / "p.png").shape[1] == 1560


def test_a_psf_is_drawn_without_pyplot(tmp_path: Path) -> None:
    parts = {"SCATTER": gaussian(64, 5.0), "AIRY": gaussian(64, 1.0), "A_NAME_OF_ITS_OWN": gaussian(64, 3.0)}
    psf = make_psf(0.9 * gaussian(64, 2.0), components=parts)
    sys.modules.pop("matplotlib.pyplot", None)
    psf_png(psf, tmp_path / "psf.png")
    assert matplotlib.image.imread(tmp_path / "psf.png").std() > 0.05
    assert "matplotlib.pyplot" not in sys.modules


@pytest.mark.parametrize("name", ["$\\frac{$", "$a$ and $\\nothing$", "100 $", "\\$", "$" * 9])
def test_names_with_dollar_signs_are_drawn_as_they_are(tmp_path: Path, name: str) -> None:
    plane = np.arange(64.0 * 64).reshape(64, 64)
    preview_png(plane, plane * 1.1, tmp_path / "p.png", title=name, unit=name)
    assert matplotlib.image.imread(tmp_path / "p.png").shape[1] == 1560
    psf = dataclasses.replace(make_psf(gaussian(64, 2.0)), name=name, version=name)
    psf_png(psf, tmp_path / "psf.png")
    assert matplotlib.image.imread(tmp_path / "psf.png").std() > 0.05


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
