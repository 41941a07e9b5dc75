"""The view: scenes of the images."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pytest

from psfcore.gap.view import View
from tests.psfcore.gap.small_gaps import changed, clean, fit, solution


def test_a_scene_has_the_brightness_of_its_own_image() -> None:
    """The second image is 5 % brighter than the others of its pointing."""
    transit = changed(clean(), lambda n, frame: frame.pixels * (1.05 if n == 1 else 1.0))
    view = View(fit(transit))
    of_one, of_next = (float(view.expected[n].mean() / transit.frames[n].pixels.mean()) for n in (1, 2))
    assert of_one == pytest.approx(of_next, rel=2e-3)
    # An image without light has a dark scene; a negative sum of light is no brightness, and nothing is divided by zero.
    for of_one, of_others in ((0.0, 1.0), (-1.0, 1.0), (1.0, 0.0)):
        sky = copy(solution().sky)
        factors = [of_one if n == 1 else of_others for n in range(len(sky.scenes))]
        sky.scenes = [np.float32(by) * scene for by, scene in zip(factors, sky.scenes, strict=True)]
        scene = View(replace(solution(), sky=sky)).scenes[1]
        assert np.abs(scene).max() < 1e-6 * np.abs(view.scenes[1]).max(), (of_one, of_others)
