"""The table of all effects, by name, and the names of each group."""

from __future__ import annotations

from psfcore.blind.effects import detector, effect, optics, scene, withheld
from psfcore.blind.effects.effect import EFFECTS, EffectKind
from psfcore.errors import DataError

# An import of these files declares their effects.
DECLARED_IN = (scene, optics, detector, withheld)


def _names_of(group: str) -> tuple[str, ...]:
    return tuple(kind.name for kind in EFFECTS.values() if kind.group == group)


KNOWN = _names_of(effect.KNOWN)  # effects that the gap library also contains, by the same names
WITHHELD = {group: _names_of(group) for group in (effect.CALIBRATION, effect.TEST)}


def effect_named(name: str) -> EffectKind:
    """The effect with this name. Raises DataError "unknown-effect"."""
    if name not in EFFECTS:
        raise DataError("unknown-effect", f"expected one of {', '.join(sorted(EFFECTS))}; got {name!r}")
    return EFFECTS[name]
