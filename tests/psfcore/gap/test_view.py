"""The view: scenes of the images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from psfcore.gap.view import View, _ratio
from psfcore.scatter.inversion import invert
from tests.psfcore.gap.small_transits import clean


def test_a_scene_has_the_brightness_of_its_own_image() -> None:
    """The second image is 5 % brighter than the others of its pointing."""
    frames = tuple(
        replace(frame, pixels=frame.pixels * np.float32(1.05 if n == 1 else 1.0))
        for n, frame in enumerate(clean().frames)
    )
    view = View(invert(replace(clean(), frames=frames)))
    of_one, of_next = (float(view.expected[n].mean() / frames[n].pixels.mean()) for n in (1, 2))
    assert of_one == pytest.approx(of_next, rel=2e-3)
    assert _ratio(2.0, 4.0) == 0.5 and _ratio(-1.0, 4.0) == 0.0 and _ratio(1.0, 0.0) == 1.0
