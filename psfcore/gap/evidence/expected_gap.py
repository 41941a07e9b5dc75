"""The linear model of a fit, and the expected gap: the residuals of a fit to images that are simulated from the fitted
model itself.

The simulation takes the mean scene of each pointing and puts the occulter where it was found. It convolves this scene
with the fitted PSF and adds photon and read noise. The same fit is then made to the simulated images. In their cells,
chi2 exceeds its degrees of freedom although the model is right: the position of an occulter is never found exactly, and
the light near the edge of the field is never restored completely. The expected gap states this excess.

The simulated images are so similar to the real ones that their cells have the same covariance and respond in the same
way to a change of the PSF. Only their residuals are computed again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from psfcore.gap.effect import Effect
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.evidence.responses import Evidence, gather, residuals_at
from psfcore.gap.view import View
from psfcore.scatter.inversion import invert
from psfcore.scatter.reconstruction import Progress, labelled
from psfcore.transit.transit import Transit

SMALLEST_SCALE, LARGEST_SCALE = 1.0, 3.0  # of `LinearModel.disc_scale` and `unocculted_scale`


@dataclass(frozen=True)
class ExpectedGap:
    """The residuals that remain if the model is right.

    Attributes
    ----------
    disc_scale
        The chi2 of the cells, per degree of freedom.
    unocculted_scale
        The chi2 of the unocculted blocks, per degree of freedom.
    scale_error
        Relative error of `disc_scale`.
    residual_pct
        Rms residual of the discs' means, in percent.
    """

    disc_scale: float
    unocculted_scale: float
    scale_error: float
    residual_pct: float


def simulated(view: View, seed: int) -> Transit:
    """The transit with simulated images: the fitted model and its scenes, plus noise from this seed."""
    solution = view.solution
    transit, optics = solution.transit, solution.optics
    frames = []
    for n, frame in enumerate(transit.frames):
        scene = view.pointing_scene(n) * view.uncovered(n)
        seen = optics.field(optics.convolve(optics.lanes(scene.astype(np.float32)))).astype(np.float64)
        pixels = transit.noise.observe(seen, frame.exposure_s, np.random.default_rng([seed, n]))
        frames.append(replace(frame, pixels=pixels.astype(np.float32)))
    return replace(transit, frames=tuple(frames))


def linear_model_of(
    view: View,
    library: Sequence[Effect],
    *,
    seed: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> tuple[LinearModel, ExpectedGap]:
    """The linear model of a fit with a library of effects, and the expected gap.

    Raises the errors of `gather` and of `psfcore.scatter.inversion.invert`.

    Parameters
    ----------
    seed
        The seed of the simulation.
    """
    evidence = gather(view.solution, library, view=view, progress=progress)
    expected = _expected_gap(view, evidence, seed, progress)
    model = LinearModel(
        evidence,
        FLOOR,
        disc_scale=float(np.clip(expected.disc_scale, SMALLEST_SCALE, LARGEST_SCALE)),
        unocculted_scale=float(np.clip(expected.unocculted_scale, SMALLEST_SCALE, LARGEST_SCALE)),
        scale_error=expected.scale_error,
    )
    return model, expected


def _expected_gap(view: View, evidence: Evidence, seed: int, progress: Progress) -> ExpectedGap:
    """The expected gap from one simulation; `view` and `evidence` are those of the fit."""
    solution, told = view.solution, labelled(progress, "expected gap")
    again = invert(
        simulated(view, seed),
        solution.inversion.shape,
        start=solution.inversion.coordinates,
        near=True,
        threads=solution.threads,
        progress=told,
    )
    model = LinearModel(residuals_at(View(again), evidence, progress=told), FLOOR)
    left = model.left(model.base)
    cells = max(sum(one.size for one in left) - len(model.base.columns), 1)
    unocculted = model.evidence.all_unocculted
    residual = [100 * float(d.share @ d.residual) / d.level for d in model.evidence.discs]
    return ExpectedGap(
        disc_scale=sum(float(one @ one) for one in left) / cells,
        unocculted_scale=unocculted.chi2 / unocculted.freedom,
        scale_error=float(np.sqrt(2 / cells)),
        residual_pct=float(np.sqrt(np.mean(np.square(residual)))),
    )
