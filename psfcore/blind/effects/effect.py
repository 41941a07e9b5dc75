"""An effect of the blind set: a strength, drawn parameters, and the steps of the simulation that it changes.

    scene -> occulter -> optics -> light on fine pixels -> light on detector pixels -> photons -> readout

An effect changes one or two of these steps. An effect of strength 0 changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.blind.effects.fine_optics import FineOptics
from psfcore.simulate.plan import Plan, Shot
from psfcore.transit.transit import Place

Plane = NDArray[np.float64]


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
class Window:
    """The pixels around a disc. place: the position of the disc. first, shape: the first detector pixel (y, x), and the size."""

    place: Place
    first: tuple[int, int]
    shape: tuple[int, int]


@dataclass(frozen=True)
class Kind:
    """A kind of effect. Every step is a function of the effect and of what it changes; None: the kind does not change this step.

    unit: the unit of the strength. cause: the physical cause, as text. nominal: a strength whose change is visible in
    the discs. largest: the largest plausible strength. draw: draws the parameters. power: the residual that the effect leaves is
    proportional to strength**power. varies: whether its optics differ from image to image. noise_realisations: number of noise
    realisations over which its change is averaged; 0 if the change does not depend on noise.

    scene: changes the fine scene [y, x], DN/s. covered: changes the fraction of each fine pixel of a window that the occulter
    covers; None: the fraction that a disc at rest covers. optics: changes the telescope. spread: changes the fine light [y, x],
    DN/s, if the PSF varies across the field; it also gets the fine scene with its occulter, and the telescope. light: changes the
    fine light in the focal plane [y, x], DN/s. expected: changes the light on detector pixels [y, x], DN/s, before photon noise.
    read_out: changes one exposure [y, x], in DN with noise; it also gets the images that were read before. saturation_dn: the level
    in DN at which high-only images clip, from all exposures.
    """

    name: str
    stage: str
    unit: str
    cause: str
    nominal: float
    largest: float
    draw: Callable[[Plan, np.random.Generator], dict[str, Any]] = lambda plan, rng: {}
    power: float = 1.0
    varies: bool = False
    noise_realisations: int = 0
    scene: Callable[[Effect, Plane, Moment], Plane] | None = None
    covered: Callable[[Effect, Plane | None, Window, Moment], Plane | None] | None = None
    optics: Callable[[Effect, FineOptics, Moment], FineOptics] | None = None
    spread: Callable[[Effect, Plane, Plane, FineOptics, Moment], Plane] | None = None
    light: Callable[[Effect, Plane, Moment], Plane] | None = None
    expected: Callable[[Effect, Plane, Moment], Plane] | None = None
    read_out: Callable[[Effect, Plane, Moment, list[Earlier]], Plane] | None = None
    saturation_dn: Callable[[Effect, list[Plane], Plan], float] | None = None

    def drawn(self, plan: Plan, rng: np.random.Generator) -> Effect:
        """An effect of this kind at the nominal strength, with random parameters."""
        return Effect(self, self.nominal, self.draw(plan, rng))


@dataclass(frozen=True)
class Effect:
    """An effect: its kind, its strength and its parameters, by name."""

    kind: Kind
    strength: float
    parameters: Mapping[str, Any]

    def __getitem__(self, name: str) -> Any:
        """The parameter with this name."""
        return self.parameters[name]

    def at(self, strength: float) -> Effect:
        """The same effect with another strength."""
        return replace(self, strength=strength)

    def as_json(self) -> dict[str, Any]:
        """Name, strength, unit and parameters of the effect, as JSON."""
        parameters = dict(self.parameters)
        return {
            "name": self.kind.name,
            "strength": self.strength,
            "unit": self.kind.unit,
            "parameters": parameters,
        }


def apply_effects(effects: Sequence[Effect], step: str, value: Any, *beside: Any) -> Any:
    """The value after a step of the simulation: every effect that acts on this step changes it. step: a field of `Kind`."""
    for effect in effects:
        change = getattr(effect.kind, step)
        if change is not None and effect.strength:
            value = change(effect, value, *beside)
    return value


def acts_on(effect: Effect, *steps: str) -> bool:
    """Whether an effect changes at least one of these steps."""
    return effect.strength != 0 and any(getattr(effect.kind, step) is not None for step in steps)


def unit_coordinates(shape: tuple[int, ...]) -> tuple[Plane, Plane]:
    """Coordinates of the pixels: u (1, nx) along x and v (ny, 1) along y, each from -0.5 to 0.5 across the field."""
    ny, nx = shape
    return (np.arange(nx)[None, :] + 0.5) / nx - 0.5, (np.arange(ny)[:, None] + 0.5) / ny - 0.5


def direction(angle_deg: float) -> tuple[float, float]:
    """Cosine and sine of a direction."""
    return float(np.cos(np.deg2rad(angle_deg))), float(np.sin(np.deg2rad(angle_deg)))


def angle(rng: np.random.Generator) -> float:
    """A random direction, degrees."""
    return float(rng.uniform(0, 360))


def sign(rng: np.random.Generator) -> int:
    """1 or -1, drawn at random."""
    return int(rng.choice([-1, 1]))


def seed(rng: np.random.Generator) -> int:
    """A random seed."""
    return int(rng.integers(2**31))
