"""A worker may run a short job between two steps of a long one: neither result may depend on it."""

from __future__ import annotations

import numpy as np

from psfcore.deconvolve.conditions import Conditions
from psfcore.deconvolve.methods.registry import method_named, method_names
from psfcore.simulate.scene import solar_scene
from tests.psfcore.conftest import gaussian, make_image, make_psf


def test_a_deconvolution_between_two_steps_of_another_changes_neither() -> None:
    psf = make_psf(gaussian(64, 1.5))
    long, short = make_image(solar_scene((96, 80), 1)), make_image(solar_scene((96, 80), 2))
    for name in method_names():
        method, between = method_named(name), []

        def pause(step: int, _steps: int, method=method, between=between) -> None:  # type: ignore[no-untyped-def]
            if step < 3:
                between.append(method(short, psf, Conditions()).pixels)

        interrupted = method(long, psf, Conditions(progress=pause)).pixels
        assert between, "the method reports its steps"
        np.testing.assert_array_equal(interrupted, method(long, psf, Conditions()).pixels, err_msg=name)
        alone = method(short, psf, Conditions()).pixels
        for pixels in between:
            np.testing.assert_array_equal(pixels, alone, err_msg=name)
