"""The additive step: the iteration of a linear method.

    x <- x + G w (y - H x),   x_0 = y      Eq. (1)

H is the convolution with the PSF, cut to the field. The filter G defines the method; for example, it is an approximate
inverse of H in `psfcore.deconvolve.methods.linear`. A masked pixel (w = 0) does not influence the fit. Negative pixels are
used unchanged.

| symbol | name | unit |
|---|---|---|
| y | observed | image unit |
| x | estimate | image unit |
| w | trusted, 1 or 0 | - |
| G | step_filter | - |
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled
from psfcore.convolution.engine import buffer_from_spectrum, spectrum_from_buffer
from psfcore.convolution.fft_kernels import LANES, forward, inverse
from psfcore.deconvolve.problem import Problem, first_estimate
from psfcore.deconvolve.stopping import Iteration


class Additive(Iteration):
    """The iteration of Eq. (1).

    step_filter: G, divided by `engine.transfer_scale`, in the layout of `engine.transfer`. A constant G is
    `np.full_like(engine.transfer[:, :, :1], G / engine.transfer_scale)`.
    """

    def __init__(self, problem: Problem, step_filter: NDArray[np.float32]) -> None:
        domain, engine = problem.domain, problem.engine
        self._engine, self._judgement = engine, problem.judgement
        self._step_filter = step_filter
        self.x = engine.to_lanes(first_estimate(problem))
        trusted = np.where(domain.trusted, domain.pixels, np.float32(np.nan))
        self._observed = engine.to_lanes(trusted, padding=np.nan)
        self._moved, self._total = np.zeros((2, engine.row_blocks))
        engine.rows_forward(self.x)

    def measure(self) -> None:
        self._engine.columns(adjoint=False)
        self._engine.row_stage(_residual_rows, self._observed, *self._judgement.numbers)

    def update(self, *, last: bool) -> None:
        self._engine.multiply_columns(self._step_filter)
        self._engine.row_stage(_add_rows, self.x, not last, self._moved, self._total)

    @property
    def change(self) -> float:
        """Rms of the change in the last step, divided by the rms of x."""
        total = float(self._total.sum())
        return float(np.sqrt(self._moved.sum() / total)) if total > 0 else 0.0


@compiled(fastmath={"contract", "reassoc"})
def _residual_rows(spectrum, observed, judged, first, last, slope, ground, sums, buffer, corner, start, stop, length, passes, lengths, tw, offsets, place):  # type: ignore[no-untyped-def]  # fmt: skip
    """Replace H x by w (y - H x), where y is NaN if w is 0. Add up (y - H x)^2 / variance over the judged pixels."""
    nx = observed.shape[1]
    zero, least = np.float32(0.0), np.float32(1e-30)
    z = buffer.reshape((-1, 2, LANES))
    for block in range(start, stop):
        buffer_from_spectrum(spectrum, buffer, corner, block, length, place)
        inverse(buffer, length, passes, lengths, tw, offsets)
        sum_here = 0.0
        for i in range(nx):
            sum_row = zero
            for side in range(2):
                for w in range(LANES):
                    y, model = observed[block, i, side, w], z[i, side, w]
                    misfit = y - model if y == y else zero
                    variance = max(slope * max(model, zero) + ground, least)
                    sum_row += judged[block, side, w] * misfit * misfit / variance
                    z[i, side, w] = misfit
            if first <= i < last:
                sum_here += sum_row
        sums[block] = sum_here
        buffer[nx * 2 * LANES : length * 2 * LANES] = zero
        forward(buffer, length, passes, lengths, tw, offsets)
        spectrum_from_buffer(spectrum, buffer, corner, block, length, place)


@compiled(fastmath={"contract", "reassoc"})
def _add_rows(spectrum, x, again, moved, total, buffer, corner, start, stop, length, passes, lengths, tw, offsets, place):  # type: ignore[no-untyped-def]  # fmt: skip
    """Compute x <- x + G w (y - H x), Eq. (1). Add up (change)^2 and x^2 for each block."""
    nx = x.shape[1]
    zero = np.float32(0.0)
    z = buffer.reshape((-1, 2, LANES))
    for block in range(start, stop):
        buffer_from_spectrum(spectrum, buffer, corner, block, length, place)
        inverse(buffer, length, passes, lengths, tw, offsets)
        moved_here, total_here = 0.0, 0.0
        for i in range(nx):
            moved_row, total_row = zero, zero
            for side in range(2):
                for w in range(LANES):
                    change = z[i, side, w]
                    value = x[block, i, side, w] + change  # Eq. (1)
                    x[block, i, side, w] = value
                    z[i, side, w] = value
                    moved_row += change * change
                    total_row += value * value
            moved_here += moved_row
            total_here += total_row
        moved[block], total[block] = moved_here, total_here
        if again:
            buffer[nx * 2 * LANES : length * 2 * LANES] = zero
            forward(buffer, length, passes, lengths, tw, offsets)
            spectrum_from_buffer(spectrum, buffer, corner, block, length, place)
