"""Make a case: write its transit into one folder and its truth into another, and seal the truth.

    DIR/cases/NNNN/transit/    the images, diffraction.fits and transit.json; none of these files names an effect
    DIR/cases/NNNN/expected/   two transits without noise, with_effects/ and without_effects/, for the ideal observer; a clean
                               case has none. The diagnosis does not see them
    DIR/truth/NNNN.json        salt and truth
    DIR/seals.jsonl            one line for each case: SHA-256 of salt and truth, computed before any diagnosis

Most effects have a target: the residual (percent) that the effect should leave in the discs after a refit of the PSF.
The strength of the effect is set to reach this target, but at most to the largest plausible strength. Then the residual
that the effect really leaves is measured and stored in the truth.
"""

from __future__ import annotations

import hashlib
import json
import secrets
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.blind.cases import Case, case_scenes
from psfcore.blind.chain import Chain, EffectFree
from psfcore.blind.effects.effect import Effect
from psfcore.blind.effects.fine_optics import binned_glass, fine_optics
from psfcore.blind.leftover import Left, LinearEstimator, refitted, rms_difference
from psfcore.fits.images import Cards, CardValue, write_plane
from psfcore.simulate.headers import HRI_EUV
from psfcore.simulate.plan import HIGH, Plan
from psfcore.transit.prepare import Exposure, prepare
from psfcore.transit.transit import Frame, Place

Plane = NDArray[np.float64]
SCHEMA = "transit/1"
WITH_EFFECTS, WITHOUT_EFFECTS = "with_effects", "without_effects"
TRIALS = 2
STRENGTH_WITHIN = 1.4  # a strength is accepted if its residual is within this factor of the target
_PLACE_STREAM = 2003


@dataclass(frozen=True, eq=False)
class NoiseFree:
    """The images of a transit without noise [y, x], DN/s. saturation_dn: the level at which they are clipped; None: no clipping."""

    rates: list[Plane]
    saturation_dn: float | None


@dataclass(frozen=True, eq=False)
class Made:
    """A case that was made.

    exposures: [y, x] in whole DN. reported: the positions of the occulter, with errors. saturation_dn: the level at which
    high-only images clip, None: no clipping. diffraction: the known PSF. truth: as in the truth file. expected: the images
    without noise, by WITH_EFFECTS and WITHOUT_EFFECTS; empty for a clean case.
    """

    exposures: list[Plane]
    reported: list[Place]
    saturation_dn: float | None
    diffraction: Plane
    truth: dict[str, Any]
    expected: dict[str, NoiseFree] = field(default_factory=dict)


def make(case: Case, images: Sequence[Plane] = ()) -> Made:
    """Make the scenes, set the strengths, simulate the exposures, and measure the residual that the effects leave.

    images: [y, x] in DN/s; scenes are cut from them. Empty: synthetic scenes.
    Raises DataError "bad-scene", and the errors of `psfcore.scatter.inversion.invert`.
    """
    effect_free = EffectFree(
        case.plan, fine_optics(case.law, case.glass, case.plan.size_px), case_scenes(case, images)
    )
    diffraction = binned_glass(case.glass)
    clean = Chain(effect_free, ())
    clean_rates = clean.all_expected()
    level = _level(case, clean_rates)
    estimator = LinearEstimator(_frames(case.plan, clean_rates, None), diffraction, case.law, case.plan.noise)
    alone = [
        _at_target(effect, target, case, effect_free, estimator)
        for effect, target in zip(case.effects, case.target_pct, strict=True)
    ]
    effects = tuple(effect for effect, _ in alone)
    chain = Chain(effect_free, effects)
    expected = chain.all_expected() if effects else clean_rates
    own_level = chain.saturation_dn(expected) or level
    exposures = _clipped(chain.read_out(expected, case.seed), case.plan, own_level)
    mean = chain.mean_rate(expected, case.seed) if effects else clean_rates
    left = _left(case, chain, mean, estimator, diffraction, own_level)
    truth = case.as_json() | {
        "effects": [effect.as_json() | _left_alone(by_itself, left) for effect, by_itself in alone],
        "psf": {"b": case.law.b_px, "c": case.law.c, "total": case.law.total},
        "exact": [{"x": shot.x_px, "y": shot.y_px} for shot in case.plan.shots],
        "plan": case.plan.as_json() | {"saturation_dn": own_level},
        **left,
    }
    noise_free = {WITH_EFFECTS: NoiseFree(mean, own_level), WITHOUT_EFFECTS: NoiseFree(clean_rates, None)}
    return Made(
        exposures, _reported(case), own_level, diffraction, truth, expected=noise_free if effects else {}
    )


