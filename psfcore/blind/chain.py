"""Simulate exposures from scenes, on fine pixels, with any effects at each step.

    fine light = spread(P (S - h))  ->  light()  ->  binned  ->  expected()  ->  photons, read noise  ->  read_out()  ->  whole DN

S is the scene, h is the part of S that the occulter hides, and P is the convolution with the PSF. "binned" averages the fine
pixels of each detector pixel; the other names are steps of `effects.effect.STAGES`. Because P is linear, the scene of a
pointing is convolved only once. For each image, only the difference between its scene with the occulter (S - h) and the
scene of its pointing is convolved.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from psfcore.blind.effects.effect import Earlier, Effect, Moment, apply_effects
from psfcore.blind.effects.fine_optics import FINE, FineOptics
from psfcore.simulate.plan import HIGH, Plan
from psfcore.simulate.sky import behind, binned, covered_share
from psfcore.transit.transit import Place

Plane = NDArray[np.float64]
_SKY_STEPS = ("scene", "covered", "foreground", "optics", "spread")
_MOST_MOTION_PX = 5.0  # largest distance of a moving disc from its position in the middle of the exposure
_REALISATIONS_STREAM, _NOISE_STREAM = 2001, 2002


class EffectFree:
    """The images of a plan without any effect, on fine pixels. Each result is computed once and kept.

    scenes: fine scenes [y, x], DN/s, by pointing. Along each axis, FINE fine pixels cover one detector pixel.
    """

    def __init__(self, plan: Plan, optics: FineOptics, scenes: Mapping[int, Plane]) -> None:
        self.plan, self.optics, self.scenes = plan, optics, scenes
        self._light: dict[int, NDArray[np.float32]] = {}
        self._seen: dict[int, Plane] = {}

    def light(self, index: int) -> Plane:
        """The light of an image in the focal plane, on fine pixels [y, x], DN/s."""
        if index not in self._light:
            moment = Moment(self.plan, index)
            light = self.seen(lit_scene(self, (), moment), moment, self.optics, self._seen)
            self._light[index] = light.astype(np.float32)
        return self._light[index].astype(np.float64)

    def seen(self, lit: Plane, moment: Moment, optics: FineOptics, kept: dict[int, Plane]) -> Plane:
        """A fine scene through a telescope, [y, x], DN/s.

        kept: the scene of each pointing through the same telescope, without an occulter; missing scenes are added.
        """
        pointing = moment.shot.pointing
        scene = self.scenes[pointing]
        if pointing not in kept:
            kept[pointing] = np.asarray(optics.through.apply(scene), dtype=np.float64)
        return np.asarray(kept[pointing] + optics.through.apply(lit - scene))


class Chain:
    """The simulation of the images of a plan with a set of effects.

    level: the level (DN) at which high-only images clip if no effect sets it; None: no clipping.
    """

    def __init__(self, clean: EffectFree, effects: Sequence[Effect], level: float | None = None) -> None:
        self.clean, self.plan, self.effects, self.level = clean, clean.plan, tuple(effects), level
        self._changes_sky = any(e.strength and e.kind.step in _SKY_STEPS for e in self.effects)
        self._varies = any(effect.kind.varies for effect in self.effects)
        self._optics: FineOptics | None = None
        self._seen: dict[int, Plane] = {}

    def expected(self, index: int) -> Plane:
        """The expected light on detector pixels [y, x], DN/s, before the readout. It contains no noise."""
        moment = Moment(self.plan, index)
        light = self._focal_plane(moment) if self._changes_sky else self.clean.light(index)
        light = apply_effects(self.effects, "light", light, moment)
        rate = apply_effects(self.effects, "expected", binned(np.maximum(light, 0.0), FINE), moment)
        return np.maximum(rate, 0.0)

    def _focal_plane(self, moment: Moment) -> Plane:
        if self._optics is None or self._varies:
            self._optics, self._seen = apply_effects(self.effects, "optics", self.clean.optics, moment), {}
        lit = lit_scene(self.clean, self.effects, moment)
        seen = self.clean.seen(lit, moment, self._optics, self._seen)
        return np.asarray(apply_effects(self.effects, "spread", seen, lit, self._optics, moment))

    def all_expected(self) -> list[Plane]:
        """The result of `expected` for every image."""
        return [self.expected(index) for index in range(len(self.plan.shots))]

    def saturation_dn(self, expected: Sequence[Plane]) -> float | None:
        """The level (DN) at which high-only images clip; None: no clipping."""
        for effect in self.effects:
            if effect.kind.saturation_dn is not None and effect.strength:
                return effect.kind.saturation_dn(effect, self._exposures(expected), self.plan)
        return self.level

    def read_out(self, expected: Sequence[Plane], seed: int) -> list[Plane]:
        """The exposures in whole DN [y, x], with noise and clipping. seed: the seed of the noise realisation."""
        noisy = self._through_readout(expected, self._noisy(expected, [seed, _NOISE_STREAM]))
        return [np.rint(dn) for dn in self._clipped(noisy, expected)]

    def mean_rate(self, expected: Sequence[Plane], seed: int) -> list[Plane]:
        """Clipped images [y, x], DN/s, that are approximately the mean of many exposures.

        If the change by an effect during the readout depends on noise, this change is averaged over noise realisations.
        """
        realisations = max((effect.kind.noise_realisations for effect in self.effects), default=0)
        exposures = self._exposures(expected)
        if not realisations:
            mean = self._through_readout(expected, exposures)
        else:
            mean = list(exposures)
            for number in range(realisations):
                noisy = self._noisy(expected, [seed, _REALISATIONS_STREAM, number])
                for n, after in enumerate(self._through_readout(expected, noisy)):
                    mean[n] = mean[n] + (after - noisy[n]) / realisations
        shots = zip(self._clipped(mean, expected), self.plan.shots, strict=True)
        return [dn / shot.exposure_s for dn, shot in shots]

    def _exposures(self, rates: Sequence[Plane]) -> list[Plane]:
        return [rate * shot.exposure_s for rate, shot in zip(rates, self.plan.shots, strict=True)]

    def _clipped(self, exposures: Sequence[Plane], expected: Sequence[Plane]) -> list[Plane]:
        level = self.saturation_dn(expected)
        return [
            dn if level is None or shot.gain_mode != HIGH else np.minimum(dn, level)
            for dn, shot in zip(exposures, self.plan.shots, strict=True)
        ]

    def _noisy(self, expected: Sequence[Plane], stream: list[int]) -> list[Plane]:
        return [
            self.plan.noise.observe(rate, shot.exposure_s, np.random.default_rng([*stream, n]))
            * shot.exposure_s
            for n, (rate, shot) in enumerate(zip(expected, self.plan.shots, strict=True))
        ]

    def _through_readout(self, expected: Sequence[Plane], exposures: Sequence[Plane]) -> list[Plane]:
        out, earlier = [], list[Earlier]()
        for index, (rate, dn) in enumerate(zip(expected, exposures, strict=True)):
            moment = Moment(self.plan, index)
            out.append(apply_effects(self.effects, "read_out", dn, moment, earlier))
            earlier.append(Earlier(rate * moment.shot.exposure_s, moment.shot.time_s))
        return out


def lit_scene(clean: EffectFree, effects: Sequence[Effect], moment: Moment) -> Plane:
    """The fine scene of an image, with its occulter in front [y, x], DN/s."""
    scene = apply_effects(effects, "scene", clean.scenes[moment.shot.pointing], moment)
    lit = scene.copy()
    place = clean.plan.place(moment.index)
    # The patch must contain a moving disc.
    wide = Place(place.x_px, place.y_px, place.radius_px + _MOST_MOTION_PX)
    around = behind(scene, wide, fine=FINE, margin_px=0)
    share = covered_share(place, around.first, around.shape, FINE)
    share = apply_effects(effects, "covered", share, around, moment)
    rows, columns = (slice(s.start * FINE, s.stop * FINE) for s in around.window())
    lit[rows, columns] -= around.scene * share
    return np.asarray(apply_effects(effects, "foreground", np.maximum(lit, 0.0), moment))
