"""A scene of 16 bits is the scene to 2^-11, can be read in parts, and is stored again without any change."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.scatter.scenes import Scenes
from psfcore.scatter.total_psf import Blur
from tests.psfcore.small_transits import DIFFRACTION


def test_stored_scenes() -> None:
    blur, rng = Blur(DIFFRACTION, (75, 40)), np.random.default_rng(0)
    plane = rng.normal(size=(75, 40)) * 10.0 ** rng.uniform(-2, 3, (75, 40))
    planes = [plane, 1e7 * plane, 1e-30 * plane, 0 * plane, np.full_like(plane, 8 * (1 - 2.0**-20))]
    scenes = Scenes(len(planes), blur.engine.lanes_shape)
    for n, each in enumerate(planes):
        scenes[n] = blur.lanes(each)
        whole = blur.field(scenes[n])
        np.testing.assert_allclose(whole, each, rtol=2.0**-11, atol=2.0**-30 * np.abs(each).max())
        for window in (
            (slice(30, 66), slice(3, 40)),
            (slice(64, 75), slice(0, 1)),
            (slice(5, 5), slice(2, 9)),
        ):
            np.testing.assert_array_equal(scenes.stored(n)[window], whole[window])
        other = scenes.copy()
        other[n] = scenes[n]
        assert other[n].tobytes() == scenes[n].tobytes()
        other[n] = 2 * scenes[n]
        np.testing.assert_array_equal(blur.field(scenes[n]), whole)
    assert len(scenes) == len(list(scenes)) == len(scenes[1:]) + 1 == len(planes)
    with pytest.raises(IndexError):
        scenes[len(planes)]
