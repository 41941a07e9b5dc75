"""Richardson-Lucy with vector extrapolation: Biggs & Andrews 1997, Applied Optics 36, 1766.

    p_k = x_k + a_k h_k + (a_k^2 / 2) q_k,    h_k = x_k - x_(k-1),  q_k = x_k - 2 x_(k-1) + x_(k-2)     Eq. (1)
    x_(k+1) = R(p_k)                                                                                    Eq. (2)
    a_k = sum(g_(k-1) g_(k-2)) / sum(g_(k-2)^2),  0 <= a_k < 1,   g_k = x_(k+1) - p_k                   Eq. (3)

R is one Richardson-Lucy step, with the masks and edges of `richardson_lucy`. With order 1, the term with q is left out.
Predictions are kept above 0. A few accelerated steps change the estimate as much as many plain steps. If the image is
noisy, the noise is therefore also amplified after fewer steps: use the stopping rule "discrepancy".

| symbol | name |
|---|---|
| x, p, g | x, prediction, gradient |
| a | acceleration |
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled
from psfcore.convolution.kernels import Single
from psfcore.deconvolve.iterations.richardson_lucy import LucyIteration, agreed, light_above_floor
from psfcore.deconvolve.problem import Problem, relative_change

# Biggs & Andrews require an acceleration below 1.
_MOST_ACCELERATION = 0.999


class Accelerated(LucyIteration):
    """The iteration of Eq. (1) to (3). Its `x` is the prediction, which `measure` convolves; after the last step it is
    x.
    """

    def __init__(self, problem: Problem, order: int) -> None:
        estimate = light_above_floor(problem)
        super().__init__(problem, agreed(problem), float(estimate.max()))
        self._order = order
        self.x = problem.engine.to_lanes(estimate)
        self._x, self._before = self.x.copy(), self.x.copy()
        # Order 1 does not need x_(k-2), so the array of x_(k-1) takes its role.
        self._earlier = self.x.copy() if order == 2 else self._before
        self._gradient = np.zeros_like(self._x)
        self._corrected = np.zeros_like(self._x)
        self.engine.rows_forward(self.x)

    def update(self, *, last: bool) -> None:
        self.engine.columns(adjoint=True)
        self.engine.rows_inverse(self._corrected)
        acceleration = self._correct()
        if last:
            self.x = self._x
        else:
            self._predict(acceleration)
            self.engine.rows_forward(self.x)

    def _correct(self) -> float:
        """Compute Eq. (2); the new estimate replaces the oldest one. Returns a_k of Eq. (3)."""
        new, before = self._earlier, self._before
        sums = np.zeros((self.engine.row_blocks, 4))
        planes = new, self.x, self._corrected, self._x, self._gradient
        self.engine.run(
            lambda start, stop, _: _correct(planes, self.dark, sums, start, stop), self.engine.row_blocks
        )
        self._before, self._x = self._x, new
        self._earlier = before if self._order == 2 else self._before
        alike, length, moved, total = sums.sum(axis=0)
        self.change = relative_change(moved, total)
        return float(np.clip(alike / length, 0, _MOST_ACCELERATION)) if length > 0 else 0.0  # Eq. (3)

    def _predict(self, acceleration: float) -> None:
        """Compute the prediction of Eq. (1)."""
        a = np.float32(acceleration)
        curvature = np.float32(acceleration**2 / 2 if self._order == 2 else 0)
        planes = self.x, self._x, self._before, self._earlier
        self.engine.run(
            lambda start, stop, _: _predict(planes, a, curvature, self.dark, start, stop),
            self.engine.row_blocks,
        )


@compiled(fastmath={"contract", "reassoc"})
def _correct(
    planes: tuple[Single, ...], dark: np.float32, sums: NDArray[np.float64], start: int, stop: int
) -> None:
    """Compute new <- prediction * correction and gradient <- new - prediction, and the sums for Eq. (3) and the change.

    Parameters
    ----------
    planes
        The planes new, prediction, correction, x and gradient.
    """
    new, prediction, correction, x, gradient = planes
    zero = np.float32(0.0)
    for block in range(start, stop):
        n, p, c = new[block].reshape(-1), prediction[block].reshape(-1), correction[block].reshape(-1)
        o, g = x[block].reshape(-1), gradient[block].reshape(-1)
        alike, length, moved, total = np.float64(0.0), np.float64(0.0), np.float64(0.0), np.float64(0.0)
        for i in range(n.size):
            value = p[i] * max(c[i], zero)
            value = zero if value < dark else value
            step, change = value - p[i], value - o[i]
            alike += step * g[i]
            length += g[i] * g[i]
            moved += change * change
            total += value * value
            n[i], g[i] = value, step
        sums[block, 0], sums[block, 1], sums[block, 2], sums[block, 3] = alike, length, moved, total


@compiled(fastmath={"contract"})
def _predict(
    planes: tuple[Single, ...],
    a: np.float32,
    curvature: np.float32,
    dark: np.float32,
    start: int,
    stop: int,
) -> None:
    """Compute the prediction of Eq. (1). Where x is above 0, the prediction is kept above 0.

    Parameters
    ----------
    planes
        The planes of the prediction, of x, and of x one and two steps before.
    """
    prediction, x, before, earlier = planes
    two = np.float32(2.0)
    for block in range(start, stop):
        p, new = prediction[block].reshape(-1), x[block].reshape(-1)
        old, older = before[block].reshape(-1), earlier[block].reshape(-1)
        for i in range(p.size):
            bend = new[i] - two * old[i] + older[i]
            p[i] = max(new[i] + a * (new[i] - old[i]) + curvature * bend, min(new[i], dark))
