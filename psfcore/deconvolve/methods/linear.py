"""Linear deconvolution by an approximate inverse of the PSF.

    x <- x + G w (y - H x),   x_0 = y,   G = T* / max(abs(T)^2, t^2)      Eq. (1)

H is the convolution with the PSF, cut to the field. T is the PSF's Fourier transform on the padded, periodic plane. G
therefore inverts H, except for light that crosses the edge of the field; a few steps correct for that light. Where
abs(T) is below t (LEAST_TRANSFER), Eq. (1) is a Landweber step: frequencies at which the PSF has little power are
restored slowly, and the noise at these frequencies is amplified slowly.

The method does not force the scene to be positive, so faint pixels have no bias. For one PSF, the method amplifies the
noise of every image by the same factor, `noise_amplification` (2 to 2.4 for HRI_EUV). Negative pixels are used
unchanged, and the result may be negative. A masked pixel (w = 0) does not influence the fit; its estimate follows from
its neighbours.

| symbol | name | unit |
|---|---|---|
| y | observed | image unit |
| x | estimate | image unit |
| w | trusted, 1 or 0 | - |
| G | inverse | - |
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled
from psfcore.convolution.engine import Engine, buffer_from_spectrum, spectrum_from_buffer
from psfcore.convolution.fft_kernels import LANES, forward, inverse
from psfcore.deconvolve.conditions import Conditions
from psfcore.deconvolve.edges import Edges
from psfcore.deconvolve.frequencies import noise_amplification, transfer_sample
from psfcore.deconvolve.problem import Problem, first_estimate, pose, solution
from psfcore.deconvolve.result import Deconvolved
from psfcore.deconvolve.stopping import Iteration, Stop
from psfcore.image import Image
from psfcore.psf import Psf

METHOD = "linear"
EDGES: Edges = "symmetric"
MAY_BE_NEGATIVE = True
MARGIN_SHARE = 0.015
LEAST_TRANSFER = 0.1


def deconvolve(
    image: Image, psf: Psf, conditions: Conditions, *, steps: int = 5, stop: Stop = "fixed"
) -> Deconvolved:
    """Estimate the scene from `image` [y, x], which was observed with `psf`. The first estimate is the observation.

    The result may be negative. It is NaN where the image is not finite. Raises the errors of `problem.pose`.
    """
    problem = pose(image, psf, conditions, edges=EDGES, margin_share=MARGIN_SHARE, steps=steps, stop=stop)
    iteration = _Linear(problem)
    ended = problem.solve(iteration, steps=steps, stop=stop)
    sample = transfer_sample(problem.engine)
    g = np.conj(sample.values) / np.maximum(np.abs(sample.values) ** 2, LEAST_TRANSFER**2)
    return solution(
        problem,
        problem.engine.from_lanes(iteration.x),
        ended,
        method=METHOD,
        last_change=iteration.change,
        negatives_count=True,
        noise_amplification=noise_amplification(sample, g, ended.steps_done),
    )


class _Linear(Iteration):
    """Eq. (1)."""

    def __init__(self, problem: Problem) -> None:
        domain, engine = problem.domain, problem.engine
        self._engine, self._judgement = engine, problem.judgement
        self._inverse = inverse_filter(engine)
        self.x = engine.to_lanes(first_estimate(problem))
        trusted = np.where(domain.trusted, domain.pixels, np.float32(np.nan))
        self._observed = engine.to_lanes(trusted, padding=np.nan)
        self._moved, self._total = np.zeros((2, engine.row_blocks))
        engine.rows_forward(self.x)

    def measure(self) -> None:
        self._engine.columns(adjoint=False)
        self._engine.row_stage(_residual_rows, self._observed, *self._judgement.numbers)

    def update(self, *, last: bool) -> None:
        self._engine.multiply_columns(self._inverse)
        self._engine.row_stage(_add_rows, self.x, not last, self._moved, self._total)

    @property
    def change(self) -> float:
        """Rms of the change in the last step, divided by the rms of x."""
        total = float(self._total.sum())
        return float(np.sqrt(self._moved.sum() / total)) if total > 0 else 0.0


def inverse_filter(engine: Engine) -> NDArray[np.float32]:
    """Compute G of Eq. (1) in the layout of the engine's transfer function."""
    scale = np.float32(engine.transfer_scale)
    power = np.square(engine.transfer).sum(axis=2, keepdims=True) * scale**2
    g = engine.transfer / np.maximum(power, np.float32(LEAST_TRANSFER**2))
    if not engine.symmetric:
        g[:, :, 1] *= -1
    return g


@compiled(fastmath={"contract", "reassoc"})
def _residual_rows(spectrum, observed, judged, first, last, slope, ground, sums, buffer, corner, start, stop, length, radices, lengths, tw, offsets, place):  # type: ignore[no-untyped-def]  # fmt: skip
    """Replace H x by w (y - H x), where y is NaN if w is 0; sum (y - H x)^2 / variance over judged pixels."""
    nx = observed.shape[1]
    zero, least = np.float32(0.0), np.float32(1e-30)
    z = buffer.reshape((-1, 2, LANES))
    for block in range(start, stop):
        buffer_from_spectrum(spectrum, buffer, corner, block, length, place)
        inverse(buffer, length, radices, lengths, tw, offsets)
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
        forward(buffer, length, radices, lengths, tw, offsets)
        spectrum_from_buffer(spectrum, buffer, corner, block, length, place)


@compiled(fastmath={"contract", "reassoc"})
def _add_rows(spectrum, x, again, moved, total, buffer, corner, start, stop, length, radices, lengths, tw, offsets, place):  # type: ignore[no-untyped-def]  # fmt: skip
    """Compute x <- x + G w (y - H x), Eq. (1); sum (change)^2 and x^2 for each block."""
    nx = x.shape[1]
    zero = np.float32(0.0)
    z = buffer.reshape((-1, 2, LANES))
    for block in range(start, stop):
        buffer_from_spectrum(spectrum, buffer, corner, block, length, place)
        inverse(buffer, length, radices, lengths, tw, offsets)
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
            forward(buffer, length, radices, lengths, tw, offsets)
            spectrum_from_buffer(spectrum, buffer, corner, block, length, place)
