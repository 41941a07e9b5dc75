"""Richardson-Lucy deconvolution (Richardson 1972, Lucy 1974), which Hofmeister et al. recommend for HRI_EUV.

    x <- x * H^T( w y / (H x) + (1 - w) / s ),   s = H^T 1      Eq. (1)

Without masked pixels (w = 1), Eq. (1) is the published step. It conserves the flux, sum x = sum y over the plane,
because H^T is applied to y / (H x). A masked pixel (w = 0) gets the ratio 1 / s, at which it agrees with the model and
does not change the fit. The ratio 1 would be wrong for the following reason. The published step does not restore light
that leaves the plane, so the ratios of the other pixels converge to 1 / s. A pixel with the ratio 1 would become
fainter by the factor s at each step. Negative pixels are due to noise around zero. They count as 0 in the ratio,
because the method cannot represent negative light.

The other Richardson-Lucy methods use the same ratio, with another value a for masked pixels:

    w y / (H x) + (1 - w) a      Eq. (2)

One plane stores the light (at least 0) of the trusted pixels, and -a for the masked pixels.

In the paper the scene is zero beyond the field (edges "zero"). In this case, the outermost rows of the result become 4
to 6 % too dark: light that enters from beyond the field replaces the light that leaves the field, but only on average.
If the mirror image of the field continues the scene, the error is at most 1.3 % (measured with simulated scenes). The
default is therefore "symmetric". A margin of about 64 px is enough, because the published step compensates for the
light that crosses the edge of the margin.

| symbol | name | unit |
|---|---|---|
| y | observed | image unit |
| x | estimate | image unit |
| w | trusted, 1 or 0 | - |
| s | share of a pixel's light that falls on the plane and on the PSF's array; 1 / s is `agreed` | - |
| a | agreed: ratio at which a masked pixel does not change the estimate; 1 / s here | - |
| H, H^T | Engine.apply, Engine.adjoint | - |
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled
from psfcore.convolution.kernels import Lines, Single, rows_from_spectrum, rows_to_spectrum
from psfcore.convolution.lengths import LANES
from psfcore.deconvolve.problem import (
    Iteration,
    Judgement,
    Problem,
    first_estimate,
    relative_change,
)
from psfcore.errors import DataError

# Smallest value of a model pixel, as a fraction of the brightest pixel (the "floor"). The floor is the resolution of
# float32; smaller values are dominated by the rounding of the transform. The floor also avoids denormal numbers, which
# are slow.
FLOOR_OF_MAXIMUM = 2.0**-23
# An estimate below this fraction of the floor is set to 0.
DARK_OF_FLOOR = 1e-6
# The compiler may reorder a sum within a block. The new order is fixed, so it does not depend on the threads.
_SUMS = {"contract", "reassoc"}
_SUMMED = 16 * LANES


class LucyIteration(Iteration):
    """The first half of a step of every Richardson-Lucy method: `measure` replaces H x by the ratio of Eq. (2).

    Estimates below the attribute `dark` are set to 0.

    Parameters
    ----------
    agreed
        The array a [y, x] of Eq. (2), above 0.
    brightest
        Largest value of the first estimate; the floor is a fraction of this value.
    """

    def __init__(self, problem: Problem, agreed: Single | float, brightest: float) -> None:
        domain = problem.domain
        self.engine, self.judgement = problem.engine, problem.judgement
        self.floor = np.float32(FLOOR_OF_MAXIMUM * brightest)
        self.dark = self.floor * np.float32(DARK_OF_FLOOR)
        of_masked = np.broadcast_to(np.float32(agreed), domain.shape)

        def light_or_agreed(rows: slice) -> Single:
            return np.where(domain.trusted[rows], np.maximum(domain.pixels[rows], 0), -of_masked[rows])

        self._light_or_agreed = self.engine.lanes_of(light_or_agreed)

    def measure(self) -> None:
        self.engine.columns(adjoint=False)
        self.engine.row_stage(_ratio_rows, self._light_or_agreed, self.floor, self.judgement, before_h=False)


class RichardsonLucy(LucyIteration):
    """The iteration of Eq. (1). A block of rows stays in the cache between two convolutions."""

    def __init__(self, problem: Problem) -> None:
        estimate = light_above_floor(problem)
        brightest = float(estimate.max())
        self.x = problem.engine.to_lanes(estimate)
        del estimate  # makes room for the planes of the ratio
        super().__init__(problem, agreed(problem), brightest)
        self._changes = np.zeros((2, problem.engine.row_blocks))
        self.engine.rows_forward(self.x)

    def update(self, *, last: bool) -> None:
        self.engine.columns(adjoint=True)
        self.engine.row_stage(_update_rows, self.x, self.dark, not last, self._changes)  # Eq. (1)
        self.change = relative_change(*self._changes.sum(axis=1))


def light_above_floor(problem: Problem) -> Single:
    """The first estimate [y, x], with values below the floor raised to the floor.

    Raises DataError "no-signal" if no trusted pixel is above zero.
    """
    domain = problem.domain
    if not np.any(domain.pixels > 0, where=domain.trusted):
        raise DataError(
            "no-signal",
            "expected at least one trusted pixel above zero; got none: use another image or the method linear",
        )
    estimate = first_estimate(problem)
    return np.maximum(estimate, np.float32(FLOOR_OF_MAXIMUM * float(estimate.max())), out=estimate)


def agreed(problem: Problem) -> Single | float:
    """Compute 1 / s of Eq. (1) on the domain. If all pixels are trusted, 1 / s is not needed, and the result is 1."""
    if problem.domain.trusted.all():
        return 1.0
    ones = np.broadcast_to(np.float32(1), problem.domain.shape)  # one number, so that there is no plane of it
    share = problem.engine.adjoint(ones)
    np.maximum(share, np.finfo(np.float32).eps, out=share)
    return np.divide(1, share, out=share)


@compiled(fastmath=_SUMS, error_model="numpy")
def _ratio_rows(
    lines: Lines, start: int, stop: int, light: Single, floor: np.float32, judgement: Judgement
) -> None:
    """Replace H x, raised to `floor` where it is smaller, by Eq. (2). Add up (y - H x)^2 / variance over the judged
    pixels.
    """
    nx, judged = light.shape[1], judgement.rows
    zero, least = np.float32(0.0), np.float32(1e-30)
    for block in range(start, stop):
        z = rows_from_spectrum(lines, block)
        sum_here = np.float64(0.0)
        for i in range(nx):
            sum_row = zero
            for side in range(2):
                for w in range(LANES):
                    y = light[block, i, side, w]
                    model = max(z[i, side, w], floor)
                    misfit = y - model
                    part = (
                        judged[block, side, w]
                        * misfit
                        * misfit
                        / max(judgement.slope * model + judgement.ground, least)
                    )
                    sum_row += part if y >= zero else zero
                    z[i, side, w] = y / model if y >= zero else -y
            if judgement.first <= i < judgement.last:
                sum_here += sum_row
        judgement.sums[block] = sum_here
        rows_to_spectrum(lines, block, nx)


@compiled(fastmath=_SUMS, error_model="numpy")
def _update_rows(
    lines: Lines,
    start: int,
    stop: int,
    estimate: Single,
    dark: np.float32,
    again: bool,
    changes: NDArray[np.float64],
) -> None:
    """Compute x <- x * correction, Eq. (1). Set values below `dark` to 0. Add up (change)^2 and x^2 for each block."""
    used = estimate.shape[1] * 2 * LANES
    zero, buffer = np.float32(0.0), lines.buffer
    for block in range(start, stop):
        rows_from_spectrum(lines, block)
        whole = estimate[block].reshape(-1)
        moved, total = np.float64(0.0), np.float64(0.0)
        # The sums of short parts are in single precision, so that the compiler can use vector instructions.
        for first in range(0, used, _SUMMED):
            moved_part = zero
            total_part = zero
            x, z = whole[first : first + _SUMMED], buffer[first : first + _SUMMED]
            for n in range(x.size):
                old = x[n]
                # Rounding may turn a correction of 0 into a negative number.
                new = old * max(z[n], zero)
                new = zero if new < dark else new
                x[n] = new
                z[n] = new
                moved_part += (new - old) * (new - old)
                total_part += new * new
            moved += moved_part
            total += total_part
        changes[0, block], changes[1, block] = moved, total
        if again:
            rows_to_spectrum(lines, block, estimate.shape[1])
