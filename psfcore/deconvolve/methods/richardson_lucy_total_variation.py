"""Richardson-Lucy with total variation: Dey et al. 2006, Microscopy Research and Technique 69, 260.

    x <- x / (1 - k div(grad x / |grad x|)) * H^T( w y / (H x) + (1 - w) / s )      Eq. (1), their Eq. (14)

This is the step of `richardson_lucy`, with its masks and edges, and a penalty k (in counts) on differences between
neighbouring pixels. Noise then costs more than it improves the fit, so further steps do not amplify it. In simulated
HRI_EUV images (100 photons in a quiet pixel) the rms error after 20 steps is 157 DN/s instead of 169 at 512 px, and 92
instead of 130 at 1024 px. Plain Richardson-Lucy reaches 166 and 112 with the best number of steps, which is not known
for real images. Structures as faint as the noise are lost too. Use this method for pictures and for finding features,
not for the photometry of small spots: they stay smoothed even without noise, and forward differences shift them by up
to 0.002 px.

|grad x| is the root of the sum of squares of the forward differences and of SOFTENING x, so that differences below a
tenth of the light are smoothed only weakly. This departs from the paper, which has no softening. Without it the step
overshoots where differences are small, and flat light breaks up into a pattern with an amplitude of 4 k.

| symbol | name | unit |
|---|---|---|
| k | smoothing | - |
| x, y, w, s | as in richardson_lucy | |
"""

from __future__ import annotations

import numpy as np

from psfcore.compiled import compiled
from psfcore.deconvolve.conditions import Conditions
from psfcore.deconvolve.edges import Edges
from psfcore.deconvolve.lucy_ratio import DARK_OF_FLOOR, Ratio, light_above_floor
from psfcore.deconvolve.methods.richardson_lucy import agreed
from psfcore.deconvolve.problem import Problem, pose, solution
from psfcore.deconvolve.result import Deconvolved
from psfcore.deconvolve.stopping import Iteration, Stop
from psfcore.errors import DataError
from psfcore.image import Image
from psfcore.psf import Psf

METHOD = "richardson-lucy-total-variation"
EDGES: Edges = "symmetric"
MARGIN_SHARE = 0.05
SOFTENING = 0.1
# In one step, a small difference changes by 8 k / SOFTENING of itself. It converges if this is below 2.
MOST_SMOOTHING = 0.02


def deconvolve(
    image: Image,
    psf: Psf,
    conditions: Conditions,
    *,
    steps: int = 20,
    smoothing: float = 0.01,
    stop: Stop = "fixed",
) -> Deconvolved:
    """Estimate the scene from `image` [y, x], observed with `psf`, starting from the observation.

    smoothing: k of Eq. (1). The result is not negative, and NaN where the image is not finite.
    Raises DataError as `problem.pose` does, "bad-smoothing", "no-signal".
    """
    if not 0 <= smoothing <= MOST_SMOOTHING:
        raise DataError("bad-smoothing", f"expected smoothing of 0 to {MOST_SMOOTHING}; got {smoothing}")
    problem = pose(image, psf, conditions, edges=EDGES, margin_share=MARGIN_SHARE, steps=steps, stop=stop)
    iteration = _TotalVariation(problem, smoothing)
    ended = problem.solve(iteration, steps=steps, stop=stop)
    return solution(
        problem,
        iteration.x,
        ended,
        method=METHOD,
        last_change=iteration.change,
        negatives_count=False,
    )


class _TotalVariation(Iteration):
    """Eq. (1). x is a plane [y, x], because its differences cross the engine's blocks."""

    def __init__(self, problem: Problem, smoothing: float) -> None:
        self.x = light_above_floor(problem)
        self._new = np.empty_like(self.x)
        self._engine = problem.engine
        self._ratio = Ratio(problem, agreed(problem), float(self.x.max()))
        self._dark = self._ratio.floor * np.float32(DARK_OF_FLOOR)
        self._smoothing = np.float32(smoothing)
        self._softening = np.float32(SOFTENING)
        self._lanes = problem.engine.to_lanes(self.x)
        self.change = 0.0
        self._engine.rows_forward(self._lanes)

    def measure(self) -> None:
        self._ratio.measure()

    def update(self, *, last: bool) -> None:
        self._engine.columns(adjoint=True)
        self._engine.rows_inverse(self._lanes)
        correction = self._engine.from_lanes(self._lanes)
        sums = np.zeros((self.x.shape[0], 2))

        def work(start: int, stop: int, _: object) -> None:
            _smooth_rows(
                self.x, correction, self._new, self._smoothing, self._softening, self._dark, sums, start, stop
            )

        self._engine.run(work, self.x.shape[0])
        self.x, self._new = self._new, self.x
        moved, total = sums.sum(axis=0)
        self.change = float(np.sqrt(moved / total)) if total > 0 else 0.0
        if not last:
            self._lanes = self._engine.to_lanes(self.x)
            self._engine.rows_forward(self._lanes)


@compiled()
def _direction(x, row, column, softening):  # type: ignore[no-untyped-def]
    """grad x / |grad x| at a pixel, (along y, along x); differences across the last row and column are 0."""
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
def _smooth_rows(x, correction, new, smoothing, softening, dark, sums, start, stop):  # type: ignore[no-untyped-def]
    """new <- Eq. (1) on rows [start, stop), zero below `dark`; sum (change)^2 and x^2 for each row."""
    zero, one = np.float32(0.0), np.float32(1.0)
    for row in range(start, stop):
        moved, total = 0.0, 0.0
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
