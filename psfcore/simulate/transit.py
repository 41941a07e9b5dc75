"""A transit whose truth is known: a sky seen through a PSF, counted in photons, read out, in whole DN.

    D_i = round(min(g Poisson(I_i t / g) + read + dark, saturation)),  frame i = D_i / t     Eq. (1)

The plan says where and how long (psfcore.simulate.plan), the sky what a camera without noise sees (sky.py), and
transit_files.py writes the folder.

| symbol | name | unit |
|---|---|---|
| I_i | noise_free[i] | DN/s |
| g, t | photon_gain_dn, exposure_s | DN, s |
| dark | dark_offset_dn | DN |
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.simulate.plan import HIGH, Plan
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.simulate.sky import TrueSky, true_sky
from psfcore.transit.transit import Frame, Place, Transit

Plane = NDArray[np.float64]
Kernel = NDArray[np.float64]

INSTRUMENT = "hri_euv"
PLATE_SCALE_ARCSEC = 0.492
_EPHEMERIS, _NOISE = 1001, 1002  # streams of random numbers, so that one does not move another


@dataclass(frozen=True)
class Truth:
    """What a simulated transit was made with. places: the occulter's exact ones, an image each."""

    scatter: ScatterTruth
    places: tuple[Place, ...]
    seed: int
    scene_seed: int
    effects: tuple[Any, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """As truth.json has it, but for the plan."""
        law = self.scatter
        return {
            "effects": list(self.effects),
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
    """A transit in memory, and its truth.

    transit: frames in DN/s (float32), whole DN over the exposure, places as the ephemeris has them.
    """

    transit: Transit
    truth: Truth
    sky: TrueSky

    @property
    def plan(self) -> Plan:
        """What was planned."""
        return self.sky.plan

    @property
    def noise_free(self) -> tuple[Plane, ...]:
        """What a camera without noise sees, DN/s, float64, an image each; computed at first use and kept."""
        return self.sky.noise_free

    @property
    def scenes(self) -> Mapping[int, Plane]:
        """Scene without occulter of each pointing, DN/s, plan.margin_px larger than the field on each side."""
        return self.sky.scenes

    def true_scene(self, index: int) -> Plane:
        """Scene of an image with its occulter dark, on the field: [y, x] in DN/s, float64."""
        return self.sky.true_scene(index)


def simulate(
    plan: Plan,
    scatter: ScatterTruth,
    diffraction: Kernel,
    seed: int,
    *,
    scene_seed: int | None = None,
    scenes: Mapping[int, Plane] | None = None,
    threads: int = 1,
) -> SimulatedTransit:
    """A transit of `plan` seen through scatter convolved with diffraction; the same for the same arguments.

    diffraction: weights [y, x], centre at [n // 2, n // 2], sum 1. seed: of scenes, ephemeris and noise.
    scene_seed: another one for the scenes. scenes: by pointing, in place of drawn ones, as drawn_scene and
    scene_from_image of psfcore.simulate.pointings give them. Raises DataError "bad-diffraction", "bad-scene".
    """
    of_scenes = seed if scene_seed is None else scene_seed
    sky = true_sky(plan, scatter, diffraction, of_scenes, scenes=scenes, threads=threads)
    return observed_transit(sky, seed)


def observed_transit(sky: TrueSky, seed: int) -> SimulatedTransit:
    """One more transit of the same sky: other noise, other errors of the ephemeris. Quick."""
    plan = sky.plan
    reported = _ephemeris(plan, seed)
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
        instrument=INSTRUMENT,
        plate_scale_arcsec=PLATE_SCALE_ARCSEC,
    )
    places = tuple(plan.place(index) for index in range(len(plan.shots)))
    return SimulatedTransit(transit, Truth(sky.scatter, places, seed, sky.seed), sky)


def _read_out(plan: Plan, index: int, expected: Plane, seed: int) -> Plane:
    """An exposure in DN, Eq. (1)."""
    shot = plan.shots[index]
    rng = np.random.default_rng([seed, _NOISE, index])
    seen_dn = plan.noise.observe(expected, shot.exposure_s, rng) * shot.exposure_s + plan.dark_offset_dn
    if plan.saturation_dn is not None and shot.gain_mode == HIGH:
        seen_dn = np.minimum(seen_dn, plan.saturation_dn)
    return np.asarray(np.rint(seen_dn) if plan.whole_dn else seen_dn)


def _ephemeris(plan: Plan, seed: int) -> list[Place]:
    """Exact places with the ephemeris' error, to a tenth of a pixel."""
    rng = np.random.default_rng([seed, _EPHEMERIS])
    errors = rng.normal(0.0, plan.ephemeris_error_px, (len(plan.shots), 2))
    return [
        Place(round(shot.x_px + float(dx), 1), round(shot.y_px + float(dy), 1), plan.radius_px)
        for shot, (dx, dy) in zip(plan.shots, errors, strict=True)
    ]
