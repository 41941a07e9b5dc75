"""The view: scenes of the images; and memory that views no longer need goes back to the system."""

from __future__ import annotations

import ctypes
from dataclasses import replace

import numpy as np
import psutil
import pytest

from psfcore.gap.view import View
from psfcore.memory import return_unused_memory
from tests.psfcore.gap.small_gaps import changed, clean, fit, solution

MIB = 2**20


def test_a_scene_has_the_brightness_of_its_own_image() -> None:
    """The second image is 5 % brighter than the others of its pointing."""
    transit = changed(clean(), lambda n, frame: frame.pixels * (1.05 if n == 1 else 1.0))
    view = View(fit(transit))
    of_one, of_next = (float(view.expected[n].mean() / transit.frames[n].pixels.mean()) for n in (1, 2))
    assert of_one == pytest.approx(of_next, rel=2e-3)
    # An image without light has a dark scene; a negative sum of light is no brightness, and nothing is divided by zero.
    for of_one, of_others in ((0.0, 1.0), (-1.0, 1.0), (1.0, 0.0)):
        sky = solution().sky.copy()
        for n, scene in enumerate(solution().sky.scenes):
            sky.scenes[n] = np.float32(of_one if n == 1 else of_others) * scene
        scene = View(replace(solution(), sky=sky)).scenes[1]
        assert np.abs(scene).max() < 1e-6 * np.abs(view.scenes[1]).max(), (of_one, of_others)


class Planes:
    """Planes that refer to themselves, as the fields of a view do."""

    def __init__(self, count: int) -> None:
        self.planes = [np.ones(MIB // 8) for _ in range(count)]
        self.own = self


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "malloc_trim"), reason="the C library is not glibc")
def test_freed_blocks_between_blocks_in_use_go_back_to_the_system() -> None:
    # From now on, blocks below 30 MiB stay in the heap when they are freed.
    block = np.ones(30 * MIB // 8)
    del block
    return_unused_memory()
    process = psutil.Process()
    before = process.memory_info().rss
    kept, freed = [], []
    for _ in range(100):
        freed.append(Planes(2))
        kept.append(np.ones(1000))
    with_all = process.memory_info().rss
    freed.clear()
    return_unused_memory()
    after = process.memory_info().rss
    assert with_all - before > 190 * MIB
    assert after - before < 20 * MIB
    assert len(kept) == 100
