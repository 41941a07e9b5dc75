from __future__ import annotations

import numpy as np
import pytest

from psfcore.simulate.observe import observe
from psfcore.simulate.scene import solar_scene
from tests.psfcore.conftest import delta, gaussian, make_psf


@pytest.mark.parametrize("shape", [(64, 64), (100, 61), (33, 128)])
def test_a_scene_is_positive_and_the_same_for_the_same_seed(shape: tuple[int, int]) -> None:
    scene = solar_scene(shape, 5)
    assert scene.shape == shape
    assert (scene > 0).all()
    np.testing.assert_array_equal(scene, solar_scene(shape, 5))
    assert not np.array_equal(scene, solar_scene(shape, 6))


def test_a_scene_has_the_contrasts_of_the_sun() -> None:
    """The real image: 1 % of pixels below 86, median 540, 1 % above 2480, brightest 17000 DN/s."""
    low, middle, high, brightest = np.percentile(solar_scene((384, 384), 1), [1, 50, 99, 100])
    assert 10 < low < 150
    assert 250 < middle < 1000
    assert 1500 < high < 10000
    assert brightest > 5000


def test_without_noise_and_blur_the_image_is_the_scene() -> None:
    scene = solar_scene((48, 48), 2)
    seen = observe(scene, make_psf(delta(16)), exposure_s=2.0, photon_gain_dn=0, read_noise_dn=0, seed=1)
    np.testing.assert_allclose(seen, scene, rtol=1e-12)


def test_noise_has_the_variance_of_photon_and_read_noise() -> None:
    scene = np.full((400, 400), 300.0)
    exposure_s, gain_dn, read_dn = 1.4, 6.0, 2.0
    seen = observe(
        scene,
        make_psf(delta(16)),
        exposure_s=exposure_s,
        photon_gain_dn=gain_dn,
        read_noise_dn=read_dn,
        seed=3,
    )
    expected_dn2 = 300.0 * exposure_s * gain_dn + read_dn**2
    assert seen.mean() == pytest.approx(300.0, rel=1e-3)
    assert (seen * exposure_s).var() == pytest.approx(expected_dn2, rel=0.02)


def test_blur_conserves_light() -> None:
    scene = np.zeros((64, 64))
    scene[32, 32] = 1000.0
    seen = observe(
        scene, make_psf(gaussian(31, 2.0)), exposure_s=1.0, photon_gain_dn=0, read_noise_dn=0, seed=1
    )
    assert seen.sum() == pytest.approx(1000.0)
    assert seen[32, 32] == pytest.approx(1000 / (2 * np.pi * 4), rel=0.01)
