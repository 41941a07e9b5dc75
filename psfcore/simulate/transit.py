"""A simulated transit: scenes convolved with a known PSF, with photon noise and read noise, in whole DN.

    D_i = round(min(g Poisson(I_i t / g) + read + dark, saturation)),  frame i = D_i / t     Eq. (1)

The plan (plan.py) gives the positions and exposures, and the sky (sky.py) gives the noise-free images. transit_files.py
writes the folder. If whole_dn of the plan is False, D_i is not rounded. Only high-only images saturate.

| symbol | name | unit |
|---|---|---|
| I_i | noise_free[i] | DN/s |
| g, t | photon_gain_dn, exposure_s | DN, s |
| read | a normal random number with rms read_noise_dn | DN |
| dark, saturation | dark_offset_dn, saturation_dn | DN |
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.simulate.headers import HRI_EUV, Imitated
from psfcore.simulate.plan import HIGH, Plan
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.simulate.sky import TrueSky, true_sky
from psfcore.transit.transit import Frame, Place, Transit

Plane = NDArray[np.float64]
Kernel = NDArray[np.float64]

_EPHEMERIS, _NOISE = 1001, 1002  # independent streams of random numbers


@dataclass(frozen=True)
class Truth:
    """The values with which a simulated transit was made. places: the occulter's exact position in each image."""

    scatter: ScatterTruth
    places: tuple[Place, ...]
    seed: int
    scene_seed: int

    def as_json(self) -> dict[str, Any]:
        """The content of truth.json, except for the plan."""
        law = self.scatter
        return {
            "effects": [],
            "psf": {
                "b": law.b_px,
                "c": law.c,
                "total": law.total,
                "a": law.a,
                "stretch": law.stretch,
                "angle_deg": law.angle_deg,
                "dipole": law.dipole,
            },
            "exact": [{"x": place.x_px, "y": place.y_px} for place in self.places],
            "seed": self.seed,
            "scene_seed": self.scene_seed,
        }


@dataclass(frozen=True, eq=False)
class SimulatedTransit:
    """A simulated transit in memory, with the true values.

    transit: frames in DN/s (float32), made from whole DN. The frames' places are the reported positions, which contain
    the errors of the ephemeris. imitated: the instrument whose keywords the headers get.
    """

    transit: Transit
    truth: Truth
    sky: TrueSky
    imitated: Imitated = HRI_EUV

    @property
    def plan(self) -> Plan:
        """The plan of the transit."""
        return self.sky.plan


def simulate(
    plan: Plan,
    scatter: ScatterTruth,
    diffraction: Kernel,
    seed: int,
    *,
    scenes: Mapping[int, Plane] | None = None,
    imitated: Imitated = HRI_EUV,
    threads: int = 1,
) -> SimulatedTransit:
    """A transit of `plan`. Its PSF is `scatter` convolved with `diffraction`. Equal arguments give equal results.

    diffraction: weights [y, x], centre at [n // 2, n // 2], sum 1. seed: random seed of the scenes, the ephemeris errors
    and the noise. scenes: for each pointing, a scene to use instead of a synthetic scene, as drawn_scene and
    scene_from_image of psfcore.simulate.scene return it.
    imitated: the instrument whose keywords the headers get. Raises DataError "bad-diffraction", "bad-scene".
    """
    sky = true_sky(plan, scatter, diffraction, seed, scenes=scenes, threads=threads)
    return observed_transit(sky, seed, imitated)


def observed_transit(sky: TrueSky, seed: int, imitated: Imitated = HRI_EUV) -> SimulatedTransit:
    """A transit of a given sky: `seed` determines the noise realisation and the errors of the ephemeris.

    This is faster than `simulate`, because the scenes are already convolved.
    """
    plan = sky.plan
    reported = reported_places(plan, seed)
    start_s = plan.shots[0].time_s
    frames = tuple(
        Frame(
            file=f"{index:03d}.fits",
            pixels=(_read_out(plan, index, sky.expected(index), seed) / shot.exposure_s).astype(np.float32),
            pointing=shot.pointing,
            place=reported[index],
            exposure_s=shot.exposure_s,
            time_s=shot.time_s - start_s,
            gain_mode=shot.gain_mode,
        )
        for index, shot in enumerate(plan.shots)
    )
    transit = Transit(
        frames=frames,
        diffraction=sky.diffraction,
        noise=plan.noise,
        instrument=imitated.name,
        plate_scale_arcsec=imitated.plate_scale_arcsec,
    )
    places = tuple(plan.place(index) for index in range(len(plan.shots)))
    return SimulatedTransit(transit, Truth(sky.scatter, places, seed, sky.seed), sky, imitated)


def _read_out(plan: Plan, index: int, expected: Plane, seed: int) -> Plane:
    """D_i of Eq. (1): one exposure in DN."""
    shot = plan.shots[index]
    rng = np.random.default_rng([seed, _NOISE, index])
    seen_dn = plan.noise.observe(expected, shot.exposure_s, rng) * shot.exposure_s + plan.dark_offset_dn
    if plan.saturation_dn is not None and shot.gain_mode == HIGH:
        seen_dn = np.minimum(seen_dn, plan.saturation_dn)
    return np.asarray(np.rint(seen_dn) if plan.whole_dn else seen_dn)


def reported_places(plan: Plan, seed: int) -> list[Place]:
    """The positions of the occulter that a transit states: the exact positions plus errors of the ephemeris, rounded to a tenth of a pixel."""
    rng = np.random.default_rng([seed, _EPHEMERIS])
    errors = rng.normal(0.0, plan.ephemeris_error_px, (len(plan.shots), 2))
    return [
        Place(round(shot.x_px + float(dx), 1), round(shot.y_px + float(dy), 1), plan.radius_px)
        for shot, (dx, dy) in zip(plan.shots, errors, strict=True)
    ]
