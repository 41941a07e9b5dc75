"""Richardson-Lucy by itself: its flux, saturated cores, negative pixels, a real image, and PSFs much larger than the
image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray

from psfcore.convolution.engine import PERIODIC, Engine
from psfcore.deconvolve.doubts import input_warnings
from psfcore.deconvolve.edges import light_across
from psfcore.deconvolve.run import deconvolve
from psfcore.deconvolve.work import Options
from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.observation import read_observation
from psfcore.fits.psfs import read_psf
from psfcore.image import Image, MaskBit
from psfcore.psf import Psf, crop_centred, squared_radii
from psfcore.psf_sampling import rebinned
from psfcore.simulate.scene import observe, solar_scene
from tests.psfcore.conftest import LIMITS, gaussian, make_image, make_psf
from tests.psfcore.deconvolve.scattering import richardson_lucy, scattering_psf

PSF = scattering_psf(core_px=0.4)
SIZE_PX, IMAGE_PX, STEPS = 2112, 64, {"steps": 5}


def look(scene: NDArray[np.float64], *, noisy: bool = True) -> NDArray[np.float64]:
    gain, read = (6.0, 2.0) if noisy else (0.0, 0.0)
    return observe(scene, PSF, exposure_s=1.4, photon_gain_dn=gain, read_noise_dn=read, seed=1)


def test_flux_is_kept_and_negative_pixels_count_as_dark() -> None:
    observed = look(solar_scene((192, 160), 4))
    for scale in (1.0, 1e-6, 1e9):
        result = richardson_lucy(make_image(scale * observed), PSF, steps=20)
        assert result.pixels.sum() == pytest.approx(scale * np.maximum(observed, 0).sum(), rel=1e-5)
        assert result.flux_out == pytest.approx(result.flux_in, rel=1e-5)
        assert result.steps_done == 20 and "20 steps" in result.stopped_because
    pixels = np.full((64, 64), 10.0)
    pixels[5, 5:9] = -3.0
    result = richardson_lucy(make_image(pixels), PSF, steps=5)
    assert result.negative_pixels == 4
    assert (result.pixels >= 0).all()
    assert result.flux_in == pytest.approx(10.0 * (64 * 64 - 4) - 3.0 * 4)


def test_a_saturated_core_is_estimated_from_its_surroundings() -> None:
    scene = np.full((128, 128), 100.0)
    scene[63:66, 63:66] = 40000.0
    observed = look(scene, noisy=False)
    level = 15000.0
    mask = np.where(observed >= level, int(MaskBit.SATURATED), 0).astype(np.uint8)
    assert mask.any()
    clipped = make_image(np.minimum(observed, level), mask)
    # A masked core must not fade while the rest converges. In the end its scattered light determines its size.
    early, late = (richardson_lucy(clipped, PSF, steps=n).pixels[63:66, 63:66].sum() for n in (5, 300))
    assert early > 0.95 * 9 * level
    assert late == pytest.approx(9 * 40000.0, rel=0.2)


def test_progress_reports_steps_and_its_exceptions_pass_through() -> None:
    class Cancelled(Exception):
        pass

    told: list[tuple[int, int]] = []

    def progress(step: int, steps: int) -> None:
        told.append((step, steps))
        if step == 3:
            raise Cancelled

    with pytest.raises(Cancelled):
        richardson_lucy(
            make_image(np.ones((32, 32))), make_psf(gaussian(16, 2.0)), steps=9, progress=progress
        )
    assert told == [(1, 9), (2, 9), (3, 9)]


def test_on_a_real_image_bright_rises_and_dark_falls(real: Callable[[str], Path]) -> None:
    """The paper: bright features rise by up to 40 %, dark regions fall by up to 85 %. The test uses a part of the
    image, and means of 8 x 8 px, so that pixel noise does not count as structure."""
    whole = read_observation(real("eui/derived_hrieuv174_20220401T103005920_pseudolinear.fits"), LIMITS)
    part = np.s_[512:1536, 512:1536]
    image = Image(whole.pixels[part], whole.mask[part], whole.header, whole.unit, whole.exposure_s)
    result = richardson_lucy(image, scattering_psf(1024, 0.4), steps=20, threads=2)
    before, after = (
        plane.reshape(128, 8, 128, 8).mean(axis=(1, 3)) for plane in (image.pixels, result.pixels)
    )
    change_pct = 100 * (after / before - 1)
    bright = change_pct[before > np.percentile(before, 99)]
    dark = change_pct[before < np.percentile(before, 20)]
    assert np.median(bright) > 8
    assert 25 < np.percentile(bright, 99) < 60
    assert np.median(dark) < -5
    assert -95 < np.percentile(dark, 0.1) < -30


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
    warned = input_warnings(large, image, "richardson-lucy", channel=None)
    assert f"needs 127 x 127 px: {100 * (1 - needed.sum()):.3g} % of its light" in warned["psf-cut"]
    assert "psf-cut" not in input_warnings(cut, image, "richardson-lucy", channel=None)
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


def test_periodic_edges_are_those_of_a_transform_of_the_size_of_the_image() -> None:
    """The steps with the transforms of numpy, on an image whose sides have different factors."""
    pixels = solar_scene((80, 144), 3)
    pixels[:, :8] += 500
    psf = scattering_psf(72, 1.0)
    wrapped = np.zeros(pixels.shape)
    for (y, x), weight in np.ndenumerate(psf.kernel):
        wrapped[y - 36, x - 36] += weight
    transfer, expected = np.fft.rfft2(wrapped), pixels
    for _ in range(10):
        model = np.fft.irfft2(np.fft.rfft2(expected) * transfer, s=pixels.shape)
        expected = expected * np.fft.irfft2(np.fft.rfft2(pixels / model) * transfer.conj(), s=pixels.shape)
    result = richardson_lucy(make_image(pixels), psf, steps=10, edges="periodic")
    np.testing.assert_allclose(result.pixels, expected, atol=1e-6 * expected.max())
    assert (result.margin_px, result.edges) == (0, "periodic")


def test_the_light_that_periodic_edges_bring_across_is_told() -> None:
    pixels = np.random.default_rng(1).uniform(50, 100, (IMAGE_PX, IMAGE_PX))
    pixels[:, :3] += 300
    psf = scattering_psf(IMAGE_PX, 1.0)
    across = light_across(make_image(pixels), psf)
    alone, periodic = (
        Engine(psf.kernel, pixels.shape, span=span).apply(pixels) for span in (pixels.shape, PERIODIC)
    )
    assert 0.4 * across < (periodic - alone).max() < across
    warned = input_warnings(psf, make_image(pixels), "linear", channel=None, edges="periodic")
    assert f"at most {100 * across / pixels.mean():.3g} %" in warned["periodic"]
    with pytest.raises(DataError, match="periodic-size"):
        richardson_lucy(make_image(pixels[:50]), psf, steps=1, edges="periodic")