def _at_target(
    effect: Effect, target_pct: float | None, case: Case, effect_free: EffectFree, estimator: LinearEstimator
) -> tuple[Effect, Left]:
    """Return the effect with the chosen strength, and the residual that it leaves.

    The strength is chosen to leave a residual of about target_pct, but is at most the largest plausible strength. None: the
    strength is not changed.
    """
    tried, found = effect, _quick_left(effect, case, effect_free, estimator)
    if target_pct is None:
        return effect, found
    for _ in range(TRIALS):
        short = target_pct / max(found.after_refit_pct, 1e-6)
        if max(short, 1 / short) < STRENGTH_WITHIN:
            break
        wanted = tried.strength * short ** (1 / tried.kind.power)
        strength = float(min(wanted, tried.kind.largest))
        if strength == tried.strength:  # even the largest strength leaves less than the target
            break
        tried = tried.at(strength)
        found = _quick_left(tried, case, effect_free, estimator)
    return tried, found


def _quick_left(effect: Effect, case: Case, effect_free: EffectFree, estimator: LinearEstimator) -> Left:
    """The residual that one effect alone leaves in the discs, to first order."""
    chain = Chain(effect_free, (effect,))
    expected = chain.all_expected()
    level = chain.saturation_dn(expected)
    return estimator.left(_pixels(_frames(case.plan, chain.mean_rate(expected, case.seed), level)))


def _left_alone(by_itself: Left, left: dict[str, Any]) -> dict[str, float]:
    """The residual that an effect leaves without the other effects of the case, after a refit, to first order.

    left_alone_pct: the residual in percent, rms over images. left_alone_chi2: the sum over images of (residual /
    noise)^2, with the residual and the noise of the disc mean.
    """
    noise = left["refitted"]["noise_pct"]
    shown = sum((pct / noise[str(n)]) ** 2 for n, pct in by_itself.by_image_pct.items() if str(n) in noise)
    return {"left_alone_pct": by_itself.after_refit_pct, "left_alone_chi2": float(shown)}


def _pixels(frames: Sequence[Frame]) -> dict[int, Plane]:
    """The pixels [y, x] of frames, DN/s, by image number."""
    return {n: np.asarray(frame.pixels, dtype=np.float64) for n, frame in enumerate(frames)}


def _frames(plan: Plan, rates: Sequence[Plane], level: float | None) -> tuple[Frame, ...]:
    """Frames with the exact positions of the occulter. Clipped pixels are filled in the same way as when a transit is read."""
    exposures = []
    for n, (rate, shot) in enumerate(zip(rates, plan.shots, strict=True)):
        gaps = None
        if level is not None and shot.gain_mode == HIGH:
            gaps = rate * shot.exposure_s >= level * (1 - 1e-9)
        exposures.append(
            Exposure(
                file=f"{n:03d}.fits",
                pixels=rate.astype(np.float32),
                pointing=shot.pointing,
                place=plan.place(n),
                exposure_s=shot.exposure_s,
                time_s=shot.time_s,
                gain_mode=shot.gain_mode,
                gaps=gaps if gaps is not None and gaps.any() else None,
                saturated=0 if gaps is None else int(gaps.sum()),
            )
        )
    return prepare(exposures)[0]


def _left(
    case: Case,
    chain: Chain,
    mean: Sequence[Plane],
    estimator: LinearEstimator,
    diffraction: Plane,
    level: float | None,
) -> dict[str, Any]:
    """The residual that all effects of a case leave in the discs: percent, rms over images and for each image.

    mean: the images without noise [y, x], DN/s. level: the level (DN) at which high-only images clip; None: no clipping.
    """
    clean_after = estimator.clean_left_pct()
    clean_rms = float(np.sqrt(np.mean(np.square(list(clean_after.values())))))
    if not chain.effects:
        return {"left_before_refit_pct": 0.0, "left_after_refit_pct": 0.0, "clean_left_pct": clean_rms}
    frames = _frames(case.plan, mean, level)
    quick = estimator.left(_pixels(frames))
    whole = refitted(frames, diffraction, case.law, case.plan.noise)
    return {
        "left_before_refit_pct": quick.before_refit_pct,
        "left_after_refit_pct": rms_difference(whole.residual_pct, clean_after),
        "left_after_refit_first_order_pct": quick.after_refit_pct,
        "clean_left_pct": clean_rms,
        "clean_by_image_pct": {str(n): value for n, value in clean_after.items()},
        "refitted": whole.as_json(),
    }


