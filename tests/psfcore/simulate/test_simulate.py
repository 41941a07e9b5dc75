from __future__ import annotations

import numpy as np
import pytest

from psfcore.simulate.observe import observe
from psfcore.simulate.scene import solar_scene
from tests.psfcore.conftest import delta, gaussian, make_psf


def test_a_scene_is_positive_and_the_same_for_the_same_seed() -> None:
    for shape in ((64, 64), (100, 61), (33, 128)):
        scene = solar_scene(shape, 5)
        assert scene.shape == shape and (scene > 0).all()
        np.testing.assert_array_equal(scene, solar_scene(shape, 5))
        assert not np.array_equal(scene, solar_scene(shape, 6))


def test_a_scene_has_the_contrasts_of_the_sun() -> None:
    """The real image: 1 % of pixels below 86, median 540, 1 % above 2480, brightest 17000 DN/s."""
    low, middle, high, brightest = np.percentile(solar_scene((384, 384), 1), [1, 50, 99, 100])
    assert 10 < low < 150
    assert 250 < middle < 1000
    assert 1500 < high < 10000
    assert brightest > 5000


def test_without_noise_the_image_is_the_blurred_scene() -> None:
    scene, quiet = solar_scene((48, 48), 2), {"photon_gain_dn": 0.0, "read_noise_dn": 0.0, "seed": 1}
    seen = observe(scene, make_psf(delta(16)), exposure_s=2.0, **quiet)
    np.testing.assert_allclose(seen, scene, rtol=1e-12)
    point = np.zeros((64, 64))
    point[32, 32] = 1000.0
    seen = observe(point, make_psf(gaussian(31, 2.0)), exposure_s=1.0, **quiet)
    assert seen.sum() == pytest.approx(1000.0)
    assert seen[32, 32] == pytest.approx(1000 / (2 * np.pi * 4), rel=0.01)


def test_noise_has_the_variance_of_photon_and_read_noise() -> None:
    scene, noise = np.full((400, 400), 300.0), {"photon_gain_dn": 6.0, "read_noise_dn": 2.0}
    seen = observe(scene, make_psf(delta(16)), exposure_s=1.4, seed=3, **noise)
    assert seen.mean() == pytest.approx(300.0, rel=1e-3)
    assert (seen * 1.4).var() == pytest.approx(300.0 * 1.4 * 6.0 + 2.0**2, rel=0.02)
