"""Linear deconvolution by an approximate inverse of the PSF.

    x <- x + G w (y - H x),   x_0 = y,   G = T* / max(abs(T)^2, t^2)      Eq. (1)

H is the convolution with the PSF, cut to the field. T is the PSF's Fourier transform on the padded, periodic plane.
Where abs(T) is at least t (LEAST_TRANSFER), G = 1 / T, which inverts H except for light that crosses the edge of the
field; a few steps correct for this light. If the PSF changes over the field, T is the transform of K0, and the steps
also correct for the change. Where abs(T) is below t, Eq. (1) is a Landweber step: frequencies at which
the PSF has little power are restored slowly, and the noise at these frequencies is amplified slowly.

The method does not force the scene to be positive, so faint pixels have no bias. For one PSF, the method amplifies the
noise of every image by the same factor, `noise_amplification` (2 to 2.4 for HRI_EUV). Negative pixels are used
unchanged, and the result may be negative. A masked pixel (w = 0) does not influence the fit; its estimate follows from
its neighbours.

Another filter G in Eq. (1) makes another linear method; `Additive` is the iteration for any G.

The noise amplification is computed frequency by frequency. T is the PSF's Fourier transform at one frequency.
After n steps, the method has multiplied the amplitude of the image at this frequency by

    A_n = A_(n-1) + G (1 - T A_(n-1)),   A_0 = 1        Eq. (2)

The method multiplies the rms of uncorrelated noise by the root of the mean of abs(A)^2 over all frequencies. This
factor holds away from edges and masked pixels. T varies smoothly from frequency to frequency. Therefore only every k-th
frequency along y is used; k is 2, 3, 4 or 8, depending on the length of the transform.

| symbol | name | unit |
|---|---|---|
| y | observed | image unit |
| x | estimate | image unit |
| w | trusted, 1 or 0 | - |
| G | inverse_filter, step_filter; step of Eq. (2): 1, or an inverse of T | - |
| T | values of TransferSample | - |
| A | gain | - |
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled
from psfcore.convolution.engine import Engine
from psfcore.convolution.kernels import (
    BLOCK_ROWS,
    Lines,
    Single,
    clear_rows_beyond,
    rows_from_spectrum,
    rows_to_spectrum,
)
from psfcore.convolution.lengths import LANES
from psfcore.deconvolve.conditions import Deconvolved
from psfcore.deconvolve.problem import (
    Iteration,
    Judgement,
    Problem,
    first_estimate,
    relative_change,
)

LEAST_TRANSFER = 0.1


def solve(problem: Problem) -> Deconvolved:
    """The result of Eq. (1), with its noise amplification."""
    result = problem.solve(Additive(problem, inverse_filter(problem.engine)))
    sample = transfer_sample(problem.engine)
    g = np.conj(sample.central) / np.maximum(np.abs(sample.central) ** 2, LEAST_TRANSFER**2)
    return replace(result, noise_amplification=noise_amplification(sample, g, result.steps_done))


def inverse_filter(engine: Engine) -> NDArray[np.float32]:
    """Compute G of Eq. (1) in the layout of the engine's transfer function."""
    scale = np.float32(engine.transfer_scale)
    power = np.square(engine.transfer).sum(axis=2, keepdims=True) * scale**2
    g: Single = engine.transfer / np.maximum(power, np.float32(LEAST_TRANSFER**2))
    if not engine.symmetric:
        g[:, :, 1] *= -1
    return g


class LinearIteration(Iteration):
    """What the iterations of linear methods share: x_0 = y, and y without the masked pixels."""

    def __init__(self, problem: Problem) -> None:
        domain, engine = problem.domain, problem.engine
        self.engine, self.judgement = engine, problem.judgement
        self.x = engine.to_lanes(first_estimate(problem))
        trusted = np.where(domain.trusted, domain.pixels, np.float32(np.nan))
        self.observed = engine.to_lanes(trusted, padding=np.nan)
        self.changes = np.zeros((2, engine.row_blocks))  # sums of (change)^2 and x^2
        engine.rows_forward(self.x)


class Additive(LinearIteration):
    """The iteration of Eq. (1).

    Parameters
    ----------
    step_filter
        The filter G, divided by `engine.transfer_scale`, in the layout of `engine.transfer`. A constant G is
        `np.full_like(engine.transfer[:, :, :1], G / engine.transfer_scale)`.
    """

    def __init__(self, problem: Problem, step_filter: NDArray[np.float32]) -> None:
        super().__init__(problem)
        self._step_filter = step_filter

    def measure(self) -> None:
        self.engine.columns(adjoint=False)
        rows = _all_rows(self.engine)
        self.engine.row_stage(_residual_rows, self.observed, self.judgement, rows, before_h=False)

    def update(self, *, last: bool) -> None:
        self.engine.multiply_columns(self._step_filter)
        self.engine.row_stage(_add_rows, self.x, not last, self.changes, _all_rows(self.engine))
        self.change = relative_change(*self.changes.sum(axis=1))


def _all_rows(engine: Engine) -> int:
    """The number of rows of a field with those that complete its last block."""
    return engine.row_blocks * BLOCK_ROWS


