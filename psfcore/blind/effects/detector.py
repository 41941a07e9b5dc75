"""Effects of the detector: changes of the light that reaches it, and of the charge that its pixels collect."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from psfcore.blind.effects.effect import Effect, Moment, angle, unit_coordinates
from psfcore.blind.effects.fine_optics import FINE
from psfcore.blind.effects.scene import patches
from psfcore.simulate.plan import Plan

Plane = NDArray[np.float64]


@dataclass(frozen=True)
class IntensityGradient(Effect):
    """Stray light that increases towards one side: a plane with a small curvature. It is 0 in its darkest corner."""

    angle_deg: float = 0.0
    curvature: float = 0.3

    name: ClassVar[str] = "intensity_gradient"
    unit: ClassVar[str] = "DN/s at its mean"
    cause: ClassVar[str] = "sunlight passes the baffles"
    nominal: ClassVar[float] = 0.5
    largest: ClassVar[float] = 20.0

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, angle(rng), float(rng.uniform(-0.4, 0.4)))

    def light(self, seen: Plane, moment: Moment) -> Plane:
        u, v = unit_coordinates((seen.shape[0], seen.shape[1]))
        along = u * np.cos(np.deg2rad(self.angle_deg)) + v * np.sin(np.deg2rad(self.angle_deg))
        across = v * np.cos(np.deg2rad(self.angle_deg)) - u * np.sin(np.deg2rad(self.angle_deg))
        plane = along + self.curvature * (along**2 - across**2)
        plane = plane - plane.min()
        return seen + self.strength * plane / plane.mean()


@dataclass(frozen=True)
class Glow(Effect):
    """A glow at a fixed position on the detector. Not in the library."""

    x: float = 0.0
    y: float = 0.5
    scale: float = 0.1

    name: ClassVar[str] = "glow"
    unit: ClassVar[str] = "DN/s at its brightest"
    cause: ClassVar[str] = "an amplifier beside the pixels emits light"
    nominal: ClassVar[float] = 5.0
    largest: ClassVar[float] = 400.0

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        shot = plan.shots[int(rng.integers(len(plan.shots)))]
        x, y = shot.x_px / plan.size_px, shot.y_px / plan.size_px
        dx, dy = rng.normal(0, 0.12, 2)
        return cls(strength, float(x + dx), float(y + dy), float(rng.uniform(0.06, 0.15)))

    def light(self, seen: Plane, moment: Moment) -> Plane:
        u, v = unit_coordinates((seen.shape[0], seen.shape[1]))
        r = np.hypot(u + 0.5 - self.x, v + 0.5 - self.y)
        return seen + self.strength / (1 + (r / self.scale) ** 2) ** 2


@dataclass(frozen=True)
class DustShadow(Effect):
    """Dust specks with soft edges, near positions of the occulter, block light. Not in the gap library."""

    specks: tuple[tuple[float, float, float], ...] = ((0.5, 0.5, 6.0),)

    name: ClassVar[str] = "dust_shadow"
    unit: ClassVar[str] = "share of light blocked"
    cause: ClassVar[str] = "dust settled on the detector after the flat field was taken"
    nominal: ClassVar[float] = 0.1
    largest: ClassVar[float] = 0.9

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        shots = rng.choice(len(plan.shots), size=max(1, len(plan.shots) // 5), replace=False)
        specks = []
        for index in sorted(shots):
            shot = plan.shots[int(index)]
            dx, dy = rng.normal(0, 3.0, 2)
            specks.append(
                (
                    float((shot.x_px + dx) / plan.size_px),
                    float((shot.y_px + dy) / plan.size_px),
                    float(rng.uniform(4, 9)),
                )
            )
        return cls(strength, tuple(specks))

    def light(self, seen: Plane, moment: Moment) -> Plane:
        u, v = unit_coordinates((seen.shape[0], seen.shape[1]))
        passed = np.ones_like(seen)
        for x, y, radius_px in self.specks:
            r_px = np.hypot(u + 0.5 - x, v + 0.5 - y) * seen.shape[0] / FINE
            passed *= 1 - self.strength / (1 + np.exp(np.minimum((r_px - radius_px) / 0.7, 500.0)))
        return seen * passed


@dataclass(frozen=True)
class FlatFieldResidual(Effect):
    """Uneven sensitivity: broad patches, and a pixel-to-pixel variation with half the rms of the patches.

    strength: rms of the patches.
    """

    seed: int = 0
    patch: float = 0.1

    name: ClassVar[str] = "flat_field_residual"
    unit: ClassVar[str] = "share, rms"
    cause: ClassVar[str] = "the flat field was taken long ago"
    nominal: ClassVar[float] = 0.03
    largest: ClassVar[float] = 0.3

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, int(rng.integers(2**31)), float(rng.uniform(0.05, 0.25)))

    def expected(self, rate: Plane, moment: Moment) -> Plane:
        n = rate.shape[0]
        pattern = patches(n, self.seed, self.patch) + 0.5 * _grain(n, self.seed)
        return rate * np.maximum(1 + self.strength * pattern, 0.0)


@cache
def _grain(size: int, seed: int) -> Plane:
    return np.random.default_rng([seed, 1]).standard_normal((size, size))


@dataclass(frozen=True)
class ShutterGradient(Effect):
    """One side of the field is exposed longer than the other. Not in the library.

    strength: the difference of the exposure times at the two edges, s.
    """

    angle_deg: float = 0.0

    name: ClassVar[str] = "shutter_gradient"
    unit: ClassVar[str] = "s"
    cause: ClassVar[str] = "the shutter moves unevenly"
    nominal: ClassVar[float] = 0.05
    largest: ClassVar[float] = 0.6

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, angle(rng))

    def expected(self, rate: Plane, moment: Moment) -> Plane:
        u, v = unit_coordinates((rate.shape[0], rate.shape[1]))
        along = u * np.cos(np.deg2rad(self.angle_deg)) + v * np.sin(np.deg2rad(self.angle_deg))
        return rate * np.maximum(1 + self.strength * along / moment.shot.exposure_s, 0.0)


@dataclass(frozen=True)
class DarkCurrentDrift(Effect):
    """A dark current that grows during the transit and reaches `strength` at its end. Not in the library."""

    steepness: float = 2.0

    name: ClassVar[str] = "dark_current_drift"
    unit: ClassVar[str] = "DN/s at the end"
    cause: ClassVar[str] = "the detector warms"
    nominal: ClassVar[float] = 1.0
    largest: ClassVar[float] = 30.0

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, float(rng.uniform(0.5, 3)))

    def expected(self, rate: Plane, moment: Moment) -> Plane:
        return rate + self.strength * np.expm1(self.steepness * moment.elapsed) / np.expm1(self.steepness)


@dataclass(frozen=True)
class BrighterFatter(Effect):
    """Collected charge repels new charge into fainter neighbouring pixels. Not in the library.

    strength: the signal that moves from the brighter to the fainter of two neighbouring pixels, divided by the
    difference of the two pixels. This ratio holds for two pixels with a mean of 1000 DN.
    """

    name: ClassVar[str] = "brighter_fatter"
    unit: ClassVar[str] = "per 1000 DN"
    cause: ClassVar[str] = "the electric field of the collected charge repels new charge"
    nominal: ClassVar[float] = 0.02
    largest: ClassVar[float] = 0.15

    def expected(self, rate: Plane, moment: Moment) -> Plane:
        out = rate.copy()
        for axis in (0, 1):
            full = np.moveaxis(rate, axis, 0)
            mean_dn = 0.5 * (full[1:] + full[:-1]) * moment.shot.exposure_s
            share = np.minimum(self.strength * mean_dn / 1000, 0.2)
            flow = share * (full[1:] - full[:-1])
            view = np.moveaxis(out, axis, 0)
            view[1:] -= flow
            view[:-1] += flow
        return out


DETECTOR_EFFECTS: tuple[type[Effect], ...] = (
    IntensityGradient,
    Glow,
    DustShadow,
    FlatFieldResidual,
    ShutterGradient,
    DarkCurrentDrift,
    BrighterFatter,
)
