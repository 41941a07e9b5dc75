"""The library: all effects that a diagnosis tests. A new effect goes into EFFECTS in the file of its stage."""

from __future__ import annotations

from psfcore.gap.effect import Effect
from psfcore.gap.library import detector as detector_effects
from psfcore.gap.library import optics as optics_effects
from psfcore.gap.library import scene as scene_effects

LIBRARY: tuple[Effect, ...] = (
    *detector_effects.EFFECTS,
    *optics_effects.EFFECTS,
    *scene_effects.EFFECTS,
)
