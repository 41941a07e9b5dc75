"""Effects of the scene: changes of the Sun and of the occulter."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, zoom

from psfcore.blind.effects.effect import Effect, Moment, angle
from psfcore.blind.effects.fine_optics import FINE
from psfcore.simulate.disc import covered_share
from psfcore.simulate.plan import HIGH, Plan
from psfcore.transit.transit import Place

Plane = NDArray[np.float64]


@dataclass(frozen=True)
class OcculterMotion(Effect):
    """The disc moves along a straight line during the exposure. It is simulated in steps of at most a fifth of a pixel."""

    angle_deg: float = 0.0

    name: ClassVar[str] = "occulter_motion"
    stage: ClassVar[str] = "scene"
    unit: ClassVar[str] = "px/s"
    cause: ClassVar[str] = "the occulter moves across the field during the exposure"
    nominal: ClassVar[float] = 0.4
    largest: ClassVar[float] = 1.5

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, angle_deg=float(rng.normal(3.0, 8.0)))

    def covered(
        self,
        share: Plane | None,
        place: Place,
        first: tuple[int, int],
        shape: tuple[int, int],
        moment: Moment,
    ) -> Plane | None:
        way = self.strength * moment.shot.exposure_s
        if way == 0:
            return share
        steps = max(5, int(np.ceil(5 * way)))
        along = way * ((np.arange(steps) + 0.5) / steps - 0.5)
        cos, sin = np.cos(np.deg2rad(self.angle_deg)), np.sin(np.deg2rad(self.angle_deg))
        moved = (Place(place.x_px + s * cos, place.y_px + s * sin, place.radius_px) for s in along)
        return np.asarray(sum(covered_share(at, first, shape, FINE) for at in moved) / steps)


@dataclass(frozen=True)
class SceneEvolution(Effect):
    """Patches of the Sun brighten and fade with the same period, but with different phases."""

    seed: int = 0
    patch: float = 0.05
    period: float = 0.3

    name: ClassVar[str] = "scene_evolution"
    stage: ClassVar[str] = "scene"
    unit: ClassVar[str] = "share, rms"
    cause: ClassVar[str] = "the Sun changes between the images of a pointing"
    nominal: ClassVar[float] = 0.2
    largest: ClassVar[float] = 0.6

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(
            strength, int(rng.integers(2**31)), float(rng.uniform(0.02, 0.08)), float(rng.uniform(0.15, 0.6))
        )

    def scene(self, scene: Plane, moment: Moment) -> Plane:
        if self.strength == 0:
            return scene
        phase = 2 * np.pi * moment.elapsed / self.period
        first, second = (
            patches(scene.shape[0], self.seed + 10 * moment.shot.pointing + k, self.patch) for k in (0, 1)
        )
        change = self.strength * (first * np.sin(phase) + second * (np.cos(phase) - 1))
        return np.asarray(scene * np.exp(change - change.var() / 2))


@dataclass(frozen=True)
class OutOfFieldLight(Effect):
    """In each pointing, a bright band beyond one edge of the field scatters light into the field.

    strength: the brightness of the band in a pointing is `strength` times the entry of `levels`. The band is half as
    wide as the field, and begins a twelfth of the field beyond the edge. edges: the edge of each pointing; 0 left, 1
    right, 2 below, 3 above. b_px, c, a: parameters of the power law that scatters the light of the band.
    """

    edges: tuple[int, ...] = (0, 1, 1)
    levels: tuple[float, ...] = (1.0, 1.0, 1.0)
    b_px: float = 6.0
    c: float = 2.5
    a: float = 0.5

    name: ClassVar[str] = "out_of_field_light"
    stage: ClassVar[str] = "scene"
    unit: ClassVar[str] = "DN/s"
    cause: ClassVar[str] = "light from the Sun beyond the edge of the detector is scattered into the field"
    nominal: ClassVar[float] = 400.0
    largest: ClassVar[float] = 4000.0

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        edges = tuple(int(edge) for edge in rng.integers(0, 4, len(plan.views)))
        levels = tuple(float(level) for level in rng.uniform(0.3, 1.0, len(plan.views)))
        return cls(
            strength,
            edges,
            levels,
            float(rng.uniform(4, 8)),
            float(rng.uniform(2.4, 2.6)),
            float(rng.uniform(0.3, 0.7)),
        )

    def light(self, seen: Plane, moment: Moment) -> Plane:
        if self.strength == 0:
            return seen
        pointing = moment.shot.pointing
        edge, level = self.edges[pointing - 1], self.levels[pointing - 1]
        return seen + self.strength * level * _band(seen.shape[0], edge, self.b_px, self.c, self.a)


@cache
def _band(fine_size: int, edge: int, b_px: float, c: float, a: float) -> Plane:
    """The light [y, x] that is scattered into the field from a band of 1 DN/s beyond one edge.

    This light is smooth, so it is computed on a coarse grid and interpolated.
    """
    size = fine_size // FINE
    step = size / 32
    at = (np.arange(32) + 0.5) * step
    sources = -(size / 12) - (np.arange(16) + 0.5) * step
    along = np.linspace(-size / 2, 1.5 * size, 64)
    area = step * (along[1] - along[0])
    far = (at[:, None] - sources[None, :]) ** 2
    beside = (at[:, None] - along[None, :]) ** 2
    distance = np.sqrt(far[None, :, :, None] + beside[:, None, None, :])
    coarse = a * area * ((b_px + distance) ** -c).sum(axis=(2, 3))  # [y, x], the band to the left
    plane = zoom(coarse, fine_size / 32, order=3, mode="nearest", grid_mode=True)
    turned = {0: plane, 1: plane[:, ::-1], 2: plane.T, 3: plane.T[::-1]}[edge]
    return np.ascontiguousarray(np.maximum(turned, 0.0))


@dataclass(frozen=True)
class LimbGlint(Effect):
    """Additional light in one pointing: rays that spread from a point beyond the edge of the field. Not in the library."""

    pointing: int = 1
    angle_deg: float = 0.0
    rays: int = 3
    phase_deg: float = 0.0

    name: ClassVar[str] = "limb_glint"
    stage: ClassVar[str] = "scene"
    unit: ClassVar[str] = "DN/s"
    cause: ClassVar[str] = "in one pointing an edge of the baffle reflects sunlight"
    nominal: ClassVar[float] = 1.0
    largest: ClassVar[float] = 60.0

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        pointing = int(rng.choice([1, len(plan.views)]))
        return cls(strength, pointing, angle(rng), int(rng.integers(2, 6)), angle(rng))

    def light(self, seen: Plane, moment: Moment) -> Plane:
        if moment.shot.pointing != self.pointing or self.strength == 0:
            return seen
        n = seen.shape[0]
        x = (np.arange(n)[None, :] + 0.5) / n - 0.5 - 0.8 * np.cos(np.deg2rad(self.angle_deg))
        y = (np.arange(n)[:, None] + 0.5) / n - 0.5 - 0.8 * np.sin(np.deg2rad(self.angle_deg))
        fan = np.cos(2 * self.rays * np.arctan2(y, x) + np.deg2rad(self.phase_deg)) ** 2
        return seen + self.strength * (0.2 + fan) * np.exp(-np.hypot(x, y) / 0.5) / np.exp(-1.6)


@dataclass(frozen=True)
class SaturationFill(Effect):
    """High-only images clip bright pixels. These pixels also flicker, so other images show other values in them.

    strength: the fraction of the light that is lost by clipping.
    """

    seed: int = 0
    flicker: float = 0.3

    name: ClassVar[str] = "saturation_fill"
    stage: ClassVar[str] = "scene"
    unit: ClassVar[str] = "share of the light above the level"
    cause: ClassVar[str] = "clipped pixels are filled from another image, or stay clipped"
    nominal: ClassVar[float] = 0.03
    largest: ClassVar[float] = 0.15

    @classmethod
    def drawn(cls, strength: float, plan: Plan, rng: np.random.Generator) -> Self:
        return cls(strength, int(rng.integers(2**31)), float(rng.uniform(0.15, 0.5)))

    def scene(self, scene: Plane, moment: Moment) -> Plane:
        if self.strength == 0:
            return scene
        bright = scene > np.quantile(scene[::4, ::4], 0.98)
        phase = patches(scene.shape[0], self.seed + moment.shot.pointing, 0.1)
        swing = self.flicker * self.strength / (self.strength + 0.005)
        factor = 1 + swing * np.sin(40 * moment.elapsed + 2 * phase)
        return np.where(bright, scene * factor, scene)

    def saturation_dn(self, exposures: list[Plane], plan: Plan) -> float | None:
        if self.strength == 0:
            return None
        high = [dn for dn, shot in zip(exposures, plan.shots, strict=True) if shot.gain_mode == HIGH]
        values = np.concatenate([np.maximum(dn, 0.0).ravel() for dn in high])
        low, top = 0.0, float(values.max())
        for _ in range(40):
            level = (low + top) / 2
            lost = float(np.maximum(values - level, 0.0).sum() / values.sum())
            low, top = (level, top) if lost > self.strength else (low, level)
        return float(np.rint(top))


@cache
def patches(size: int, seed: int, patch: float) -> Plane:
    """A smooth random plane [y, x] with mean 0 and rms 1. patch: the size of its patches, as a fraction of the field."""
    rng = np.random.default_rng(seed)
    coarse = max(8, int(np.ceil(4 / patch)))
    drawn = gaussian_filter(rng.standard_normal((coarse, coarse)), 1.5)
    plane = zoom(drawn, size / coarse, order=3, grid_mode=True, mode="nearest")
    return np.asarray((plane - plane.mean()) / plane.std())


SCENE_EFFECTS: tuple[type[Effect], ...] = (
    OcculterMotion,
    SceneEvolution,
    OutOfFieldLight,
    SaturationFill,
    LimbGlint,
)
