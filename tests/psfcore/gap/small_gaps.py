"""Small transits for several tests: a clean one with its fit and view, and one with a gap that is diagnosed once."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np

from psfcore.blind.residuals import true_coordinates
from psfcore.gap import corrected_psf
from psfcore.gap.diagnose import Diagnosis, diagnose
from psfcore.gap.effect import Effect
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.verdict import axes
from psfcore.gap.view import View
from psfcore.scatter import total_psf
from psfcore.scatter.inversion import invert
from psfcore.scatter.reconstruction import Solution
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from psfcore.transit.transit import Frame, Transit
from tests.transit_files import TRUTH, diffraction

OFFSET_DN = 6.0
REACH_PX = 513
# Effects of each stage, and two that these data cannot show: a diagnosis with them takes seconds.
NAMES = ("dark_offset", "gain_mismatch", "core_blur", "scene_evolution", "saturation_fill")
FEW = tuple(one for one in LIBRARY if one.name in NAMES)


def few_sign_flips() -> AbstractContextManager[object]:
    """A context in which a diagnosis makes 99 sign flips, which is quicker than 999."""
    return patch.object(axes, "SIGN_FLIPS", 99)


@contextmanager
def small_reach() -> Iterator[None]:
    """Make corrected PSFs of REACH_PX px: those of 2048 px take 200 MB. Fits of up to 256 px stay the same."""
    with (
        patch.object(corrected_psf, "REACH_GRID_PX", REACH_PX),
        patch.object(total_psf, "REACH_GRID_PX", REACH_PX),
    ):
        yield


@cache
def clean() -> Transit:
    """Twelve images of 96 px with some tens of photons per pixel in the discs."""
    plan = default_plan(12, 96, oversampling=1, brightness=6.0)
    return simulate(plan, TRUTH, diffraction(), seed=8).transit


@cache
def large() -> Transit:
    """Eighteen images of 128 px: their unocculted field has enough blocks to show a changing scene."""
    plan = default_plan(18, 128, oversampling=1, brightness=8.0)
    return simulate(plan, TRUTH, diffraction(), seed=3).transit


@cache
def solution() -> Solution:
    """The fit to the large transit."""
    return invert(large())


@cache
def view() -> View:
    """The view of this fit."""
    return View(solution())


def fit(transit: Transit) -> Solution:
    """The fit to a transit of the tests. It starts at the true PSF, which is quicker."""
    return invert(transit, start=true_coordinates(TRUTH), near=True)


def effect(name: str) -> Effect:
    """The effect of the library with this name."""
    return next(one for one in LIBRARY if one.name == name)


def changed(transit: Transit, change: Callable[[int, Frame], np.ndarray]) -> Transit:
    """The transit with every image changed."""
    frames = tuple(
        replace(frame, pixels=change(n, frame).astype(np.float32)) for n, frame in enumerate(transit.frames)
    )
    return replace(transit, frames=frames)


@cache
def with_offset() -> Transit:
    """The same images with OFFSET_DN added to every readout."""
    transit = changed(clean(), lambda n, frame: frame.pixels + OFFSET_DN / frame.exposure_s)
    return replace(transit, sha256={"000.fits": "ab" * 32, "transit.json": "cd" * 32})


@cache
def found() -> Diagnosis:
    """The diagnosis of `with_offset`: attributed, with a full refit."""
    with few_sign_flips():
        return diagnose(with_offset(), library=FEW)
