"""Make a case: write its transit into one folder and its noise-free transits into another, and return its truth.

Most effects have a target: the residual (percent) that the effect should leave in the discs after a refit of the PSF.
The strength of the effect is set to reach this target, but at most to the largest plausible strength. Then the residual
that the effect really leaves is measured and stored in the truth.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, uniform_filter

from psfcore.blind.cases import Case, case_scenes
from psfcore.blind.chain import Chain, EffectFree
from psfcore.blind.effects.effect import Effect
from psfcore.blind.effects.fine_optics import binned_glass, fine_optics
from psfcore.blind.leftover import Left, LinearEstimator, refitted, rms
from psfcore.simulate.plan import HIGH, Plan
from psfcore.simulate.transit import reported_places, write_observation
from psfcore.transit.prepare import Exposure, prepare
from psfcore.transit.transit import Frame

Plane = NDArray[np.float64]
WITH_EFFECTS, WITHOUT_EFFECTS = "with_effects", "without_effects"
TRIALS = 2
STRENGTH_WITHIN = 1.4  # a strength is accepted if its residual is within this factor of the target
MAP_POINTS = 64  # number of points of a map along each axis


def make(case: Case, transit: Path, expected: Path, images: Sequence[Plane] = ()) -> dict[str, Any]:
    """Make the scenes, set the strengths, simulate the exposures, and measure what the effects leave. Returns the truth.

    transit: a new folder for the transit; its files name no effect. expected: a new folder; if the case has effects, it
    gets two transits without noise for the ideal observer, WITH_EFFECTS and WITHOUT_EFFECTS. images: [y, x] in DN/s;
    scenes are cut from them. Empty: synthetic scenes. Raises DataError "bad-scene", and the errors of
    `psfcore.scatter.inversion.invert`.
    """
    plan = case.plan
    effect_free = EffectFree(plan, fine_optics(case.law, case.glass, plan.size_px), case_scenes(case, images))
    diffraction = binned_glass(case.glass)
    clean = Chain(effect_free, ()).all_expected()
    level = _level(case, clean)
    estimator = LinearEstimator(_frames(plan, clean, None), diffraction, case.law, plan.noise)
    alone = [
        _at_target(effect, target, case, effect_free, estimator)
        for effect, target in zip(case.effects, case.target_pct, strict=True)
    ]
    chain = Chain(effect_free, [effect for effect, _ in alone], level)
    rates = chain.all_expected()
    level = chain.saturation_dn(rates)
    places = reported_places(plan, case.seed)
    saturating = dataclasses.replace(plan, saturation_dn=level)
    whole_dn = [dn.astype(np.int32) for dn in chain.read_out(rates, case.seed)]
    write_observation(transit, saturating, whole_dn, places, diffraction)
    clean_left = estimator.clean_left_pct()
    truth = {
        "number": case.number,
        "seed": case.seed,
        "kind": case.kind,
        "glass": dataclasses.asdict(case.glass),
        "target_pct": list(case.target_pct),
        "effects": [],
        "psf": {"b": case.law.b_px, "c": case.law.c, "total": case.law.total},
        "exact": [{"x": shot.x_px, "y": shot.y_px} for shot in plan.shots],
        "plan": saturating.as_json(),
        "left_before_refit_pct": 0.0,
        "left_after_refit_pct": 0.0,
        "clean_left_pct": rms(clean_left),
    }
    if not alone:
        return truth
    mean = chain.mean_rate(rates, case.seed)
    for name, rate_planes, of in ((WITH_EFFECTS, mean, saturating), (WITHOUT_EFFECTS, clean, plan)):
        exposures = [rate * shot.exposure_s for rate, shot in zip(rate_planes, plan.shots, strict=True)]
        write_observation(expected / name, of, exposures, places, diffraction)
    frames = _frames(plan, mean, level)
    whole = refitted(frames, diffraction, case.law, plan.noise)
    both = [(whole["residual_pct"].get(str(n)), value) for n, value in enumerate(clean_left)]
    quick = estimator.left([frame.pixels for frame in frames])
    truth |= {
        "effects": [effect.as_json() | _left_alone(left, whole["noise_pct"]) for effect, left in alone],
        "left_before_refit_pct": quick.before_refit_pct,
        "left_after_refit_pct": rms([value - before for value, before in both if value is not None]),
        "left_after_refit_first_order_pct": quick.after_refit_pct,
        "clean_by_image_pct": {str(n): value for n, value in enumerate(clean_left)},
        "refitted": whole,
    }
    if any(effect.kind.adds_light for effect, _ in alone):
        added = np.mean(mean, axis=0) - np.mean(clean, axis=0)
        truth["light_map"] = {"size_px": plan.size_px, "values": _map(added)}
    return truth


def _map(change: Plane) -> list[list[float]]:
    """The change of the images [y, x], DN/s, at MAP_POINTS x MAP_POINTS points, each the mean of a box around the point."""
    step = change.shape[0] / MAP_POINTS
    at = (np.arange(MAP_POINTS) + 0.5) * step - 0.5
    boxes = uniform_filter(change, max(1, round(step)), mode="nearest")
    return np.round(
        map_coordinates(boxes, np.meshgrid(at, at, indexing="ij"), order=1, mode="nearest"), 4
    ).tolist()


def _at_target(
    effect: Effect, target_pct: float | None, case: Case, effect_free: EffectFree, estimator: LinearEstimator
) -> tuple[Effect, Left]:
    """The effect with the chosen strength, and the residual that it leaves.

    The strength is chosen to leave a residual of about target_pct, but is at most the largest plausible strength. None: the
    strength is not changed.
    """
    left = _quick_left(effect, case, effect_free, estimator)
    for _ in range(TRIALS):
        if target_pct is None:
            break
        short = target_pct / max(left.after_refit_pct, 1e-6)
        if max(short, 1 / short) < STRENGTH_WITHIN:
            break
        strength = float(min(effect.strength * short ** (1 / effect.kind.power), effect.kind.largest))
        if strength == effect.strength:  # even the largest strength leaves less than the target
            break
        effect = effect.at(strength)
        left = _quick_left(effect, case, effect_free, estimator)
    return effect, left


def _quick_left(effect: Effect, case: Case, effect_free: EffectFree, estimator: LinearEstimator) -> Left:
    """The residual that one effect alone leaves in the discs, to first order."""
    chain = Chain(effect_free, (effect,))
    rates = chain.all_expected()
    frames = _frames(case.plan, chain.mean_rate(rates, case.seed), chain.saturation_dn(rates))
    return estimator.left([frame.pixels for frame in frames])


def _left_alone(left: Left, noise_pct: dict[str, float]) -> dict[str, float]:
    """The residual that an effect leaves without the other effects of the case, after a refit, to first order.

    left_alone_pct: the residual in percent, rms over images. left_alone_chi2: the sum over images of (residual /
    noise)^2, with the residual and the noise of the disc mean.
    """
    by_image = enumerate(left.by_image_pct)
    shown = sum((pct / noise_pct[str(n)]) ** 2 for n, pct in by_image if str(n) in noise_pct)
    return {"left_alone_pct": left.after_refit_pct, "left_alone_chi2": float(shown)}


def _frames(plan: Plan, rates: Sequence[Plane], level: float | None) -> tuple[Frame, ...]:
    """Frames with the exact positions of the occulter. Clipped pixels are filled in the same way as when a transit is read."""
    exposures = []
    for n, (rate, shot) in enumerate(zip(rates, plan.shots, strict=True)):
        clips = level is not None and shot.gain_mode == HIGH
        gaps = rate * shot.exposure_s >= (level if clips and level is not None else np.inf) * (1 - 1e-9)
        exposures.append(
            Exposure(
                file=f"{n:03d}.fits",
                pixels=rate.astype(np.float32),
                pointing=shot.pointing,
                place=plan.place(n),
                exposure_s=shot.exposure_s,
                time_s=shot.time_s,
                gain_mode=shot.gain_mode,
                gaps=gaps if gaps.any() else None,
                saturated=int(gaps.sum()),
            )
        )
    return prepare(exposures)[0]


def _level(case: Case, rates: Sequence[Plane]) -> float | None:
    """The saturation level (DN) of the case; it is above the brightest pixel. None: no saturation."""
    if case.headroom is None:
        return None
    shots = zip(rates, case.plan.shots, strict=True)
    return float(np.rint(case.headroom * max(float(rate.max()) * shot.exposure_s for rate, shot in shots)))
