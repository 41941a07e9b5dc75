"""Plots are methods: they take axes of matplotlib, or make new ones, and return them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

import heliopsf
from tests.conftest import write_image


@pytest.fixture(autouse=True)
def _no_windows() -> Iterator[None]:
    matplotlib.use("agg")
    yield
    from matplotlib import pyplot

    pyplot.close("all")


def test_a_psf_is_drawn_on_given_axes(psf: heliopsf.Psf) -> None:
    left, right = Figure().subplots(1, 2)
    assert psf.plot(left, size=33) is left and psf.plot_curve(right) is right
    np.testing.assert_array_equal(left.images[0].get_array(), psf.kernel[16:49, 16:49])
    radii, light = right.lines[0].get_data()
    np.testing.assert_allclose(light, psf.light_beyond(radii))


def test_new_axes_are_made_without_any(psf: heliopsf.Psf) -> None:
    assert psf.plot() is not psf.plot()
    assert psf.version in psf.plot_curve().get_title()


def test_a_deconvolution_is_drawn(psf: heliopsf.Psf, tmp_path: Path) -> None:
    write_image(tmp_path / "image.fits", WAVELNTH=171, CDELT1=2.0, CDELT2=2.0)
    result = heliopsf.deconvolve(tmp_path / "image.fits", psf)
    before, after = Figure().subplots(1, 2)
    assert result.plot(before) is before and result.plot_change(after) is after
    np.testing.assert_array_equal(before.images[0].get_array(), result.pixels)
    change = 100 * (result.pixels / result.image.pixels - 1)
    np.testing.assert_allclose(after.images[0].get_array(), change)
    assert [axes.get_title(loc="left")[:6] for axes in result.quicklook().axes[:3:2]] == ["Before", "After "]
    assert result.changes["pixels"] > 0


def test_quicklooks_are_figures_that_can_be_saved(psf: heliopsf.Psf, tmp_path: Path) -> None:
    psf.quicklook().savefig(tmp_path / "psf.png")
    assert (tmp_path / "psf.png").read_bytes().startswith(b"\x89PNG")
