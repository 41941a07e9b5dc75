"""Simulate exposures from scenes, on fine pixels, with any effects at each step.

    fine light = spread(P (S - h))  ->  light()  ->  binned  ->  expected()  ->  photons, read noise  ->  read_out()
    ->  whole DN

S is the scene, h is the part of S that the occulter hides, and P is the convolution with the PSF. "binned" averages
the fine pixels of each detector pixel; the other names are steps of `effects.effect`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from psfcore.blind.effects.effect import Earlier, Effect, Moment, Plane, apply_effects
from psfcore.blind.effects.fine_optics import FINE, FineOptics
from psfcore.simulate.plan import HIGH, Plan
from psfcore.simulate.sky import behind, binned, covered_share
from psfcore.transit.transit import Place

_SKY_STEPS = ("scene", "covered", "foreground", "optics", "spread")
_MOST_MOTION_PX = 5.0  # largest distance of a moving disc from its position in the middle of the exposure
_REALISATIONS_STREAM, _NOISE_STREAM = 2001, 2002


@dataclass(frozen=True, eq=False)
class EffectFree:
    """A plan, its telescope and its scenes without any effect.

    Attributes
    ----------
    scenes
        Fine scenes [y, x], DN/s, by pointing. Along each axis, FINE fine pixels cover one detector pixel.
    """

    plan: Plan
    optics: FineOptics
    scenes: Mapping[int, Plane]

    @cached_property
    def lights(self) -> list[NDArray[np.float32]]:
        """The light of every image in the focal plane, on fine pixels [y, x], DN/s; computed once for many
        simulations.
        """
        return [light.astype(np.float32) for light in focal_planes(self, ())]


class Simulation:
    """The simulation of the images of a plan with a set of effects. Each result is computed once and kept.

    Parameters
    ----------
    seed
        The seed of the noise.
    headroom
        The level at which high-only images clip, divided by the brightest pixel, if no effect sets this level; None: no
        clipping.
    """

    def __init__(
        self, clean: EffectFree, effects: Sequence[Effect], seed: int, headroom: float | None = None
    ) -> None:
        self.clean, self.plan, self.effects, self.seed = clean, clean.plan, tuple(effects), seed
        self.headroom = headroom

    def with_effects(self, *effects: Effect) -> Simulation:
        """The same simulation with other effects."""
        return Simulation(self.clean, effects, self.seed, self.headroom)

    @cached_property
    def rates(self) -> list[Plane]:
        """The expected light of every image on detector pixels [y, x], DN/s, before the readout. It contains no
        noise.
        """
        lights: Iterable[NDArray[np.floating]] = self.clean.lights
        if any(effect.strength and effect.kind.step in _SKY_STEPS for effect in self.effects):
            lights = focal_planes(self.clean, self.effects)
        rates = []
        for index, plane in enumerate(lights):
            moment = Moment(self.plan, index)
            light = apply_effects(self.effects, "light", plane.astype(np.float64), moment)
            rate = apply_effects(self.effects, "expected", binned(np.maximum(light, 0.0), FINE), moment)
            rates.append(np.maximum(rate, 0.0))
        return rates

    @cached_property
    def level(self) -> float | None:
        """The level (DN) at which high-only images clip; None: no clipping."""
        for effect in self.effects:
            if effect.kind.saturation_dn is not None and effect.strength:
                return effect.kind.saturation_dn(effect, self._exposures, self.plan)
        return None if self.headroom is None else float(np.rint(self.headroom * np.max(self._exposures)))

    def read_out(self) -> list[Plane]:
        """The exposures in whole DN [y, x], with noise and clipping."""
        return [np.rint(dn) for dn in self._clipped(self._through_readout(self._noisy(_NOISE_STREAM)))]

    @cached_property
    def mean(self) -> list[Plane]:
        """Clipped images [y, x], DN/s, that are approximately the mean of many exposures.

        If the change by an effect during the readout depends on noise, this change is averaged over noise realisations.
        """
        realisations = max((effect.kind.noise_realisations for effect in self.effects), default=0)
        mean = list(self._exposures) if realisations else self._through_readout(self._exposures)
        for number in range(realisations):
            noisy = self._noisy(_REALISATIONS_STREAM, number)
            for n, after in enumerate(self._through_readout(noisy)):
                mean[n] = mean[n] + (after - noisy[n]) / realisations
        shots = zip(self._clipped(mean), self.plan.shots, strict=True)
        return [dn / shot.exposure_s for dn, shot in shots]

    @property
    def _exposures(self) -> list[Plane]:
        return [rate * shot.exposure_s for rate, shot in zip(self.rates, self.plan.shots, strict=True)]

    def _clipped(self, exposures: Sequence[Plane]) -> list[Plane]:
        return [
            dn if self.level is None or shot.gain_mode != HIGH else np.minimum(dn, self.level)
            for dn, shot in zip(exposures, self.plan.shots, strict=True)
        ]

    def _noisy(self, *stream: int) -> list[Plane]:
        return [
            self.plan.noise.observe(rate, shot.exposure_s, np.random.default_rng([self.seed, *stream, n]))
            * shot.exposure_s
            for n, (rate, shot) in enumerate(zip(self.rates, self.plan.shots, strict=True))
        ]

    def _through_readout(self, exposures: Sequence[Plane]) -> list[Plane]:
        out, earlier = [], list[Earlier]()
        for index, (before, dn) in enumerate(zip(self._exposures, exposures, strict=True)):
            moment = Moment(self.plan, index)
            out.append(apply_effects(self.effects, "read_out", dn, moment, earlier))
            earlier.append(Earlier(before, moment.shot.time_s))
        return out


def focal_planes(clean: EffectFree, effects: Sequence[Effect]) -> Iterator[NDArray[np.floating]]:
    """The light of every image in the focal plane, on fine pixels [y, x], DN/s, with effects of the steps up to it."""
    varies = any(effect.kind.varies for effect in effects)
    for index in range(len(clean.plan.shots)):
        moment = Moment(clean.plan, index)
        if index == 0 or varies:
            optics = apply_effects(effects, "optics", clean.optics, moment)
        lit = lit_scene(clean, effects, moment)
        yield apply_effects(effects, "spread", optics.through.apply(lit), lit, optics, moment)


def lit_scene(clean: EffectFree, effects: Sequence[Effect], moment: Moment) -> Plane:
    """The fine scene of an image, with its occulter in front [y, x], DN/s."""
    scene = apply_effects(effects, "scene", clean.scenes[moment.shot.pointing], moment)
    lit, place = scene.copy(), clean.plan.place(moment.index)
    # The patch must contain a moving disc.
    wide = Place(place.x_px, place.y_px, place.radius_px + _MOST_MOTION_PX)
    around = behind(scene, wide, fine=FINE, margin_px=0)
    share = covered_share(place, around.first, around.shape, FINE)
    share = apply_effects(effects, "covered", share, around, moment)
    rows, columns = (slice(s.start * FINE, s.stop * FINE) for s in around.window())
    lit[rows, columns] -= around.scene * share
    return np.asarray(apply_effects(effects, "foreground", np.maximum(lit, 0.0), moment))
