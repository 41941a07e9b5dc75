"""All effects that are tried, and the probes beside them. To add one, add it to the file of its stage."""

from __future__ import annotations

from psfcore.gap import detector_effects, optics_effects, probes, scene_effects
from psfcore.gap.effect import Effect

LIBRARY: tuple[Effect, ...] = (
    *detector_effects.EFFECTS,
    *optics_effects.EFFECTS,
    *scene_effects.EFFECTS,
    *probes.PROBES,
)
