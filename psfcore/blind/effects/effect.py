"""The base class of the effects of the blind set: a strength, a cause, and the steps of the simulation that it changes.

    scene -> occulter -> optics -> light on fine pixels -> light on detector pixels -> photons -> readout

An effect changes one or two of these steps. An effect of strength 0 changes nothing.
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
class Effect:
    """The base class of all effects. It changes no step of the simulation.

    unit: the unit of the strength. cause: the physical cause, as text. nominal: a strength whose change is visible in
    the discs. largest: the largest plausible strength. power: the residual that the effect leaves is proportional to
    strength**power. varies: whether its optics differ from image to image. noise_realisations: number of noise
    realisations over which its change is averaged; 0 if the change does not depend on noise.
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
    noise_realisations: ClassVar[int] = 0

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        """This effect with a given strength. The other parameters are drawn at random."""
        return cls(strength)

    def at(self, strength: float) -> Self:
        """The same effect with another strength."""
        return dataclasses.replace(self, strength=strength)

    def as_json(self) -> dict[str, Any]:
        """Name, strength and parameters of the effect, as JSON."""
        values = {key: value for key, value in dataclasses.asdict(self).items() if key != "strength"}
        return {"name": self.name, "strength": self.strength, "unit": self.unit, "parameters": values}

    def scene(self, scene: Plane, moment: Moment) -> Plane:
        """Change the fine scene [y, x], DN/s."""
        return scene

    def covered(
        self,
        share: Plane | None,
        place: Place,
        first: tuple[int, int],
        shape: tuple[int, int],
        moment: Moment,
    ) -> Plane | None:
        """Change the fraction of each fine pixel [y, x] of a window that the occulter covers.

        share: this fraction; None: the fraction that a disc at rest covers. place: the position of the disc. first,
        shape: the first detector pixel (y, x) and the size of the window. The default returns `share`.
        """
        return share

    def optics(self, optics: FineOptics, moment: Moment) -> FineOptics:
        """Change the telescope."""
        return optics

    def spread(self, seen: Plane, lit: Plane, optics: FineOptics, moment: Moment) -> Plane:
        """Change the fine light `seen` [y, x], DN/s, if the PSF varies across the field. lit: the fine scene with its occulter."""
        return seen

    def light(self, seen: Plane, moment: Moment) -> Plane:
        """Change the fine light in the focal plane [y, x], DN/s."""
        return seen

    def expected(self, rate: Plane, moment: Moment) -> Plane:
        """Change the light on detector pixels [y, x], DN/s, before photon noise."""
        return rate

    def read_out(self, dn: Plane, moment: Moment, earlier: list[Earlier]) -> Plane:
        """Change the values of one exposure [y, x], in DN with noise. earlier: the images that were read before."""
        return dn

    def saturation_dn(self, exposures: list[Plane], plan: Plan) -> float | None:
        """The level in DN at which high-only images clip; None if the effect sets no level."""
        return None


def acts_on(effect: Effect, *steps: str) -> bool:
    """Whether an effect changes at least one of these steps (names of methods)."""
    return any(getattr(type(effect), step) is not getattr(Effect, step) for step in steps)


def unit_coordinates(shape: tuple[int, int]) -> tuple[Plane, Plane]:
    """Coordinates of the pixels: u (1, nx) along x and v (ny, 1) along y, each from -0.5 to 0.5 across the field."""
    ny, nx = shape
    return (np.arange(nx)[None, :] + 0.5) / nx - 0.5, (np.arange(ny)[:, None] + 0.5) / ny - 0.5


def angle(rng: np.random.Generator) -> float:
    """A random direction, degrees."""
    return float(rng.uniform(0, 360))
