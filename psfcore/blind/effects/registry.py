"""All effects of the blind set. KNOWN: effects that the gap library also contains, by the same names. UNKNOWN: the others."""

from __future__ import annotations

import copyreg
from collections.abc import Callable

from psfcore.blind.effects.detector import DETECTOR_EFFECTS
from psfcore.blind.effects.effect import Kind
from psfcore.blind.effects.optics import OPTICS_EFFECTS
from psfcore.blind.effects.scene import SCENE_EFFECTS
from psfcore.errors import DataError

EFFECTS: dict[str, Kind] = {
    effect.name: effect for effect in (*SCENE_EFFECTS, *OPTICS_EFFECTS, *DETECTOR_EFFECTS)
}
KNOWN = (
    "dark_offset",
    "intensity_gradient",
    "gain_mismatch",
    "nonlinearity",
    "flat_field_residual",
    "column_smear",
    "persistence",
    "ghost",
    "anisotropic_scatter",
    "field_dependent_scatter",
    "wide_halo",
    "core_blur",
    "mesh_rotation",
    "mesh_pitch",
    "occulter_motion",
    "out_of_field_light",
    "saturation_fill",
    "scene_evolution",
)
UNKNOWN = tuple(sorted(set(EFFECTS) - set(KNOWN)))


def effect_named(name: str) -> Kind:
    """The effect with this name. Raises DataError "unknown-effect"."""
    if name not in EFFECTS:
        raise DataError("unknown-effect", f"expected one of {', '.join(sorted(EFFECTS))}; got {name!r}")
    return EFFECTS[name]


def _by_name(kind: Kind) -> tuple[Callable[[str], Kind], tuple[str]]:
    return effect_named, (kind.name,)


# A process that makes cases gets the name of a kind: functions without a name have no pickle.
copyreg.pickle(Kind, _by_name)