def solve_linear(
    engine: Engine,
    step_filter: NDArray[np.float32],
    observed: Single,
    start: Single,
    steps: int,
    *,
    settled: float = 0.0,
) -> Single:
    """The estimate x after some steps of Eq. (1), for an observation whose pixels are all trusted; in the engine's
    layout.

    The scene is dark beyond the edges of the field.

    Parameters
    ----------
    start
        The first estimate, which is overwritten by the result.
    step_filter
        The filter of a step, as for `Additive`.
    settled
        The iteration ends before `steps` if a step changes the estimate by less than this fraction (rms).
    """
    x, rows = start, engine.field_shape[0]
    changes, sums = np.zeros((2, engine.row_blocks)), np.zeros(engine.row_blocks)
    rows_judged = np.zeros((engine.row_blocks, 2, LANES), np.float32)
    nothing = Judgement(rows_judged, 0, 0, 0, np.float32(0), np.float32(1), sums)
    engine.rows_forward(x)
    for left in reversed(range(steps)):
        engine.columns(adjoint=False)
        engine.row_stage(_residual_rows, observed, nothing, rows, before_h=False)
        engine.multiply_columns(step_filter)
        engine.row_stage(_add_rows, x, left > 0, changes, rows)
        if relative_change(*changes.sum(axis=1)) < settled:
            break
    return x


@dataclass(frozen=True, eq=False)
class TransferSample:
    """Values of T at some frequencies (float64 or complex128) and the weights of these frequencies, which sum to 1.

    Attributes
    ----------
    central
        The values from which the filter G of Eq. (1) is made: those of K0 if the PSF changes over the field, else
        `values`.
    """

    values: NDArray[np.floating] | NDArray[np.complexfloating]
    weights: NDArray[np.float64]
    central: NDArray[np.floating] | NDArray[np.complexfloating]


def transfer_sample(engine: Engine) -> TransferSample:
    """A sample of an engine's transfer function: along y, every k-th frequency (k: first radix of its transform). If
    the PSF changes over the field, the sample has the transfer functions at nine places.
    """
    rows = int(engine.column_plan.lengths[1])
    # Frequencies along x run from 0 to L / 2. Except the first and last, each also represents its negative.
    k, half = np.arange(engine.column_blocks * LANES), engine.row_plan.length // 2
    times = np.where((k == 0) | (k == half), 1.0, np.where(k < half, 2.0, 0.0))
    weights = np.broadcast_to(times.reshape(-1, 1, LANES), (engine.column_blocks, rows, LANES))
    used = weights > 0
    values = np.array([_complex(engine, one)[used] for one in engine.local_transfers(rows)])
    weights = np.tile(weights[used], len(values))
    central = np.array([_complex(engine, engine.transfer[:, :rows])[used]] * len(values))
    return TransferSample(values.reshape(-1), weights / weights.sum(), central.reshape(-1))


def _complex(engine: Engine, transfer: Single) -> NDArray[np.float64] | NDArray[np.complex128]:
    """The values of T in some rows of a transfer function, [block of columns][row][lane]."""
    lanes = transfer.astype(np.float64) * engine.transfer_scale
    return lanes[:, :, 0] if engine.symmetric else lanes[:, :, 0] + 1j * lanes[:, :, 1]


def noise_amplification(
    sample: TransferSample, step: NDArray[np.floating] | NDArray[np.complexfloating], steps: int
) -> float:
    """Rms noise of the estimate after `steps` steps, divided by the rms noise of the image.

    Parameters
    ----------
    step
        The filter G of Eq. (2).
    """
    # The closed form A_n = (1 - (1 - G T)^n (1 - T)) / T fails for T near 0.
    gain = np.ones_like(sample.values)
    for _ in range(steps):
        gain = gain + step * (1 - sample.values * gain)  # Eq. (2)
    return float(np.sqrt(np.sum(sample.weights * np.abs(gain) ** 2)))


@compiled(fastmath={"contract", "reassoc"})
def _residual_rows(
    lines: Lines, start: int, stop: int, observed: Single, judgement: Judgement, rows: int
) -> None:
    """Replace H x by w (y - H x), where y is NaN if w is 0. Add up (y - H x)^2 / variance over the judged pixels.

    The result is 0 beyond the number of rows.
    """
    nx, judged = observed.shape[1], judgement.rows
    zero, least = np.float32(0.0), np.float32(1e-30)
    for block in range(start, stop):
        z = rows_from_spectrum(lines, block)
        sum_here = np.float64(0.0)
        for i in range(nx):
            sum_row = zero
            for side in range(2):
                for w in range(LANES):
                    y, model = observed[block, i, side, w], z[i, side, w]
                    misfit = y - model if y == y else zero
                    variance = max(judgement.slope * max(model, zero) + judgement.ground, least)
                    sum_row += judged[block, side, w] * misfit * misfit / variance
                    z[i, side, w] = misfit
            if judgement.first <= i < judgement.last:
                sum_here += sum_row
        judgement.sums[block] = sum_here
        clear_rows_beyond(z, rows - block * 2 * LANES, nx)
        rows_to_spectrum(lines, block, nx)


@compiled(fastmath={"contract", "reassoc"})
def _add_rows(
    lines: Lines, start: int, stop: int, x: Single, again: bool, changes: NDArray[np.float64], rows: int
) -> None:
    """Compute x <- x + G w (y - H x), Eq. (1). Add up (change)^2 and x^2 for each block. x is 0 beyond the number of
    rows.
    """
    nx = x.shape[1]
    zero = np.float32(0.0)
    for block in range(start, stop):
        z = rows_from_spectrum(lines, block)
        moved, total = np.float64(0.0), np.float64(0.0)
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
            moved += moved_row
            total += total_row
        changes[0, block], changes[1, block] = moved, total
        clear_rows_beyond(z, rows - block * 2 * LANES, nx)
        clear_rows_beyond(x[block], rows - block * 2 * LANES, nx)
        if again:
            rows_to_spectrum(lines, block, nx)
