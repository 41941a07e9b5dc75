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

from psfcore.deconvolve.iterations.richardson_lucy import LucyIteration, light_above_floor
from psfcore.deconvolve.problem import Problem, relative_change

LEAST_OBSERVED = 1e-3
# A masked pixel has the ratio 0 in Eq. (1), because a already accounts for the pixel. The code needs a number above 0.
_NO_RATIO = 1e-30


class Extended(LucyIteration):
    """The iteration of Eq. (1)."""

    def __init__(self, problem: Problem) -> None:
        engine = problem.engine
        estimate = light_above_floor(problem)
        share_observed = engine.adjoint(problem.domain.trusted.astype(np.float32))
        observed = share_observed > LEAST_OBSERVED
        gain = np.where(observed, 1 / np.maximum(share_observed, np.float32(LEAST_OBSERVED)), np.float32(0))
        super().__init__(problem, _NO_RATIO, float(estimate.max()))
        self._gain = engine.to_lanes(gain)
        self.x = engine.to_lanes(np.where(observed, estimate, np.float32(0)))
        self._correction = np.zeros_like(self.x)
        engine.rows_forward(self.x)

    def update(self, *, last: bool) -> None:
        self.engine.columns(adjoint=True)
        self.engine.rows_inverse(self._correction)
        parts = self.engine.run(
            lambda first, end, _: self._step(slice(first, end), last), self.engine.row_blocks
        )
        self.change = relative_change(*np.sum(parts, axis=0))
        if not last:
            self.engine.rows_forward(self.x)

    def _step(self, blocks: slice, last: bool) -> list[float]:
        """Compute Eq. (1) on some blocks. Returns the sums of (change)^2 and x^2 in the last step, and 0 before."""
        x, correction = self.x[blocks], self._correction[blocks]
        np.maximum(correction, np.float32(0), out=correction)
        correction *= self._gain[blocks]
        correction *= x  # Eq. (1)
        correction[correction < self.dark] = 0
        squares = [np.square(correction - x), np.square(correction)] if last else []
        x[...] = correction
        return [float(plane.sum(dtype=np.float64)) for plane in squares] or [0.0, 0.0]
