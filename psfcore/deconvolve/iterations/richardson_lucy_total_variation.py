"""Richardson-Lucy with total variation: Dey et al. 2006, Microscopy Research and Technique 69, 260.

    x <- x / (1 - k div(grad x / |grad x|)) * H^T( w y / (H x) + (1 - w) / s )      Eq. (1), their Eq. (14)

Eq. (1) is the step of `richardson_lucy`, with the same masks and edges, and with a penalty on differences between
neighbouring pixels. k is the weight of the penalty. A fit to the noise increases the penalty by more than it decreases
chi2, so further steps do not amplify the noise. We simulated HRI_EUV images with 100 photons in a quiet pixel. After 20
steps, the rms error of this method is 157 DN/s in an image of 512 px, and 92 DN/s at 1024 px. The rms error of plain
Richardson-Lucy is 169 and 130 DN/s after 20 steps. After its best number of steps, it is 166 and 112 DN/s, but for real
images this number is not known. Structures that are as faint as the noise are lost too. Use this method for pictures
and for finding features. Do not use it for the photometry of small spots: they stay smoothed even without noise, and
the forward differences shift them by up to 0.002 px.

|grad x| is the root of a sum of squares: of the two forward differences, and of SOFTENING times x. Differences below a
tenth of the light are therefore smoothed only weakly. The paper has no softening. Without it, the step overshoots
where differences are small, and an area of uniform light breaks up into a pattern with an amplitude of 4 k.

| symbol | name | unit |
|---|---|---|
| k | smoothing | - |
| x, y, w, s | as in richardson_lucy | |
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled
from psfcore.convolution.kernels import Single
from psfcore.deconvolve.iterations.richardson_lucy import LucyIteration, agreed, light_above_floor
from psfcore.deconvolve.problem import Problem, relative_change

# One step multiplies a small difference by 1 - 8 k / SOFTENING. The steps converge if 8 k / SOFTENING is below 2.
SOFTENING = 0.1


class TotalVariation(LucyIteration):
    """The iteration of Eq. (1). x is a plane [y, x], because the differences connect pixels of different blocks of the
    engine.
    """

    def __init__(self, problem: Problem, smoothing: float) -> None:
        self.x = light_above_floor(problem)
        self._new = np.empty_like(self.x)
        super().__init__(problem, agreed(problem), float(self.x.max()))
        self._smoothing = np.float32(smoothing)
        self._softening = np.float32(SOFTENING)
        self._lanes = problem.engine.to_lanes(self.x)
        self.engine.rows_forward(self._lanes)

    def update(self, *, last: bool) -> None:
        self.engine.columns(adjoint=True)
        self.engine.rows_inverse(self._lanes)
        correction = self.engine.from_lanes(self._lanes)
        sums = np.zeros((self.x.shape[0], 2))
        planes = self.x, correction, self._new
        self.engine.run(
            lambda start, stop, _: _smooth_rows(
                planes, self._smoothing, self._softening, self.dark, sums, start, stop
            ),
            self.x.shape[0],
        )
        self.x, self._new = self._new, self.x
        self.change = relative_change(*sums.sum(axis=0))
        if not last:
            self._lanes = self.engine.to_lanes(self.x)
            self.engine.rows_forward(self._lanes)


@compiled()
def _direction(x: Single, row: int, column: int, softening: np.float32) -> tuple[np.float32, np.float32]:
    """Grad x / |grad x| at a pixel, (along y, along x). Differences beyond the last row and column count as 0."""
    zero = np.float32(0.0)
    here = x[row, column]
    dy = x[row + 1, column] - here if row + 1 < x.shape[0] else zero
    dx = x[row, column + 1] - here if column + 1 < x.shape[1] else zero
    least = softening * here
    length = np.sqrt(dy * dy + dx * dx + least * least)
    if length == zero:
        return zero, zero
    return dy / length, dx / length


@compiled()
def _smooth_rows(
    planes: tuple[Single, Single, Single],
    smoothing: np.float32,
    softening: np.float32,
    dark: np.float32,
    sums: NDArray[np.float64],
    start: int,
    stop: int,
) -> None:
    """Compute `new` by Eq. (1) on rows [start, stop). Set values below `dark` to 0. Sum (change)^2 and x^2 by row.

    Parameters
    ----------
    planes
        The planes x, correction and new.
    """
    x, correction, new = planes
    zero, one = np.float32(0.0), np.float32(1.0)
    for row in range(start, stop):
        moved, total = np.float64(0.0), np.float64(0.0)
        left = zero
        for column in range(x.shape[1]):
            down, right = _direction(x, row, column, softening)
            up = _direction(x, row - 1, column, softening)[0] if row > 0 else zero
            divergence = down - up + right - left
            left = right
            value = (
                x[row, column] * max(correction[row, column], zero) / (one - smoothing * divergence)
            )  # Eq. (1)
            value = zero if value < dark else value
            new[row, column] = value
            moved += (value - x[row, column]) ** 2
            total += value * value
        sums[row, 0], sums[row, 1] = moved, total
