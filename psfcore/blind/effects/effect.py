"""An effect of the blind set: a strength, drawn parameters, and the step of the simulation that it changes.

    scene -> occulter -> optics -> light on fine pixels -> light on detector pixels -> photons -> readout

Each kind of effect is a function that changes one step; `declare` adds it to the table EFFECTS. The docstring of the
function states the physical cause. An effect of strength 0 changes nothing.

| step | arguments of its functions after the effect |
|---|---|
| scene | the fine scene [y, x], DN/s; moment |
| covered | the fraction of each fine pixel around the disc that the occulter covers; these pixels (`Behind`); moment |
| foreground | the fine scene with its occulter [y, x], DN/s; moment |
| optics | the telescope; moment |
| spread | the fine light in the focal plane [y, x], DN/s; the fine scene with its occulter; the telescope; moment |
| light | the fine light in the focal plane [y, x], DN/s; moment |
| expected | the light on detector pixels [y, x], DN/s, before photon noise; moment |
| read_out | one exposure [y, x], in DN with noise; moment; the images that were read before |
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from psfcore.simulate.plan import Plan, Shot

Plane = NDArray[np.float64]
Value = TypeVar("Value")
Function = TypeVar("Function", bound=Callable[..., object])
# How a parameter is drawn: a function, or the ends of the interval of a uniform distribution.
Draw = Callable[[Plan, np.random.Generator], object] | tuple[float, float]

# Groups: effects that the gap library also contains, by the same names; effects that it lacks, for its calibration
# and for tests.
KNOWN, CALIBRATION, TEST = "known", "calibration", "test"
# The families of causes, by stage. A family is an operator and how it varies: "light_time" is added light that
# changes with time, "offset" DN of each readout, "gain_kind" a gain that differs between gain modes or exposure
# times, "psf_place" a PSF that changes over the field, "edge" light at the edge of the occulter, "edge_time" light in
# front of the occulter that changes with time.
_PLACE_OR_TIME = ("place", "time", "place_time")
_FAMILIES = {
    "scene": ("edge", "edge_time", "outside", "light_pointing", "sun"),
    "optics": ("psf", *(f"psf_{how}" for how in _PLACE_OR_TIME), "core", "ghost"),
    "detector": (
        *(f"{operator}_{how}" for operator in ("light", "offset", "gain") for how in _PLACE_OR_TIME),
        *("gain_kind", "response", "memory"),
    ),
}
STAGES = {family: stage for stage, families in _FAMILIES.items() for family in families}
ANGLE = (0.0, 360.0)  # degrees
# Options of kinds (`EffectKind`).
ADDS_LIGHT, DEPENDS_ON_NOISE, VARIES = {"adds_light": True}, {"noise_realisations": 12}, {"varies": True}


@dataclass(frozen=True)
class Moment:
    """One image of a plan: the image number `index`."""

    plan: Plan
    index: int

    @property
    def shot(self) -> Shot:
        """Pointing, exposure and gain mode."""
        return self.plan.shots[self.index]

    @property
    def elapsed(self) -> float:
        """The elapsed fraction of the transit: 0 at the first image, 1 at the last image."""
        first, last = self.plan.shots[0].time_s, self.plan.shots[-1].time_s
        return (self.shot.time_s - first) / max(last - first, 1e-9)


@dataclass(frozen=True)
class Earlier:
    """An earlier image: DN [y, x] without noise, and its time, s."""

    dn: Plane
    time_s: float


@dataclass(frozen=True)
class EffectKind:
    """A kind of effect: the function `change` changes a step of the simulation.

    Attributes
    ----------
    group
        The group: KNOWN, CALIBRATION or TEST.
    families
        The families of causes that are a right answer, the main one first.
    unit
        The unit of the strength.
    nominal
        A strength whose change is visible in the discs.
    largest
        The largest plausible strength.
    draw
        How each parameter is drawn.
    power
        The residual that the effect leaves is proportional to strength**power.
    varies
        Whether the optics of the effect differ from image to image.
    noise_realisations
        Number of noise realisations over which the change by the effect is averaged; 0 if the change does not depend on
        noise.
    adds_light
        Whether the effect adds light at places of the detector that stay the same; the truth then has a map of this
        light.
    form_of
        The effect of the gap library of which this withheld effect is another form.
    also
        Effects of the library that the effect brings along, so that it is not wrong to name them.
    saturation_dn
        The level in DN at which high-only images clip, from the effect, all exposures and the plan.
    """

    name: str
    group: str
    step: str
    families: tuple[str, ...]
    unit: str
    nominal: float
    largest: float
    change: Callable[..., Any]
    draw: Mapping[str, Draw]
    power: float = 1.0
    varies: bool = False
    noise_realisations: int = 0
    adds_light: bool = False
    form_of: str | None = None
    also: tuple[str, ...] = ()
    saturation_dn: Callable[[Effect, list[Plane], Plan], float] | None = None

    def drawn(self, plan: Plan, rng: np.random.Generator) -> Effect:
        """An effect of this kind at the nominal strength, with random parameters."""
        parameters = {
            name: float(rng.uniform(*draw)) if isinstance(draw, tuple) else draw(plan, rng)
            for name, draw in self.draw.items()
        }
        return Effect(self, self.nominal, parameters)


EFFECTS: dict[str, EffectKind] = {}


def declare(
    group: str,
    step: str,
    families: tuple[str, ...],
    unit: str,
    nominal: float,
    largest: float,
    options: Mapping[str, Any] | None = None,
    **draw: Draw,
) -> Callable[[Function], Function]:
    """Add the decorated function to EFFECTS, under its own name.

    Parameters
    ----------
    options
        Further fields of `EffectKind`.
    **draw
        The parameters of the effect, and how each is drawn.
    """

    def add(change: Function) -> Function:
        name = change.__name__
        EFFECTS[name] = EffectKind(
            name, group, step, families, unit, nominal, largest, change, draw, **(options or {})
        )
        return change

    return add


@dataclass(frozen=True)
class Effect:
    """An effect: its kind, its strength and its parameters, by name."""

    kind: EffectKind
    strength: float
    parameters: Mapping[str, object]

    def __getitem__(self, name: str) -> Any:
        """The parameter with this name."""
        return self.parameters[name]

    def at(self, strength: float) -> Effect:
        """The same effect with another strength."""
        return replace(self, strength=strength)

    def as_json(self) -> dict[str, object]:
        """The effect for the truth of a case. The entry `cause` is the name of the effect in the gap library; None if
        the library does not contain the effect.
        """
        kind = self.kind
        return {
            "name": kind.name,
            "cause": kind.name if kind.group == KNOWN else kind.form_of,
            "families": list(kind.families),
            "stage": STAGES[kind.families[0]],
            "also": list(kind.also),
            "strength": self.strength,
            "unit": kind.unit,
            "parameters": dict(self.parameters),
        }


def apply_effects(effects: Sequence[Effect], step: str, value: Value, *beside: object) -> Value:
    """The value after a step of the simulation: every effect that acts on this step changes it."""
    for effect in effects:
        if effect.kind.step == step and effect.strength:
            value = effect.kind.change(effect, value, *beside)
    return value


def unit_coordinates(
    shape: tuple[int, ...], angle_deg: float = 0.0, at: tuple[float, float] = (0.5, 0.5)
) -> tuple[Plane, Plane]:
    """Coordinates of the pixels [y, x] along and across a direction, in widths of the field, from a point.

    Parameters
    ----------
    angle_deg
        The direction, from +x towards +y.
    at
        The point (x, y), fractions of the field.
    """
    ny, nx = shape
    u, v = (np.arange(nx)[None, :] + 0.5) / nx - at[0], (np.arange(ny)[:, None] + 0.5) / ny - at[1]
    cos, sin = direction(angle_deg)
    return u * cos + v * sin, v * cos - u * sin


def direction(angle_deg: float) -> tuple[float, float]:
    """Cosine and sine of a direction."""
    return float(np.cos(np.deg2rad(angle_deg))), float(np.sin(np.deg2rad(angle_deg)))


def sign(plan: Plan, rng: np.random.Generator) -> int:
    """1 or -1, drawn at random."""
    return int(rng.choice([-1, 1]))


def coin(plan: Plan, rng: np.random.Generator) -> bool:
    """True or False, drawn at random."""
    return bool(rng.random() < 0.5)


def seed(plan: Plan, rng: np.random.Generator) -> int:
    """A random seed."""
    return int(rng.integers(2**31))


def near_a_disc(spread: float) -> Callable[[Plan, np.random.Generator], tuple[float, float]]:
    """A function that draws a point (x, y), fractions of the field, near a random position of the occulter.

    Parameters
    ----------
    spread
        Rms distance of the points from this position per axis.
    """

    def draw(plan: Plan, rng: np.random.Generator) -> tuple[float, float]:
        shot = plan.shots[int(rng.integers(len(plan.shots)))]
        dx, dy = rng.normal(0, spread, 2)
        return float(shot.x_px / plan.size_px + dx), float(shot.y_px / plan.size_px + dy)

    return draw
