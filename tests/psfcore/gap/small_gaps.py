"""A small transit with a gap of known cause, diagnosed once with a few effects; other tests use the result."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numpy as np

from psfcore.gap.diagnose import Diagnosis, diagnose
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.verdict import where
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from psfcore.transit.transit import Frame, Transit
from tests.transit_files import TRUTH, diffraction

OFFSET_DN = 6.0
# Effects of each stage, and two that these data cannot show: a diagnosis with them takes seconds.
FEW = tuple(
    effect
    for effect in LIBRARY
    if effect.name in ("dark_offset", "gain_mismatch", "core_blur", "scene_evolution", "saturation_fill")
)


def few_sign_flips() -> AbstractContextManager[object]:
    """A context in which a diagnosis makes 99 sign flips, which is quicker than 999."""
    return patch.object(where, "SIGN_FLIPS", 99)


@cache
def clean() -> Transit:
    """Twelve images of 96 px with some tens of photons per pixel in the discs."""
    plan = default_plan(12, 96, oversampling=1, brightness=6.0)
    return simulate(plan, TRUTH, diffraction(), seed=8).transit


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
