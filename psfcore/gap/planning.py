"""A planned transit: which effects its images would show, and which effects they could not tell apart.

The images of the plan are simulated without noise and fitted; the limits follow from the linear model of this fit. The
noise in this model is the noise of the planned exposures. The scene does not change, but the brightness of the images
varies by BRIGHTNESS_SPREAD, because the Sun and the shutter do. If the brightness did not vary, every difference
between images would look like an effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from psfcore.arrays import Kernel
from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.gap.effect import Effect
from psfcore.gap.evidence.closed_form import ClosedForm
from psfcore.gap.evidence.expected_gap import linear_model_of
from psfcore.gap.evidence.tree import SUN
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.schema import PointingJson
from psfcore.gap.verdict.answer import FLOOR
from psfcore.gap.verdict.limits import Limits, limits
from psfcore.gap.view import View
from psfcore.instruments.files import instrument_names
from psfcore.scatter.inversion import LEAST_FRAMES, invert
from psfcore.scatter.reconstruction import Progress
from psfcore.scatter.shapes import SOFTENED_POWER_LAW
from psfcore.simulate.inputs import LARGEST_DIFFRACTION_PX, diffraction_kernel, read_plan
from psfcore.simulate.plan import Plan
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.simulate.sky import true_sky
from psfcore.simulate.transit import observed_transit
from psfcore.transit.transit import Transit

SCHEMA = "gap-plan/1"
INSTRUMENT = "hri_euv"
SCATTER = ScatterTruth(6.15, 2.53, 0.411)  # the scatter of HRI_EUV (Hofmeister et al.)
BRIGHTNESS_SPREAD = 0.01
_BRIGHTNESS_STREAM = 3001


@dataclass(frozen=True, eq=False)
class Planned:
    """The limits of a plan.

    Attributes
    ----------
    searched
        Effects that search for a position or form; their limits hold for the position or form that was found.
    settled_by
        The observation that confirms an effect, by effect.
    left_out
        The reasons why the fit cannot use images, by the name that the simulation gives the image.
    """

    plan: Plan
    limits: Limits
    searched: tuple[str, ...]
    settled_by: dict[str, str]
    left_out: dict[str, str]

    @property
    def pointings(self) -> list[PointingJson]:
        """For each pointing: its number, its view (the part of the Sun), the number of images, and the exposure times,
        s.
        """
        rows = []
        for pointing in self.plan.pointings:
            exposures = [shot.exposure_s for shot in self.plan.shots if shot.pointing == pointing]
            rows.append(
                PointingJson(
                    pointing=pointing,
                    view=self.plan.views[pointing - 1],
                    images=len(exposures),
                    exposures_s=sorted(set(exposures)),
                )
            )
        return rows

    def as_json(self) -> dict[str, object]:
        """The plan and its limits, schema gap-plan/1. A limit `excluded_95` needs data, so it is missing here."""
        plan = {"images": len(self.plan.shots), "size_px": self.plan.size_px, "pointings": self.pointings}
        distances = sorted(self.limits.distances.items(), key=lambda one: one[1])
        return {
            "schema": SCHEMA,
            "plan": plan,
            "answer": {"floor": FLOOR},
            **self.limits.as_json(observed=False),
            "distances": [{"pair": list(pair), "distance": distance} for pair, distance in distances],
            "settled_by": self.settled_by,
            "searched": list(self.searched),
            "left_out": self.left_out,
        }


def limits_of_file(
    path: str | Path,
    fits_limits: FitsLimits,
    *,
    instrument: str | None = None,
    diffraction: Path | None = None,
    seed: int = 1,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> Planned:
    """The limits of the plan in a file, or of a transit (`read_plan`).

    Raises the errors of `read_plan`, of reading or building a diffraction PSF, and of `planned_limits`.

    Parameters
    ----------
    instrument
        The instrument whose diffraction PSF is used; None: the instrument of the transit or, if it names none,
        INSTRUMENT.
    diffraction
        A file with a diffraction PSF; None: the file that the transit names or, if it names none, the diffraction PSF
        of the instrument.
    """
    found = read_plan(path, fits_limits)
    _check_images(found.plan)
    known = diffraction or (found.known_psf if instrument is None else None)
    stated = found.instrument if found.instrument in instrument_names() else INSTRUMENT
    size = min(2 * found.plan.size_px, LARGEST_DIFFRACTION_PX)
    kernel = diffraction_kernel(instrument or stated or INSTRUMENT, known, size, fits_limits, threads=threads)
    return planned_limits(found.plan, kernel, seed=seed, threads=threads, progress=progress)


def planned_limits(
    plan: Plan,
    diffraction: Kernel,
    *,
    library: Sequence[Effect] = LIBRARY,
    seed: int = 1,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> Planned:
    """The limits of a plan.

    Raises DataError "too-few-images", and the errors of `true_sky` and `invert`.

    Parameters
    ----------
    diffraction
        The diffraction PSF: weights [y, x], centre at [n // 2, n // 2], sum 1.
    seed
        Seed of the scenes and of the noise.
    """
    _check_images(plan)
    transit = _noise_free(plan, diffraction, seed, threads)
    start = SOFTENED_POWER_LAW.coordinates({"b_px": SCATTER.b_px, "c": SCATTER.c, "total": SCATTER.total})
    solution = invert(transit, start=start, near=True, threads=threads, progress=progress)
    model, _ = linear_model_of(View(solution), library, seed=seed, progress=progress)
    effects, found = model.evidence.effects, limits(ClosedForm(model), observed=False)
    untestable = {**found.untestable, SUN: "a plan has no images of the Sun"}
    return Planned(
        plan,
        replace(found, untestable=untestable),
        tuple(effect.name for effect in effects if effect.held is not None),
        {effect.name: effect.settled_by for effect in effects},
        dict(solution.inversion.left_out),
    )


def _check_images(plan: Plan) -> None:
    if len(plan.shots) < LEAST_FRAMES:
        raise DataError(
            "too-few-images",
            f"expected a plan with at least {LEAST_FRAMES} images, which the fit of a PSF needs; got "
            f"{len(plan.shots)}: add images",
        )


def _noise_free(plan: Plan, diffraction: Kernel, seed: int, threads: int) -> Transit:
    sky = true_sky(plan, SCATTER, diffraction, seed, threads=threads)
    transit = observed_transit(sky, seed).transit
    rng = np.random.default_rng([seed, _BRIGHTNESS_STREAM])
    brightness = 1 + BRIGHTNESS_SPREAD * rng.normal(size=len(plan.shots))
    frames = tuple(
        replace(frame, pixels=(factor * sky.expected(n)).astype(np.float32))
        for n, (frame, factor) in enumerate(zip(transit.frames, brightness, strict=True))
    )
    return replace(transit, frames=frames)
