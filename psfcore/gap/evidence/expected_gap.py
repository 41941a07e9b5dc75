"""The expected gap: the residuals that the estimator leaves on data simulated from the fitted model itself.

Each pointing's mean scene is occulted where the occulter was found, convolved with the fitted PSF, and observed again
with photon and read noise. The same fit and the same cells then tell by how much chi2 exceeds its degrees of freedom if
the model is right. It does, because an occulter's place is never found exactly, and the light near the field's edge is
never restored completely.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from psfcore.gap.evidence.evidence import gather
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.view import View
from psfcore.scatter.inversion import Progress, invert
from psfcore.transit.transit import Transit


@dataclass(frozen=True)
class ExpectedGap:
    """disc_scale, unocculted_scale: chi2 per degree of freedom of the cells and of the blocks. scale_error: relative error
    of disc_scale. residual_pct: rms residual of the discs' means, in percent.
    """

    disc_scale: float
    unocculted_scale: float
    scale_error: float
    residual_pct: float


def simulated(view: View, seed: int) -> Transit:
    """The transit simulated from the fitted model and its own scenes, with noise."""
    solution = view.solution
    transit, optics = solution.transit, solution.optics
    frames = []
    for n, frame in enumerate(transit.frames):
        scene = view.pointing_scene(n) * view.uncovered(n)
        seen = optics.field(optics.convolve(optics.lanes(scene.astype(np.float32)))).astype(np.float64)
        rng = np.random.default_rng([seed, n])
        pixels = transit.noise.observe(seen, frame.exposure_s, rng)
        frames.append(replace(frame, pixels=pixels.astype(np.float32)))
    return replace(transit, frames=tuple(frames))


def expected_gap(
    view: View, *, seed: int = 1, floor: float, progress: Progress = lambda stage, step, steps: None
) -> ExpectedGap:
    """The residuals of the estimator on one simulation of the fitted model. view: of the fit.

    Raises DataError as `psfcore.scatter.inversion.invert` does.
    """
    solution = view.solution

    def say(stage: str, step: int, steps: int) -> None:
        progress(f"expected gap: {stage}", step, steps)

    again = invert(
        simulated(view, seed),
        solution.inversion.shape,
        start=solution.inversion.coordinates,
        near=True,
        threads=solution.threads,
        progress=say,
    )
    model = LinearModel(gather(again, (), progress=say), floor)
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
