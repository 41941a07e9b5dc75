"""The prepared image: its centre, its smooth light, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.flare.arms.image import pixel_sigma, prepared, ring_halo, smooth, source_centre

SHAPE = (61, 81)
ALL = np.ones(SHAPE, dtype=bool)


def test_the_difference_is_zero_where_it_cannot_be_used() -> None:
    image, reference = np.full(SHAPE, 5.0), np.full(SHAPE, 2.0)
    image[3, 4] = np.nan
    saturated = np.zeros(SHAPE, dtype=bool)
    saturated[20:25, 30:35] = saturated[50, 50] = True
    difference, usable, patch = prepared(image, reference, saturated)
    assert difference[3, 4] == difference[22, 32] == 0 and difference[0, 0] == 3
    assert (~usable).sum() == 1 + 25 + 1
    assert patch.sum() == 25 and patch[22, 32]


def test_the_centre_is_the_given_one_or_the_patch_or_the_brightest_pixel() -> None:
    plane, patch = np.random.default_rng(0).normal(size=SHAPE), np.zeros(SHAPE, dtype=bool)
    plane[40, 60] = 1e4
    assert source_centre(plane, ALL, patch, (7.0, 8.0))[0] == (7.0, 8.0)
    assert source_centre(plane, ALL, patch, None)[0] == (60.0, 40.0)
    patch[10:15, 20:25] = True
    centre, radius = source_centre(plane, ALL, patch, None)
    assert centre == (22.0, 12.0) and radius == pytest.approx(5 / np.sqrt(np.pi))
    with pytest.raises(DataError, match=r"expected a centre \(x, y\) on the image of 81 x 61 px; got"):
        source_centre(plane, ALL, patch, (81.0, 3.0))


def test_smoothing_ignores_unusable_pixels() -> None:
    plane, usable = np.full(SHAPE, 4.0), ALL.copy()
    plane[30:33, 40:43], usable[30:33, 40:43] = 1e6, False
    np.testing.assert_allclose(smooth(plane, usable, 1.5), 4.0)


def test_the_halo_is_the_ring_median_without_the_arms() -> None:
    y, x = np.indices(SHAPE)
    radius = np.hypot(x - 40, y - 30)
    halo = 100 / (1 + radius)
    image = halo + np.where(np.abs(y - 30) <= 1, 50.0, 0.0)
    found = ring_halo(image, ALL, (40.0, 30.0), np.array([0.0]), 3.0)
    away = (radius > 5) & (radius < 28)
    np.testing.assert_allclose(found[away], halo[away], rtol=0.15)


def test_noise_is_that_of_photons_and_reading() -> None:
    expected = np.full(SHAPE, 9.0)
    assert pixel_sigma(expected, (4.0, 8.0))[0, 0] == pytest.approx(10.0)
    assert pixel_sigma(expected, None)[0, 0] == pytest.approx(3.0)
