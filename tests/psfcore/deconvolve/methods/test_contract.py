"""What a method needs, beside its equation: each fault is told as a sentence that says what to add
(CONTRIBUTING.md)."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.deconvolve.conditions import Conditions
from psfcore.deconvolve.methods.registry import method_named, method_names, properties_of
from psfcore.simulate.scene import observe, solar_scene
from tests.psfcore.conftest import gaussian, make_image, make_psf

STEPS = 3
LEAST_GAIN = 0.95  # a few steps must bring the estimate nearer to the scene by 5 %


def _approaches(name: str) -> bool:
    scene, psf = solar_scene((96, 96), 4), make_psf(gaussian(33, 1.2))
    image = make_image(observe(scene, psf, exposure_s=1.0, photon_gain_dn=0.0, read_noise_dn=0.0, seed=1))
    estimate = method_named(name)(image, psf, Conditions(edges="zero"), steps=STEPS).pixels
    inside = np.s_[16:-16, 16:-16]
    before, after = (np.std((one - scene)[inside]) for one in (image.pixels, estimate))
    return bool(after < LEAST_GAIN * before)


@pytest.mark.parametrize("name", method_names())
def test_a_method_has_all_that_it_needs(name: str, subtests: pytest.Subtests) -> None:
    """Each thing has a subtest, so that the failure of one does not hide another."""
    with subtests.test("memory"):
        figures = ("margin_of_psf", "plane_bytes", "transform_bytes")
        missing = [figure for figure in figures if getattr(properties_of(name), figure) is None]
        assert not missing, "measure them: python -m benchmarks.growth memory"
    with subtests.test("steps"):
        assert _approaches(name), (
            f"{STEPS} steps do not bring the estimate nearer to the scene: divide a filter in the layout of "
            "engine.transfer by engine.transfer_scale (psfcore/deconvolve/iterations/linear.py)"
        )
