"""A box that is deconvolved alone, beside the same box of the whole deconvolved image."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from astropy.io.fits import Header
from scipy.ndimage import gaussian_filter

from psfcore.convolution.convolver import Convolver
from psfcore.deconvolve.assess.quality import QualityBit
from psfcore.deconvolve.box import Box
from psfcore.deconvolve.methods.registry import method_names
from psfcore.deconvolve.work import BoxWork, Options, Work, box_work
from psfcore.errors import DataError
from psfcore.image import Image, MaskBit
from psfcore.psf import Psf, squared_radii

BRIGHT, HOLE = Box(150, 190, 60, 110), Box(50, 100, 120, 160)


def spread(size: int, share: float = 0.4) -> Psf:
    """A PSF that scatters `share` of the light far."""
    weights = 1 / (4.0 + np.sqrt(squared_radii((size, size)))) ** 2.2
    weights *= share / weights.sum()
    weights[size // 2, size // 2] += 1 - share
    return Psf(kernel=weights, name="spread", version="1", instrument=None, status="user")


def observed(psf: Psf, ny: int, nx: int, *, seed: int = 0) -> Image:
    """A noisy image with a bright region, a dark hole, and light from beyond its edges."""
    rng = np.random.default_rng(seed)
    far = min(psf.kernel.shape) // 2
    y, x = np.indices((ny + 2 * far, nx + 2 * far)) - far
    scene = 200 * np.exp(0.6 * gaussian_filter(rng.standard_normal(y.shape), 3) * 10)
    scene *= 1 + 15 * np.exp(-((x - 0.7 * nx) ** 2 + (y - 0.4 * ny) ** 2) / (0.08 * nx) ** 2)
    scene[(x - 0.3 * nx) ** 2 + (y - 0.7 * ny) ** 2 < (0.16 * nx) ** 2] *= 0.1
    sharp = Convolver(psf.kernel, scene.shape, dtype=np.float64).apply(scene)[far:-far, far:-far]
    pixels = rng.poisson(np.maximum(sharp, 0)).astype(float)
    header = Header({"CRPIX1": 100.5, "CRPIX2": 90.5, "CRPIX1A": 7, "CDELT1": 0.5, "PXBEG1": 1})
    return Image(pixels, np.zeros(pixels.shape, np.uint8), header, "DN", 1.0)


@pytest.fixture(scope="module")
def psf() -> Psf:
    return spread(128)


@pytest.fixture(scope="module")
def image(psf: Psf) -> Image:
    return observed(psf, 224, 256)


def both(
    image: Image, psf: Psf, method: str, box: Box, *, largest_error: float = 0.1, steps: int = 0, **more: Any
) -> tuple[Any, ...]:
    """The box alone, the same box of the whole image, and the work on the box. steps: 0 for the method's default."""
    parameters = {"steps": steps} if steps else {}
    work = Work(image, psf, Options(method=method, parameters=parameters, region_error=largest_error, **more))
    alone = box_work(work, box)
    return alone.run(), work.run().pixels[box.slices], alone


@pytest.mark.parametrize("method", method_names())
def test_a_box_alone_differs_from_the_whole_image_by_at_most_its_bound(
    image: Image, psf: Psf, method: str
) -> None:
    work = Work(image, psf, Options(method=method, region_error=0.1))
    whole = work.run().pixels
    for box in (BRIGHT, HOLE):
        alone = box_work(work, box)
        result, expected = alone.run(), whole[box.slices]
        assert result.pixels.shape == box.shape and result.of_box is not None
        assert 0 < result.of_box.error <= 0.1 * image.pixels[box.slices].mean()
        assert result.of_box.error_pct == 100 * result.of_box.error / image.pixels[box.slices].mean()
        assert alone.rim.shape != alone.shape, "a part of the image alone was deconvolved"
        assert np.abs(result.pixels - expected).max() <= result.of_box.error
        # Without light from beyond the rim, the box would be wrong: the bound is not met by any result.
        assert np.abs(image.pixels[box.slices] - expected).max() > 2 * result.of_box.error


def test_the_bound_holds_before_convergence_and_at_an_edge(image: Image, psf: Psf) -> None:
    for method, steps in (
        ("richardson-lucy", 1),
        ("linear", 2),
        ("basic-iterative", 1),
        ("richardson-lucy", 60),
    ):
        result, expected, _ = both(image, psf, method, HOLE, largest_error=0.3, steps=steps)
        assert 0 < np.abs(result.pixels - expected).max() <= result.of_box.error, (method, steps)
    inner = np.s_[8:, 8:]  # at the edge itself, the margin of the whole image is deconvolved too
    for method in ("richardson-lucy", "linear"):
        for edges in ("zero", "symmetric"):
            box = Box(0, 60, 0, 50)
            result, expected, _ = both(image, psf, method, box, largest_error=0.3, edges=edges)
            assert np.abs(result.pixels - expected)[inner].max() <= result.of_box.error, (method, edges)
            assert result.edges == edges


