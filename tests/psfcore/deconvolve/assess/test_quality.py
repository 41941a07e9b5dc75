"""The quality plane: its bits, the edge band, and what a lost pixel does to its neighbours."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from psfcore.deconvolve.assess.quality import NEAR_MASKED_PX, QualityBit, quality_plane
from psfcore.image import MaskBit
from psfcore.psf import Psf
from psfcore.simulate.scene import observe
from tests.psfcore.conftest import make_image
from tests.psfcore.deconvolve.scattering import richardson_lucy, scattering_psf

Plane = NDArray[np.float64]
SIZE_PX = 128


@pytest.fixture(scope="module")
def psf() -> Psf:
    return scattering_psf()


def smooth_scene() -> Plane:
    y, x = np.mgrid[:SIZE_PX, :SIZE_PX]
    return 500 + 4000 * np.exp(-((y - 66) ** 2 + (x - 60) ** 2) / (2 * 12.0**2))


def points_scene() -> Plane:
    scene = np.full((SIZE_PX, SIZE_PX), 20.0)
    rng = np.random.default_rng(2)
    scene[rng.integers(16, 112, 25), rng.integers(16, 112, 25)] += rng.uniform(300, 3000, 25)
    scene[64, 64] = 8000.0
    return scene


def changes(scene: Plane, psf: Psf, y: int, x: int) -> Iterator[tuple[Plane, Plane]]:
    """The image after twenty steps; and its changes beyond 3 px if a pixel, or 3 x 3 px, are lost in each way."""
    seen = observe(scene, psf, exposure_s=1.0, photon_gain_dn=0, read_noise_dn=0, seed=1)
    whole = richardson_lucy(make_image(seen), psf, steps=20).pixels
    for bit in MaskBit:
        for half in (0, 1):
            bad = np.zeros(seen.shape, dtype=bool)
            bad[y - half : y + half + 1, x - half : x + half + 1] = True
            lost = np.where(bad, np.nan if bit is MaskBit.NONFINITE else 0.8 * seen, seen)
            mask = np.where(bad, np.uint8(bit), np.uint8(0))
            result = richardson_lucy(make_image(lost, mask), psf, steps=20).pixels
            yield whole, np.where(distance_transform_edt(~bad) > 3, result - whole, 0)


# --- what a lost pixel does to its neighbours ---


def test_a_lost_pixel_changes_others_by_less_than_a_percent_beyond_3_px(psf: Psf) -> None:
    """In a smooth bright scene, between the points of a scene of points, and at a point.

    The lost point is 400 times brighter than the sky around it, so the change is relative to its light.
    """
    for scene, place in ((smooth_scene(), (64, 64)), (points_scene(), (73, 50))):
        for whole, change in changes(scene, psf, *place):
            assert np.abs(change / whole).max() < 0.01
    for whole, change in changes(points_scene(), psf, 64, 64):
        assert np.abs(change).max() < 0.01 * whole[64, 64]


# --- the plane ---


def test_each_reason_has_its_bit() -> None:
    pixels = np.ones((64, 64))
    mask = np.zeros(pixels.shape, np.uint8)
    pixels[20, 20], mask[20, 20], mask[40, 40] = np.nan, MaskBit.NONFINITE, MaskBit.SATURATED
    result = pixels.copy()
    result[30, 30] = -0.5
    suspected = np.zeros(pixels.shape, bool)
    suspected[31, 31] = True
    error = np.where(mask == 0, 1.0, np.nan)
    plane = quality_plane(make_image(pixels, mask), result, edge_px=5, suspected=suspected, error=error)
    assert plane.dtype == np.uint8
    assert plane[20, 20] == QualityBit.NONFINITE | QualityBit.NO_ERROR
    assert plane[40, 40] == QualityBit.SATURATED | QualityBit.NO_ERROR
    assert plane[20, 23] == plane[42, 42] == QualityBit.NEAR_MASKED
    assert plane[20, 24] == plane[43, 41] == 0  # at 4 and sqrt(10) px
    assert plane[30, 30] == 0, "noise makes dark pixels negative; a mean without them would be too large"
    assert plane[31, 31] == QualityBit.ARTEFACT
    assert plane[4, 30] == plane[30, 59] == QualityBit.EDGE and plane[5, 30] == plane[30, 58] == 0
    without = quality_plane(make_image(pixels, mask), result, edge_px=0)
    assert not (without & (QualityBit.NO_ERROR | QualityBit.EDGE)).any()
    assert all(QualityBit[str(bit.name)] == bit for bit in MaskBit), "the first bits are those of the mask"


def test_pixels_near_masked_ones_are_those_within_the_distance() -> None:
    mask = np.zeros((40, 50), np.uint8)
    mask[[0, 7, 8, 39, 20], [0, 30, 30, 49, 3]] = MaskBit.SATURATED
    image = make_image(np.ones(mask.shape), mask)
    marked = quality_plane(image, image.pixels, edge_px=0) & QualityBit.NEAR_MASKED != 0
    distance = distance_transform_edt(image.valid)
    assert (marked == (image.valid & (distance <= NEAR_MASKED_PX))).all()
