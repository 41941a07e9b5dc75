"""PSFs that are much larger than the image: read in pieces, cut by the convolution, and the light that is cut off is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits

from psfcore.deconvolve.doubts import input_warnings
from psfcore.deconvolve.run import deconvolve
from psfcore.deconvolve.work import Options
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.psfs import read_psf
from psfcore.image import Image
from psfcore.psf import Psf, crop_centred, squared_radii
from psfcore.psf_sampling import rebinned

SIZE_PX, IMAGE_PX, STEPS = 2112, 64, {"steps": 5}


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Psf:
    """A PSF of doubles whose file is longer than the pieces in which it is read."""
    squares = squared_radii((SIZE_PX, SIZE_PX))
    core, tail = np.exp(-squares / 2), (1.0 + squares) ** -0.75
    kernel = 0.9 * core / core.sum() + 0.1 * tail / tail.sum()
    file = tmp_path_factory.mktemp("large") / "psf.fits"
    fits.PrimaryHDU(kernel).writeto(file)
    psf = read_psf(file, FitsLimits(max_pixels=SIZE_PX**2))
    assert np.array_equal(psf.kernel, kernel)
    return psf


def test_the_light_that_is_cut_off_is_told_and_the_result_is_that_of_the_cut_psf(large: Psf) -> None:
    pixels = np.random.default_rng(1).uniform(50, 100, (IMAGE_PX, IMAGE_PX))
    image = Image(pixels, np.zeros(pixels.shape, np.uint8), fits.Header(), "DN", None)
    needed = crop_centred(large.kernel, (2 * IMAGE_PX - 1,) * 2)
    cut = replace(large, kernel=needed)
    warned = input_warnings(large, image, "richardson-lucy", other_channel=True)
    assert f"needs 127 x 127 px: {100 * (1 - needed.sum()):.3g} % of its light" in warned["psf-cut"]
    assert "psf-cut" not in input_warnings(cut, image, "richardson-lucy", other_channel=True)
    options = Options(parameters=STEPS, margin_px=16)
    whole, same = (deconvolve(image, psf, options, warnings={}) for psf in (large, cut))
    np.testing.assert_allclose(whole.pixels, same.pixels, rtol=1e-6)
    assert np.abs(whole.pixels / pixels - 1).max() > 0.05


def test_rebinning_keeps_the_light_of_a_psf_that_sums_to_1_beyond_the_reach(large: Psf) -> None:
    assert rebinned(large, 4).total == pytest.approx(1, abs=1e-12)
    within = crop_centred(large.kernel, (2048, 2048)).sum()
    assert within < 0.999
    by_reach = replace(large, kernel=large.kernel / within)
    assert rebinned(by_reach, 4).total == pytest.approx(1, abs=1e-12), (
        "the light beyond the reach is left out"
    )
