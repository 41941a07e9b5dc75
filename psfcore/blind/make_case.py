"""Make a case: write its transit into one folder and its noise-free transits into another, and return its truth.

Most effects have a target: the residual (percent) that the effect should leave in the discs after a refit of the PSF.
The strength of the effect is set to reach this target, but at most to the largest plausible strength. Then the residual
that the effect really leaves is measured and stored in the truth.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, uniform_filter

from psfcore.blind.cases import Case, case_scenes
from psfcore.blind.effects.effect import Effect, Plane
from psfcore.blind.effects.fine_optics import binned_glass, fine_optics
from psfcore.blind.residuals import LinearEstimator, refitted, rms
from psfcore.blind.simulation import EffectFree, Simulation
from psfcore.simulate.plan import HIGH
from psfcore.simulate.transit import reported_places, write_observation
from psfcore.transit.prepare import Exposure, prepare
from psfcore.transit.transit import Frame

WITHOUT_EFFECTS, CAUSES_FILE = "without_effects", "causes.json"
TRIALS = 2
STRENGTH_WITHIN = 1.4  # a strength is accepted if its residual is within this factor of the target
MAP_POINTS = 64  # number of points of a map along each axis


def make(case: Case, transit: Path, expected: Path, images: Sequence[Plane] = ()) -> dict[str, object]:
    """Make the scenes, set the strengths, simulate the exposures, and measure what the effects leave. Returns the
    truth.

    Raises DataError "bad-scene", and the errors of `psfcore.scatter.inversion.invert`.

    Parameters
    ----------
    transit
        A new folder for the transit; its files name no effect.
    expected
        A new folder. If the case has effects, the folder gets transits without noise: WITHOUT_EFFECTS, and one with
        each effect alone; CAUSES_FILE (gap-causes/1) lists them.
    images
        Images [y, x] in DN/s, from which scenes are cut. Empty: the scenes are synthetic.
    """
    plan, diffraction = case.plan, binned_glass(case.glass)
    effect_free = EffectFree(plan, fine_optics(case.law, case.glass, plan.size_px), case_scenes(case, images))
    clean = Simulation(effect_free, (), case.seed, case.headroom)
    estimator = LinearEstimator(_frames(clean), diffraction, case.law, plan.noise)
    targets = zip(case.effects, case.target_pct, strict=True)
    alone = [_at_target(effect, target, clean, estimator) for effect, target in targets]
    whole = clean.with_effects(*(one.effects[0] for one, _ in alone))
    places = reported_places(plan, case.seed)

    def write(folder: Path, exposures: Sequence[NDArray[np.generic]], level: float | None) -> None:
        own = dataclasses.replace(plan, saturation_dn=level)
        write_observation(folder, own, exposures, places, diffraction)

    write(transit, [dn.astype(np.int32) for dn in whole.read_out()], whole.level)
    effects = [_effect(one, left_pct, clean) for one, left_pct in alone]
    residuals = list[dict[str, float]]()
    if effects:
        simulations = {WITHOUT_EFFECTS: clean} | {f"effect_{n}": one for n, (one, _) in enumerate(alone)}
        for name, simulation in simulations.items():
            means = zip(simulation.mean, plan.shots, strict=True)
            write(expected / name, [rate * shot.exposure_s for rate, shot in means], simulation.level)
        causes = [
            {
                "folder": f"effect_{n}",
                "name": one["cause"],
                "families": one["families"],
                "stage": one["stage"],
            }
            for n, one in enumerate(effects)
        ]
        (expected / CAUSES_FILE).write_text(json.dumps({"schema": "gap-causes/1", "causes": causes}))
        fits = refitted(_frames(whole), diffraction, case.law, plan.noise)
        residuals = [
            {"residual_pct": fits[_file(n)][0], "noise_pct": fits[_file(n)][1], "clean_pct": clean_pct}
            for n, clean_pct in enumerate(estimator.clean_left_pct())
            if _file(n) in fits
        ]
    return {
        "number": case.number,
        "seed": case.seed,
        "kind": case.kind,
        "glass": dataclasses.asdict(case.glass),
        "target_pct": list(case.target_pct),
        "effects": effects,
        "psf": {"b": case.law.b_px, "c": case.law.c, "total": case.law.total},
        "exact": [{"x": shot.x_px, "y": shot.y_px} for shot in plan.shots],
        "plan": dataclasses.replace(plan, saturation_dn=whole.level).as_json(),
        "left_after_refit_pct": rms([one["residual_pct"] - one["clean_pct"] for one in residuals]),
        "residuals": residuals,
    }


def _effect(simulation: Simulation, left_pct: float, clean: Simulation) -> dict[str, object]:
    """The entry of an effect in the truth.

    Parameters
    ----------
    simulation
        The case with this effect alone.
    """
    (effect,) = simulation.effects
    entry = effect.as_json() | {"left_alone_pct": left_pct}
    if effect.kind.adds_light:
        added = np.mean(simulation.mean, axis=0) - np.mean(clean.mean, axis=0)
        entry["light_map"] = {"size_px": simulation.plan.size_px, "values": _map(added)}
    return entry


def _map(change: Plane) -> list[list[float]]:
    """The change of the images [y, x], DN/s, at MAP_POINTS x MAP_POINTS points, each the mean of a box around the
    point.
    """
    step = change.shape[0] / MAP_POINTS
    at = (np.arange(MAP_POINTS) + 0.5) * step - 0.5
    boxes = uniform_filter(change, max(1, round(step)), mode="nearest")
    return list(
        np.round(
            map_coordinates(boxes, np.meshgrid(at, at, indexing="ij"), order=1, mode="nearest"), 4
        ).tolist()
    )


def _at_target(
    effect: Effect, target_pct: float | None, clean: Simulation, estimator: LinearEstimator
) -> tuple[Simulation, float]:
    """The images with this effect alone at the chosen strength, and the residual that it leaves, percent, to first
    order.

    The strength is chosen to leave a residual of about target_pct, but is at most the largest plausible strength.
    None: the strength is not changed.
    """
    for trial in range(TRIALS + 1):
        simulation = clean.with_effects(effect)
        left_pct = estimator.left_pct([frame.pixels for frame in _frames(simulation)])
        if target_pct is None or trial == TRIALS:
            break
        short = target_pct / max(left_pct, 1e-6)
        strength = float(min(effect.strength * short ** (1 / effect.kind.power), effect.kind.largest))
        # The largest strength may leave less than the target.
        if max(short, 1 / short) < STRENGTH_WITHIN or strength == effect.strength:
            break
        effect = effect.at(strength)
    return simulation, left_pct


def _file(n: int) -> str:
    return f"{n:03d}.fits"


def _frames(simulation: Simulation) -> tuple[Frame, ...]:
    """Frames of mean images, with the exact positions of the occulter. Clipped pixels are filled as in a transit from
    a folder.
    """
    exposures = []
    for n, (rate, shot) in enumerate(zip(simulation.mean, simulation.plan.shots, strict=True)):
        level = simulation.level if simulation.level is not None and shot.gain_mode == HIGH else np.inf
        gaps = rate * shot.exposure_s >= level * (1 - 1e-9)
        exposures.append(
            Exposure(
                file=_file(n),
                pixels=rate.astype(np.float32),
                pointing=shot.pointing,
                place=simulation.plan.place(n),
                exposure_s=shot.exposure_s,
                time_s=shot.time_s,
                gain_mode=shot.gain_mode,
                gaps=gaps if gaps.any() else None,
                saturated=int(gaps.sum()),
            )
        )
    return prepare(exposures)[0]
