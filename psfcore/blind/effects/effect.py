"""What an effect of the blind set is: a strength, what it is due to, and where along the light's way it acts.

    scene -> occulter -> optics -> light on fine pixels -> light on detector pixels -> photons -> readout

An effect changes one or two of these steps and leaves the others as they are. Strength 0 changes nothing.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from psfcore.blind.effects.fine_optics import FineOptics
from psfcore.simulate.plan import Plan, Shot
from psfcore.transit.transit import Place

Plane = NDArray[np.float64]


@dataclass(frozen=True)
class Moment:
    """One image of a plan. elapsed: 0 at the first image to 1 at the last."""

    plan: Plan
    index: int

    @property
    def shot(self) -> Shot:
        """Pointing, exposure and gain mode."""
        return self.plan.shots[self.index]

    @property
    def elapsed(self) -> float:
        """How much of the transit has passed."""
        first, last = self.plan.shots[0].time_s, self.plan.shots[-1].time_s
        return (self.shot.time_s - first) / max(last - first, 1e-9)


@dataclass(frozen=True)
class Earlier:
    """An image that was read before: DN [y, x] without its noise, and when, s."""

    dn: Plane
    time_s: float


@dataclass(frozen=True)
class Effect:
    """The base: every step handed through.

    name, stage, unit (of strength), cause: in words. nominal: a strength that shows; largest: as far as it is believed.
    power: how what it leaves grows with its strength. varies: its optics differ from image to image.
    draws: noise draws that its mean change is taken over (0: the change does not depend on noise).
    """

    strength: float

    name: ClassVar[str] = "effect"
    stage: ClassVar[str] = "detector"
    unit: ClassVar[str] = ""
    cause: ClassVar[str] = ""
    nominal: ClassVar[float] = 1.0
    largest: ClassVar[float] = 1.0
    power: ClassVar[float] = 1.0
    varies: ClassVar[bool] = False
    draws: ClassVar[int] = 0

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        """This effect at a strength, its other parameters at random."""
        return cls(strength)

    def at(self, strength: float) -> Self:
        """The same effect at another strength."""
        return dataclasses.replace(self, strength=strength)

    def as_json(self) -> dict[str, Any]:
        """Name, strength and parameters, plain values."""
        values = {key: value for key, value in dataclasses.asdict(self).items() if key != "strength"}
        return {"name": self.name, "strength": self.strength, "unit": self.unit, "parameters": values}

    def scene(self, scene: Plane, moment: Moment) -> Plane:
        """Fine scene [y, x], DN/s."""
        return scene

    def covered(
        self,
        share: Plane | None,
        place: Place,
        first: tuple[int, int],
        shape: tuple[int, int],
        moment: Moment,
    ) -> Plane | None:
        """Share of each fine pixel that the occulter hides in a window; None where it is the disc at rest."""
        return share

    def optics(self, optics: FineOptics, moment: Moment) -> FineOptics:
        """The telescope."""
        return optics

    def spread(self, seen: Plane, lit: Plane, optics: FineOptics, moment: Moment) -> Plane:
        """Fine light [y, x] of a fine lit scene, DN/s, where the PSF differs from place to place."""
        return seen

    def light(self, seen: Plane, moment: Moment) -> Plane:
        """Fine light in the focal plane [y, x], DN/s."""
        return seen

    def expected(self, rate: Plane, moment: Moment) -> Plane:
        """Light on detector pixels [y, x], DN/s, before it is counted."""
        return rate

    def read_out(self, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
        """DN of one exposure [y, x], noise in them."""
        return dn

    def saturation_dn(self, exposures: list[Plane], plan: Plan) -> float | None:
        """The level that high-only images clip at, of their DN; None where the effect sets none."""
        return None


def acts_on(effect: Effect, *steps: str) -> bool:
    """Whether an effect changes one of these steps."""
    return any(getattr(type(effect), step) is not getattr(Effect, step) for step in steps)


def unit_coordinates(shape: tuple[int, int]) -> tuple[Plane, Plane]:
    """u (1, nx) and v (ny, 1): place along x and y, -0.5 to 0.5."""
    ny, nx = shape
    return (np.arange(nx)[None, :] + 0.5) / nx - 0.5, (np.arange(ny)[:, None] + 0.5) / ny - 0.5


def angle(rng: np.random.Generator) -> float:
    """A direction, degrees."""
    return float(rng.uniform(0, 360))