def test_an_image_of_coarse_pixels_has_the_same_bound() -> None:
    psf = spread(256)
    image = observed(psf, 1056, 1024)
    box = Box(400, 496, 300, 380)
    result, expected, alone = both(image, psf, "linear", box, largest_error=0.02, threads=2)
    assert alone.rim.shape[0] < 600
    assert np.abs(result.pixels - expected).max() <= result.of_box.error <= 0.02 * expected.mean() * 1.5


def test_a_smaller_error_needs_a_wider_rim_up_to_the_whole_image(image: Image, psf: Psf) -> None:
    rims, errors = [], []
    for largest in (0.5, 0.2, 0.01):
        result, expected, alone = both(image, psf, "linear", HOLE, largest_error=largest)
        rims.append(alone.rim_px)
        errors.append(result.of_box.error)
        assert (
            np.abs(result.pixels - expected).max() <= errors[-1] <= largest * image.pixels[HOLE.slices].mean()
        )
    assert rims[0] < rims[1] < rims[2]
    assert errors[0] > errors[1] > errors[2]
    result, expected, alone = both(image, psf, "richardson-lucy", HOLE, largest_error=1e-9)
    assert alone.rim == Box(0, 256, 0, 224)
    assert result.of_box.error == 0
    np.testing.assert_array_equal(result.pixels, expected)


def test_the_header_of_the_box_has_its_coordinates(image: Image, psf: Psf) -> None:
    alone = box_work(Work(image, psf, Options(method="linear")), BRIGHT)
    header = alone.image.header
    assert (header["CRPIX1"], header["CRPIX2"], header["CRPIX1A"]) == (100.5 - 150, 90.5 - 60, 7 - 150)
    assert "PXBEG1" not in header and header["CDELT1"] == 0.5
    np.testing.assert_array_equal(alone.image.pixels, image.pixels[BRIGHT.slices])


def test_the_quality_of_a_box_is_that_of_its_place_in_the_image(image: Image, psf: Psf) -> None:
    pixels, mask = image.pixels.copy(), image.mask.copy()
    pixels[100, 20], mask[100, 20] = np.nan, MaskBit.NONFINITE
    mask[49, 30] = MaskBit.SATURATED  # one row below the box
    masked = replace(image, pixels=pixels, mask=mask)
    work = Work(masked, psf, Options(method="linear", parameters={"steps": 2}, region_error=0.3))
    whole = work.run()
    box = Box(0, 80, 50, 130)
    alone = box_work(work, box)
    result = alone.run()
    quality = alone.assess(result).quality
    np.testing.assert_array_equal(np.isnan(result.pixels), np.isnan(whole.pixels[box.slices]))
    kept = ~np.uint8(QualityBit.ARTEFACT)
    np.testing.assert_array_equal(quality & kept, work.assess(whole, None).quality[box.slices] & kept)
    assert quality[50, 20] & QualityBit.NONFINITE and quality[0, 30] & QualityBit.NEAR_MASKED
    assert quality[:, 0].all() and not quality[-1, -1] & QualityBit.EDGE


def test_what_is_no_part_or_needs_the_whole_image_is_refused(image: Image, psf: Psf) -> None:
    for box in (Box(0, 257, 0, 20), Box(30, 20, 0, 20)):
        with pytest.raises(DataError, match=f"region-outside: .*{box}"):
            box_work(Work(image, psf, Options(method="linear")), box)
    with pytest.raises(DataError, match="region-too-small"):
        box_work(Work(image, psf, Options(method="linear")), Box(0, 20, 0, 15))

    def refused(largest_error: float = 0.05, changed: Image = image, **parameters: Any) -> str:
        with pytest.raises(DataError) as error:
            options = Options(method="linear", parameters=parameters, region_error=largest_error)
            box_work(Work(changed, psf, options), BRIGHT)
        return error.value.code

    assert refused(stop="discrepancy") == "region-discrepancy"
    assert refused(largest_error=0.0) == refused(largest_error=1.5) == "bad-region-error"
    masked = image.mask.copy()
    masked[BRIGHT.slices] = MaskBit.SATURATED
    assert refused(changed=replace(image, mask=masked)) == "all-masked"
    alone: BoxWork = box_work(Work(image, psf, Options(method="linear")), BRIGHT)
    with pytest.raises(DataError, match="region-errors"):
        Options(region=alone.box, error_draws=4)


def test_a_text_becomes_a_box_and_a_text_again() -> None:
    assert Box.parse("10:40,5:25") == Box(10, 40, 5, 25)
    assert str(Box(10, 40, 5, 25)) == "10:40,5:25"
    for text in ("1:2", "1:2,3", "a:2,3:4", "1:2,3:4,5:6", "-1:20,0:20", "1.5:20,0:20"):
        with pytest.raises(DataError, match="bad-region"):
            Box.parse(text)
