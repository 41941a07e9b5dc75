"""Basic iterative deconvolution: Hofmeister et al. 2024, Solar Physics 299; van Cittert 1931.

    x <- x + w (y - H x),   x_0 = y      Eq. (1)

The paper recommends this method for a bright source near an edge. Eq. (1) converges to H x = y even if H moves light
out of the field. The method therefore restores the part of a pixel's light that falls outside the field. The method
must also take account of the light that enters from outside. If the scene is assumed to be zero beyond the field, the
pixels along the edge become a third too bright (measured with simulated scenes). Therefore, by default, the mirror
image of the field continues the scene beyond the field. If the field is much smaller than the PSF, the margin makes it
possible to use the whole PSF.

The method is linear: negative pixels are used unchanged, and the result may be negative. A masked pixel (w = 0) keeps
its first estimate. Let T be the Fourier transform of the PSF at one frequency. After n steps, the noise at this
frequency is the noise of the image times the sum over j = 0 .. n of (1 - T)^j. The noise grows without limit if
abs(1 - T) > 1.

| symbol | name | unit |
|---|---|---|
| y | observed | image unit |
| x | estimate | image unit |
| w | trusted, 1 or 0 | - |
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled
from psfcore.convolution.kernels import Lines, Single, rows_from_spectrum, rows_to_spectrum
from psfcore.convolution.lengths import LANES
from psfcore.deconvolve.conditions import Deconvolved
from psfcore.deconvolve.iterations.linear import (
    LinearIteration,
    TransferSample,
    noise_amplification,
    transfer_sample,
)
from psfcore.deconvolve.problem import Judgement, Problem, relative_change
from psfcore.errors import DataError

LARGEST_GROWTH = 10.0


def solve(problem: Problem) -> Deconvolved:
    """The result of Eq. (1), with its noise amplification. Raises DataError "method-diverges" if abs(1 - T) is too
    large.
    """
    sample = transfer_sample(problem.engine)
    _check_converges(sample, problem.steps)
    result = problem.solve(BasicIterative(problem))
    amplification = noise_amplification(sample, np.ones_like(sample.values), result.steps_done)
    return replace(result, noise_amplification=amplification)


class BasicIterative(LinearIteration):
    """Eq. (1) with one pass over the rows per step: `measure` computes the next estimate, and `update` adopts it."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem)
        self._next = np.zeros_like(self.x)

    def measure(self) -> None:
        self.engine.columns(adjoint=False)
        self.engine.row_stage(_step_rows, self.observed, self.x, self._next, self.changes, self.judgement)
        self.change = relative_change(*self.changes.sum(axis=1))

    def update(self, *, last: bool) -> None:
        self.x, self._next = self._next, self.x


def _check_converges(sample: TransferSample, steps: int) -> None:
    """Raise DataError "method-diverges" if `steps` steps with G = 1 can increase an error by more than
    LARGEST_GROWTH.
    """
    worst = float(np.abs(1 - sample.values).max())
    if worst > 1 and steps * np.log(worst) > np.log(LARGEST_GROWTH):
        advice = "use richardson-lucy or linear, or fewer steps"
        raise DataError(
            "method-diverges",
            "expected a PSF whose Fourier transform T has abs(1 - T) <= 1 at all frequencies; got up to "
            f"{worst:.3g}, and each of the {steps} steps multiplies an error by this number: {advice}",
        )


@compiled(fastmath={"contract", "reassoc"})
def _step_rows(
    lines: Lines,
    start: int,
    stop: int,
    observed: Single,
    x: Single,
    new: Single,
    changes: NDArray[np.float64],
    judgement: Judgement,
) -> None:
    """Compute `new` by Eq. (1) and transform its rows.

    Add up (change)^2 and x^2 over all pixels, and (y - H x)^2 / variance over the judged pixels.
    """
    nx, judged = x.shape[1], judgement.rows
    zero, least = np.float32(0.0), np.float32(1e-30)
    for block in range(start, stop):
        z = rows_from_spectrum(lines, block)
        sum_here, moved, total = np.float64(0.0), np.float64(0.0), np.float64(0.0)
        for i in range(nx):
            sum_row, moved_row, total_row = zero, zero, zero
            for side in range(2):
                for w in range(LANES):
                    y, model = observed[block, i, side, w], z[i, side, w]
                    misfit = y - model if y == y else zero
                    variance = max(judgement.slope * max(model, zero) + judgement.ground, least)
                    sum_row += judged[block, side, w] * misfit * misfit / variance
                    value = x[block, i, side, w] + misfit  # Eq. (1)
                    new[block, i, side, w] = value
                    z[i, side, w] = value
                    moved_row += misfit * misfit
                    total_row += value * value
            if judgement.first <= i < judgement.last:
                sum_here += sum_row
            moved += moved_row
            total += total_row
        judgement.sums[block], changes[0, block], changes[1, block] = sum_here, moved, total
        rows_to_spectrum(lines, block, nx)
