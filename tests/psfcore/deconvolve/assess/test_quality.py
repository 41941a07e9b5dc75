from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from psfcore.convolution.convolver import Convolver, linear_convolve
from psfcore.deconvolve.assess.quality import NEAR_MASKED_PX, QualityBit, quality_plane
from psfcore.deconvolve.edges import edge_band_px
from psfcore.deconvolve.methods.richardson_lucy import richardson_lucy
from psfcore.image import MaskBit
from psfcore.psf import Psf, crop_centred
from psfcore.scatter.power_law import scatter_kernel
from psfcore.simulate.observe import observe
from tests.psfcore.conftest import delta, gaussian, make_image, make_psf

Plane = NDArray[np.float64]
SIZE_PX = 128


@pytest.fixture(scope="module")
def psf() -> Psf:
    size = (256, 256)
    scatter = crop_centred(scatter_kernel(6.15, 2.53, 0.411, 2048), size)
    return make_psf(np.maximum(linear_convolve(scatter, gaussian(31, 0.8), size), 0))


def smooth_scene() -> Plane:
    y, x = np.mgrid[:SIZE_PX, :SIZE_PX]
    return 500 + 4000 * np.exp(-((y - 66) ** 2 + (x - 60) ** 2) / (2 * 12.0**2))


def points_scene() -> Plane:
    scene = np.full((SIZE_PX, SIZE_PX), 20.0)
    rng = np.random.default_rng(2)
    scene[rng.integers(16, 112, 25), rng.integers(16, 112, 25)] += rng.uniform(300, 3000, 25)
    scene[64, 64] = 8000.0
    return scene


def neighbours_off(
    scene: Plane, psf: Psf, bad: NDArray[np.bool_], bit: MaskBit
) -> tuple[Plane, Plane, Plane]:
    """Change caused by losing the pixels `bad`, the image without loss, and the distance from them (px)."""
    seen = observe(scene, psf, exposure_s=1.0, photon_gain_dn=0, read_noise_dn=0, seed=1)
    whole = richardson_lucy(make_image(seen), psf, steps=20).pixels
    lost = seen.copy()
    lost[bad] = np.nan if bit is MaskBit.NONFINITE else 0.8 * seen[bad]
    mask = np.where(bad, np.uint8(bit), np.uint8(0))
    found = richardson_lucy(make_image(lost, mask), psf, steps=20).pixels
    return found - whole, whole, distance_transform_edt(~bad)


def lost_pixels(kind: str, y: int = 64, x: int = 64) -> NDArray[np.bool_]:
    bad = np.zeros((SIZE_PX, SIZE_PX), dtype=bool)
    half = {"pixel": 0, "block": 1}[kind]
    bad[y - half : y + half + 1, x - half : x + half + 1] = True
    return bad


# --- what a lost pixel does to its neighbours ---


@pytest.mark.parametrize("bit", list(MaskBit))
@pytest.mark.parametrize("kind", ["pixel", "block"])
def test_a_lost_pixel_changes_others_by_less_than_a_percent_beyond_3_px(
    psf: Psf, kind: str, bit: MaskBit
) -> None:
    """A smooth bright scene, and a pixel between the points of a scene of points."""
    for scene, place in ((smooth_scene(), (64, 64)), (points_scene(), (73, 50))):
        change, whole, distance = neighbours_off(scene, psf, lost_pixels(kind, *place), bit)
        off = np.abs(change / whole)
        assert off[distance > 3].max() < 0.01


@pytest.mark.parametrize("bit", list(MaskBit))
@pytest.mark.parametrize("kind", ["pixel", "block"])
def test_a_lost_point_source_leaves_less_than_a_percent_of_its_light_beyond_3_px(
    psf: Psf, kind: str, bit: MaskBit
) -> None:
    """The lost source is 400 times brighter than the sky around it, so the change is relative to its light."""
    change, whole, distance = neighbours_off(points_scene(), psf, lost_pixels(kind), bit)
    far = np.abs(change)[distance > 3].max()
    assert far < 0.01 * whole[64, 64]


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


def test_the_first_bits_are_those_of_the_mask() -> None:
    assert all(QualityBit[str(bit.name)] == bit for bit in MaskBit)


def test_the_edge_band_ends_where_little_of_the_light_is_from_outside(psf: Psf) -> None:
    """By brute force: in each row, the share of a uniform Sun's light that comes from beyond the first row."""
    edge_px = edge_band_px(psf, 0.10)
    outside = np.zeros((256, 257))
    outside[:128] = 1.0
    share = Convolver(psf.kernel, outside.shape, dtype=np.float64).apply(outside)[128:, 128]
    assert share[edge_px - 1] > 0.10 >= share[edge_px]
    assert edge_band_px(make_psf(delta(32)), 0.10) == 0
    assert (
        edge_band_px(make_psf(gaussian(64, 3.0)), 0.10) == 4
    )  # 1 - Phi(3.5 / 3) = 0.12, 1 - Phi(4.5 / 3) = 0.07


def test_pixels_near_masked_ones_are_those_within_the_distance() -> None:
    mask = np.zeros((40, 50), np.uint8)
    mask[[0, 7, 8, 39, 20], [0, 30, 30, 49, 3]] = MaskBit.SATURATED
    image = make_image(np.ones(mask.shape), mask)
    marked = quality_plane(image, image.pixels, edge_px=0) & QualityBit.NEAR_MASKED != 0
    distance = distance_transform_edt(image.valid)
    assert (marked == (image.valid & (distance <= NEAR_MASKED_PX))).all()
