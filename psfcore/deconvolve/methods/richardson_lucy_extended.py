"""Richardson-Lucy for a scene that extends beyond the field: Bertero & Boccacci 2005, A&A 437, 369.

    x <- (x / a) * H^T( w y / (H x) ),   a = H^T w      Eq. (1), their Eq. (12)

Eq. (1) holds on field and margin. w is 1 on trusted pixels of the field, and 0 on masked pixels and in the margin.
a(i) is the share of the light of pixel i that falls on trusted pixels. Where a is below LEAST_OBSERVED, the data do not
determine the scene, and x is 0. The paper also uses a threshold, to avoid a division by nearly 0. Near edges and masked
pixels, this step converges to the most likely scene; the step in `richardson_lucy` does not. Negative pixels count
as 0.

The first estimate in the margin is the mirror image of the field. If it were a constant, twenty steps would not be
enough.

| symbol | name | unit |
|---|---|---|
| y | observed | image unit |
| x | estimate, on field and margin | image unit |
| w | trusted, 1 or 0 | - |
| a | share_observed | - |
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from psfcore.deconvolve.conditions import Conditions, Deconvolved
from psfcore.deconvolve.edges import Edges
from psfcore.deconvolve.lucy_ratio import DARK_OF_FLOOR, Ratio, light_above_floor
from psfcore.deconvolve.problem import Problem, pose
from psfcore.deconvolve.stopping import Iteration, Stop
from psfcore.image import Image
from psfcore.psf import Psf

METHOD = "richardson-lucy-extended"
EDGES: Edges = "extended"
MARGIN_SHARE = 0.005
LEAST_OBSERVED = 1e-3
# A masked pixel has the ratio 0 in Eq. (1), because a already accounts for the pixel. The code needs a number above 0.
_NO_RATIO = 1e-30


def deconvolve(
    image: Image, psf: Psf, conditions: Conditions, *, steps: int = 20, stop: Stop = "fixed"
) -> Deconvolved:
    """Estimate the scene from `image` [y, x], which was observed with `psf`, in the field and in a margin around it.

    The result covers only the field. It is not negative. It is NaN where the image is not finite.
    Raises the errors of `problem.pose`, and DataError "no-signal".
    """
    problem = pose(image, psf, conditions, edges=EDGES, margin_share=MARGIN_SHARE, steps=steps, stop=stop)
    return problem.solve(_Extended(problem), method=METHOD, steps=steps, stop=stop)


class _Extended(Iteration):
    """The iteration of Eq. (1)."""

    change = 0.0

    def __init__(self, problem: Problem) -> None:
        engine = problem.engine
        estimate = light_above_floor(problem)
        share_observed = engine.adjoint(problem.domain.trusted.astype(np.float32))
        known = share_observed > LEAST_OBSERVED
        gain = np.where(known, 1 / np.maximum(share_observed, np.float32(LEAST_OBSERVED)), np.float32(0))
        self._engine = engine
        self._ratio = Ratio(problem, _NO_RATIO, float(estimate.max()))
        self._dark = self._ratio.floor * np.float32(DARK_OF_FLOOR)
        self._gain = engine.to_lanes(gain)
        self.x = engine.to_lanes(np.where(known, estimate, np.float32(0)))
        self._correction = np.zeros_like(self.x)
        engine.rows_forward(self.x)

    def measure(self) -> None:
        self._ratio.measure()

    def update(self, *, last: bool) -> None:
        self._engine.columns(adjoint=True)
        self._engine.rows_inverse(self._correction)
        parts = self._engine.run(
            lambda first, end, _: self._step(slice(first, end), last), self._engine.row_blocks
        )
        moved, total = np.sum(parts, axis=0)
        self.change = float(np.sqrt(moved / total)) if total > 0 else 0.0
        if not last:
            self._engine.rows_forward(self.x)

    def _step(self, blocks: slice, last: bool) -> tuple[float, float]:
        """Compute Eq. (1) on some blocks. Returns the sums of (change)^2 and x^2 in the last step, and 0 before."""
        x, correction = self.x[blocks], self._correction[blocks]
        np.maximum(correction, np.float32(0), out=correction)
        correction *= self._gain[blocks]
        correction *= x  # Eq. (1)
        correction[correction < self._dark] = 0
        sums = _sums(correction - x, correction) if last else (0.0, 0.0)
        x[...] = correction
        return sums


def _sums(change: NDArray[np.float32], x: NDArray[np.float32]) -> tuple[float, float]:
    return float(np.square(change).sum(dtype=np.float64)), float(np.square(x).sum(dtype=np.float64))