def _level(case: Case, rates: Sequence[Plane]) -> float | None:
    """The saturation level (DN) of the case; it is above the brightest pixel. None: no saturation."""
    if case.headroom is None:
        return None
    brightest = max(
        float(rate.max()) * shot.exposure_s for rate, shot in zip(rates, case.plan.shots, strict=True)
    )
    return float(np.rint(case.headroom * brightest))


def _clipped(exposures: Sequence[Plane], plan: Plan, level: float | None) -> list[Plane]:
    return [
        np.minimum(dn, level) if level is not None and shot.gain_mode == HIGH else dn
        for dn, shot in zip(exposures, plan.shots, strict=True)
    ]


def _reported(case: Case) -> list[Place]:
    """The positions of the occulter as the transit states them: with an ephemeris error, rounded to 0.1 px."""
    rng = np.random.default_rng([case.seed, _PLACE_STREAM])
    plan = case.plan
    errors = rng.normal(0.0, plan.ephemeris_error_px, (len(plan.shots), 2))
    return [
        Place(round(shot.x_px + float(dx), 1), round(shot.y_px + float(dy), 1), round(plan.radius_px, 3))
        for shot, (dx, dy) in zip(plan.shots, errors, strict=True)
    ]


def write_transit(made: Made, plan: Plan, folder: Path) -> None:
    """Write the transit of a case, without its truth, into a new folder."""
    whole_dn = [dn.astype(np.int32) for dn in made.exposures]
    _write(made, plan, folder, whole_dn, made.saturation_dn)


def write_expected(made: Made, plan: Plan, folder: Path) -> None:
    """Write the noise-free transits of a case into new folders inside `folder`. A clean case has none."""
    for name, noise_free in made.expected.items():
        shots = zip(noise_free.rates, plan.shots, strict=True)
        exposures = [rate * shot.exposure_s for rate, shot in shots]
        _write(made, plan, folder / name, exposures, noise_free.saturation_dn)


def _write(
    made: Made,
    plan: Plan,
    folder: Path,
    exposures: Sequence[NDArray[Any]],
    level: float | None,
) -> None:
    """Write exposures [y, x] in DN as a transit. level: the level at which high-only images clip, DN; None: no clipping."""
    folder.mkdir(parents=True)
    for n, dn in enumerate(exposures):
        write_plane(folder / f"{n:03d}.fits", dn, cards=_frame_cards(plan, n, level))
    write_plane(folder / "diffraction.fits", made.diffraction, cards=_cards(HRI_EUV.values()))
    entries = [
        {
            "file": f"{n:03d}.fits",
            "fov": shot.pointing,
            "x": place.x_px,
            "y": place.y_px,
            "r": place.radius_px,
        }
        for n, (shot, place) in enumerate(zip(plan.shots, made.reported, strict=True))
    ]
    noise = {"photon_gain_dn": plan.noise.photon_gain_dn, "read_noise_dn": plan.noise.read_noise_dn}
    content = {
        "schema": SCHEMA,
        "instrument": HRI_EUV.name,
        "known_psf": "diffraction.fits",
        "noise": noise,
        "images": entries,
    }
    (folder / "transit.json").write_text(json.dumps(content, indent=1) + "\n", "utf-8")


def _frame_cards(plan: Plan, index: int, level: float | None) -> Cards:
    shot = plan.shots[index]
    values = HRI_EUV.shot_values(shot, "DN")
    if level is not None and shot.gain_mode == HIGH:
        values["SATURATE"] = level
    return _cards(values)


def _cards(values: dict[str, CardValue]) -> Cards:
    return {key: (value, "simulated") for key, value in values.items()}


def sealed(truth: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Two results: the seal of a truth, and the content of the truth file, which is a random salt and the truth."""
    salt = secrets.token_hex(16)
    return seal_of(salt, truth), {"salt": salt, "truth": truth}


def seal_of(salt: str, truth: dict[str, Any]) -> str:
    """SHA-256 (hex) of a salt and the canonical JSON of a truth."""
    canonical = json.dumps(truth, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256((salt + canonical).encode()).hexdigest()


__all__ = ["Made", "NoiseFree", "make", "seal_of", "sealed", "write_expected", "write_transit"]
