"""From scenes to exposures on fine pixels, with any effects on the way.

    fine light = spread(P (S - h))  ->  light()  ->  boxed  ->  expected()  ->  photons, readout  ->  read_out()  ->  whole DN

P is linear: a pointing's scene is seen through it once, what an image adds to or hides of it once an image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from psfcore.blind.effects.effect import Earlier, Effect, Moment, acts_on
from psfcore.blind.effects.fine_optics import FINE, FineOptics
from psfcore.simulate.disc import behind, binned, covered_share
from psfcore.simulate.plan import HIGH, Plan
from psfcore.transit.transit import Place

Plane = NDArray[np.float64]
_SKY_STEPS = ("scene", "covered", "optics", "spread")
_MOST_MOTION_PX = 5.0  # either way from the middle of an exposure
_DRAWS_STREAM, _NOISE_STREAM = 2001, 2002


class Sky:
    """Scenes of a plan through a telescope, without any effect; what is seen once is kept.

    scenes: fine [y, x] in DN/s by pointing, FINE pixels along a detector pixel.
    """

    def __init__(self, plan: Plan, optics: FineOptics, scenes: Mapping[int, Plane]) -> None:
        self.plan, self.optics, self.scenes = plan, optics, scenes
        self._light: dict[int, NDArray[np.float32]] = {}
        self._seen: dict[int, Plane] = {}

    def seen_scene(self, pointing: int) -> Plane:
        """A pointing's scene through the PSF, fine, without an occulter."""
        if pointing not in self._seen:
            self._seen[pointing] = np.asarray(
                self.optics.through.apply(self.scenes[pointing]), dtype=np.float64
            )
        return self._seen[pointing]

    def clean_light(self, index: int) -> Plane:
        """An image's fine light [y, x], DN/s, without any effect."""
        if index not in self._light:
            pointing = self.plan.shots[index].pointing
            lit = _lit(self, (), Moment(self.plan, index))
            light = self.seen_scene(pointing) + self.optics.through.apply(lit - self.scenes[pointing])
            self._light[index] = light.astype(np.float32)
        return self._light[index].astype(np.float64)


class Chain:
    """One set of effects on a sky."""

    def __init__(self, sky: Sky, effects: Sequence[Effect]) -> None:
        self.sky, self.plan, self.effects = sky, sky.plan, tuple(effects)
        self._changes_sky = any(acts_on(effect, *_SKY_STEPS) for effect in self.effects)
        self._varies = any(effect.varies for effect in self.effects)
        self._optics: FineOptics | None = None
        self._seen: dict[int, Plane] = {}

    def expected(self, index: int) -> Plane:
        """Light on detector pixels [y, x], DN/s, as it would be counted on average."""
        moment = Moment(self.plan, index)
        light = self._focal_plane(moment) if self._changes_sky else self.sky.clean_light(index)
        for effect in self.effects:
            light = effect.light(light, moment)
        rate = binned(np.maximum(light, 0.0), FINE)
        for effect in self.effects:
            rate = effect.expected(rate, moment)
        return np.maximum(rate, 0.0)

    def all_expected(self) -> list[Plane]:
        """Every image as expected() has it."""
        return [self.expected(index) for index in range(len(self.plan.shots))]

    def _focal_plane(self, moment: Moment) -> Plane:
        pointing, optics = moment.shot.pointing, self._telescope(moment)
        lit = _lit(self.sky, self.effects, moment)
        if self._varies:
            seen = np.asarray(optics.through.apply(lit), dtype=np.float64)
        else:
            if pointing not in self._seen:
                same = optics is self.sky.optics
                through = (
                    self.sky.seen_scene(pointing) if same else optics.through.apply(self.sky.scenes[pointing])
                )
                self._seen[pointing] = np.asarray(through, dtype=np.float64)
            seen = self._seen[pointing] + optics.through.apply(lit - self.sky.scenes[pointing])
        for effect in self.effects:
            seen = effect.spread(seen, lit, optics, moment)
        return seen

    def _telescope(self, moment: Moment) -> FineOptics:
        if self._optics is None or self._varies:
            optics = self.sky.optics
            for effect in self.effects:
                optics = effect.optics(optics, moment)
            self._optics = optics
        return self._optics

    def saturation_dn(self, expected: Sequence[Plane]) -> float | None:
        """The level that high-only images clip at, the plan's unless an effect sets one."""
        exposures = [rate * shot.exposure_s for rate, shot in zip(expected, self.plan.shots, strict=True)]
        for effect in self.effects:
            level = effect.saturation_dn(exposures, self.plan)
            if level is not None:
                return level
        return self.plan.saturation_dn

    def read_out(self, expected: Sequence[Plane], seed: int) -> list[Plane]:
        """Exposures in whole DN [y, x], clipped where they clip, with the noise of a seed."""
        level = self.saturation_dn(expected)
        noisy = self._through_readout(expected, self._noisy(expected, [seed, _NOISE_STREAM]))
        return [
            np.rint(dn if level is None or shot.gain_mode != HIGH else np.minimum(dn, level))
            for dn, shot in zip(noisy, self.plan.shots, strict=True)
        ]

    def mean_rate(self, expected: Sequence[Plane], seed: int) -> list[Plane]:
        """Images [y, x], DN/s, clipped, as the mean of many exposures would be, nearly.

        Where what the readout does depends on noise, its change is averaged over draws of noise.
        """
        draws = max((effect.draws for effect in self.effects), default=0)
        exposures = [rate * shot.exposure_s for rate, shot in zip(expected, self.plan.shots, strict=True)]
        if not draws:
            mean = self._through_readout(expected, exposures)
        else:
            mean = list(exposures)
            for draw in range(draws):
                noisy = self._noisy(expected, [seed, _DRAWS_STREAM, draw])
                for n, (after, before) in enumerate(
                    zip(self._through_readout(expected, noisy), noisy, strict=True)
                ):
                    mean[n] = mean[n] + (after - before) / draws
        level = self.saturation_dn(expected)
        return [
            (dn if level is None or shot.gain_mode != HIGH else np.minimum(dn, level)) / shot.exposure_s
            for dn, shot in zip(mean, self.plan.shots, strict=True)
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
            changed = dn
            for effect in self.effects:
                changed = effect.read_out(changed, moment, earlier)
            out.append(changed)
            earlier.append(Earlier(rate * moment.shot.exposure_s, moment.shot.time_s))
        return out


def _lit(sky: Sky, effects: Sequence[Effect], moment: Moment) -> Plane:
    """The fine scene of an image with its occulter in it."""
    scene = sky.scenes[moment.shot.pointing]
    for effect in effects:
        scene = effect.scene(scene, moment)
    lit = scene.copy()
    place = sky.plan.place(moment.index)
    wide = Place(
        place.x_px, place.y_px, place.radius_px + _MOST_MOTION_PX
    )  # a patch that holds a moving disc
    around = behind(scene, wide, fine=FINE, margin_px=0)
    share = None
    for effect in effects:
        share = effect.covered(share, place, around.first, around.shape, moment)
    if share is None:
        share = covered_share(place, around.first, around.shape, FINE)
    rows, columns = (slice(s.start * FINE, s.stop * FINE) for s in around.window())
    lit[rows, columns] -= around.scene * share
    return np.asarray(np.maximum(lit, 0.0))
