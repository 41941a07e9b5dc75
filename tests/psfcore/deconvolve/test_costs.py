"""The memory of a deconvolution follows from the size of the image, and not from what the image shows."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from psfcore.deconvolve.assess.changes import measure_changes
from psfcore.deconvolve.doubts import input_warnings
from psfcore.deconvolve.methods.registry import method_names
from psfcore.deconvolve.run import Product, deconvolve
from psfcore.deconvolve.work import Options
from psfcore.fits.saturation import with_saturation
from psfcore.fits.unusable import unusable_pixels
from psfcore.image import Image
from psfcore.noise import Noise
from tests.image_contents import CONTENTS, Plane, sun
from tests.psfcore.conftest import make_image
from tests.psfcore.deconvolve.scattering import scattering_psf

SIZE_PX = 384
# Times the memory of an image of the Sun. A method needs one plane more if pixels are masked. The comparison needs the
# most memory of a command, so that the peak of the command does not grow.
MOST = {"deconvolution": 1.25, "comparison": 1.1}


@pytest.fixture(autouse=True)
def traced() -> Iterator[None]:
    tracemalloc.start()
    yield
    tracemalloc.stop()


@contextmanager
def peak(peaks: dict[str, float], stage: str) -> Iterator[None]:
    """Note the most memory that arrays need in a block, in bytes for each pixel of the image."""
    before = tracemalloc.get_traced_memory()[0]
    tracemalloc.reset_peak()
    yield
    peaks[stage] = (tracemalloc.get_traced_memory()[1] - before) / SIZE_PX**2


def product_of(pixels: Plane, method: str, noise: Noise | None = None) -> Product:
    """Deconvolve an image as a command does: with its mask, its saturated pixels and its warnings."""
    psf = scattering_psf()
    image = make_image(pixels)
    mask, _ = unusable_pixels(pixels, image.header, None, {})
    image = with_saturation(Image(pixels, mask, image.header, image.unit, image.exposure_s))
    options = Options(method=method, noise=noise, parameters={"steps": 2}, threads=1)
    return deconvolve(image, psf, options, warnings=input_warnings(psf, image, method, channel=None))


def check(measure: Callable[[Plane], dict[str, float]]) -> None:
    """Compare the peaks of every content with those of an image of the Sun."""
    measure(CONTENTS["blocks of 32 px"](SIZE_PX))  # compiles, and loads libraries
    usual = measure(sun(SIZE_PX))
    for name, content in CONTENTS.items():
        for stage, needed in measure(content(SIZE_PX)).items():
            assert needed <= MOST[stage] * usual[stage], (
                f"{name}, {stage}: {needed:.0f}, not {usual[stage]:.0f}"
            )


@pytest.mark.parametrize("method", method_names())
def test_a_method_needs_the_same_memory_for_every_content(method: str) -> None:
    def measure(pixels: Plane) -> dict[str, float]:
        peaks: dict[str, float] = {}
        with peak(peaks, "deconvolution"):
            product_of(pixels, method)
        return peaks

    check(measure)


@pytest.mark.parametrize("noise", [None, Noise(6.0, 2.0)], ids=["unknown noise", "known noise"])
def test_the_comparison_needs_the_same_memory_for_every_content(noise: Noise | None) -> None:
    def measure(pixels: Plane) -> dict[str, float]:
        peaks: dict[str, float] = {}
        product = product_of(pixels, "richardson-lucy", noise)
        with peak(peaks, "comparison"):
            assert product.assessed.quality.shape == pixels.shape
            product.details()
        return peaks

    check(measure)


def test_all_pixels_may_show_a_sign_of_an_artefact() -> None:
    """A result without light has a hole in every bright pixel, and one that is far too bright an overshoot."""
    image = make_image(sun(SIZE_PX) + 1000)
    peaks: dict[str, float] = {}
    for name, factor in (("usual", 1.0), ("usual", 1.0), ("holes", 0.0), ("overshoots", 1000.0)):
        with peak(peaks, name):
            changes = measure_changes(image, factor * image.pixels, scattering_psf(), threads=1)
        if factor != 1:
            assert np.count_nonzero(changes.artefacts.suspected) > 0.9 * SIZE_PX**2
        assert peaks[name] <= MOST["comparison"] * peaks["usual"], peaks
