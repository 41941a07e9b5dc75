"""The tree of causes: stage, family, form.

A family is an operator times a modulation: for example, light that is added (`light`) and changes with time (`time`).
Its forms are the effects of the library that belong to it, and its free fields: sums of bumps of one width with random
coefficients (`columns`). A field stands for every cause of its family that is smooth on the scale of its bumps.

| stage | what it does |
|---|---|
| scene | changes the light before the telescope |
| optics | changes the PSF |
| detector | changes the image |
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from psfcore.gap.effect import Effect, Stage

STAGES: tuple[Stage, ...] = ("scene", "optics", "detector")
SUN = "scene_evolution"  # the effect that is the changing Sun
WIDTHS = (0.2, 0.4, 0.8)  # of a bump, in units of half the detector or half the duration
SPOT = 0.1  # width of the bumps of a change at one place


@dataclass(frozen=True)
class Family:
    """A family of causes.

    Attributes
    ----------
    words
        The name of the family in text.
    settled_by
        The observation that shows such a cause.
    axes
        The axes of the report along which the cause varies.
    """

    name: str
    stage: Stage
    words: str
    settled_by: str
    axes: tuple[str, ...]


_PLACE, _DISC = ("detector_x", "detector_y"), ("radius_in_disc", "azimuth_in_disc")
_DARK = "an exposure with the door closed"
_LADDER = "a series of exposure times at one pointing"
_TWICE = "the first pointing again at the end of the transit"
_MOVED = "images of the same scene at several positions on the detector"
_TRACK = "a transit across another part of the detector"
FAMILIES: dict[str, Family] = {
    one.name: one
    for one in (
        Family("light_place", "detector", "light added at places of the detector", _DARK, _PLACE),
        Family("light_time", "detector", "added light that changes with time", _DARK, ("time",)),
        Family(
            "light_place_time",
            "detector",
            "light added at places of the detector that changes with time",
            _DARK,
            ("time", *_PLACE),
        ),
        Family(
            "offset_place",
            "detector",
            "an offset of each readout",
            f"a dark exposure, or {_LADDER}",
            ("exposure", "intensity"),
        ),
        Family(
            "offset_time",
            "detector",
            "an offset of each readout that changes with time",
            "dark exposures during the transit",
            ("time", "exposure"),
        ),
        Family(
            "offset_place_time",
            "detector",
            "an offset of each readout that changes with place and time",
            "dark exposures during the transit",
            ("time", "exposure", *_PLACE),
        ),
        Family(
            "gain_place",
            "detector",
            "a gain error that changes with the place on the detector",
            _MOVED,
            _PLACE,
        ),
        Family("gain_time", "detector", "a gain that changes with time", _TWICE, ("time",)),
        Family(
            "gain_place_time",
            "detector",
            "a gain that changes with place and time",
            _TWICE,
            ("time", *_PLACE),
        ),
        Family(
            "gain_kind",
            "detector",
            "a gain that differs between gain modes or exposure times",
            "images of the same scene in all gain modes and exposure times",
            ("gain_mode", "exposure"),
        ),
        Family(
            "response",
            "detector",
            "a response of the detector that depends on the signal",
            _LADDER,
            ("intensity",),
        ),
        Family(
            "memory",
            "detector",
            "charge that stays or moves in the detector",
            "a dark exposure after a bright one",
            ("time", "pointing", "detector_y", "intensity"),
        ),
        Family(
            "psf",
            "optics",
            "a change of the PSF",
            "a transit along a second track that crosses the first",
            ("scattering_distance", *_DISC, *_PLACE),
        ),
        Family("psf_place", "optics", "a PSF that changes over the field", _TRACK, _PLACE),
        Family("psf_time", "optics", "a PSF that changes with time", _TWICE, ("time",)),
        Family(
            "psf_place_time", "optics", "a PSF that changes with place and time", _TWICE, ("time", *_PLACE)
        ),
        Family(
            "core",
            "optics",
            "a change of the core of the PSF",
            "an image of a sharp limb or of a point source",
            _DISC,
        ),
        Family(
            "ghost",
            "optics",
            "a displaced copy of the image",
            "images of a bright source at several positions in the field",
            (*_PLACE, "intensity"),
        ),
        Family(
            "edge",
            "scene",
            "light at the edge of the occulter",
            "shorter exposures, or an occulter without an atmosphere",
            _DISC,
        ),
        Family(
            "edge_time",
            "scene",
            "light in front of the occulter that changes with time",
            "the occulter off the Sun",
            ("time", *_DISC),
        ),
        Family(
            "outside",
            "scene",
            "light from outside the field",
            "full-Sun images taken at the same time",
            ("scattering_distance", "pointing", "intensity"),
        ),
        Family(
            "light_pointing",
            "scene",
            "light added in one pointing",
            "an exposure with the door closed at each pointing",
            ("pointing", *_PLACE),
        ),
        *(Family(f"other_{stage}", stage, f"another change of the {stage}", "", ()) for stage in STAGES),
        Family(
            "sun", "scene", "a changing Sun", "images that are closer together in time", ("time", "pointing")
        ),
    )
}


@dataclass(frozen=True)
class Field:
    """A free field: the operator and the modulation of `columns`.

    Attributes
    ----------
    width
        The width of the bumps of the modulation.
    pointing
        The number of the pointing, for a change in one pointing.
    """

    family: str
    operator: str
    modulation: str
    width: float | None = None
    pointing: int | None = None

    @property
    def everywhere(self) -> bool:
        """Whether all bumps may act together; those of the width SPOT act at one place."""
        return self.width != SPOT

    @property
    def width_of_forms(self) -> float | None:
        """The width of its bumps on the detector; None if it has none there."""
        return None if self.modulation in ("time", "kind", "constant") else self.width

    @property
    def in_blocks(self) -> bool:
        """Whether the change differs between the images of one pointing, so that the unocculted field shows it."""
        if self.operator in ("edge", "outside"):
            return False
        return self.modulation in ("time", "place_time", "kind") or self.operator == "offset"


def fields_of(pointings: Sequence[int], *, exposures: bool, kinds: bool) -> list[Field]:
    """The fields that images can show.

    Parameters
    ----------
    pointings
        The numbers of the pointings.
    exposures
        Whether exposure times differ.
    kinds
        Whether exposure times or gain modes differ.
    """
    found = []
    for operator in ("light", "gain", *(["offset"] if exposures else [])):
        widths = {
            "place": WIDTHS if operator == "offset" else (SPOT, *WIDTHS),
            "time": WIDTHS,
            "place_time": WIDTHS[1:] if operator == "gain" else WIDTHS[2:],
        }
        found += [
            Field(f"{operator}_{how}", operator, how, one) for how, some in widths.items() for one in some
        ]
    for pointing in pointings if len(pointings) > 1 else ():
        found.append(Field("outside", "outside", "pointing", None, pointing))
        found += [Field("light_pointing", "light", "pointing", width, pointing) for width in WIDTHS]
    return [
        *found,
        Field("outside", "outside", "pointings"),
        *([Field("gain_kind", "gain", "kind")] if kinds else []),
        Field("psf", "kernel", "constant"),
        Field("psf_place", "tilted_kernel", "constant"),
        Field("psf_time", "ring", "time"),
        Field("psf_place_time", "tilted_kernel", "time"),
        *(
            Field(f"psf_{how}", "scatter", how, width)
            for width in WIDTHS[1:]
            for how in ("place", "place_time")
        ),
        Field("edge", "edge", "constant"),
        Field("edge_time", "edge", "time", WIDTHS[-1]),
    ]


def family_of(effect: Effect) -> str:
    """The name of the family of an effect; for an added effect without a family, that of other changes at its stage."""
    return effect.family or f"other_{effect.stage}"


def listed(observations: Iterable[str]) -> str:
    """Observations as text, each once."""
    return "; or ".join(dict.fromkeys(part for one in observations for part in one.split(", or ") if part))
