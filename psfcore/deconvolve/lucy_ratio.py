"""The ratio of observation to model, which all Richardson-Lucy methods use.

    w y / (H x) + (1 - w) a        Eq. (1)

a is the ratio of a masked pixel, so chosen that the pixel agrees with the model. One plane stores both cases: the
light (at least 0) of a trusted pixel, or -a of a masked pixel. A negative pixel is noise about zero and counts as 0,
because these methods have no negative light.

| symbol | name | unit |
|---|---|---|
| y | light of trusted pixels, divided by the domain's scale | - |
| w | trusted, 1 or 0 | - |
| a | agreed | - |
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled
from psfcore.convolution.engine import buffer_from_spectrum, spectrum_from_buffer
from psfcore.convolution.fft_kernels import LANES, forward, inverse
from psfcore.deconvolve.problem import Problem, first_estimate
from psfcore.errors import DataError

# Resolution of float32 relative to the brightest pixel. Smaller values are dominated by the rounding of the
# transform. A floor at this level also avoids denormal numbers, which are slow.
FLOOR_OF_MAXIMUM = 2.0**-23
# An estimate below this fraction of the floor is set to 0.
DARK_OF_FLOOR = 1e-6
# The compiler may reorder a sum within a block, but the order is then fixed and independent of the threads.
_SUMS: Any = {"contract", "reassoc"}

Single = NDArray[np.float32]


def light_above_floor(problem: Problem) -> Single:
    """The first estimate [y, x], raised to the floor. Raises DataError "no-signal" if there is no light."""
    domain = problem.domain
    if not (domain.pixels[domain.trusted] > 0).any():
        raise DataError("no-signal", "expected at least one trusted pixel above zero; got none")
    estimate = first_estimate(problem)
    return np.maximum(estimate, np.float32(FLOOR_OF_MAXIMUM * float(estimate.max())))


class Ratio:
    """Replaces the rows of x in the engine's spectrum by the rows of Eq. (1).

    agreed [y, x]: a of Eq. (1), above 0. brightest: largest value of the first estimate; it sets the model's floor.
    """

    def __init__(self, problem: Problem, agreed: Single | float, brightest: float) -> None:
        domain = problem.domain
        self.engine, self.judgement = problem.engine, problem.judgement
        self.floor = np.float32(FLOOR_OF_MAXIMUM * brightest)
        light_or_agreed = np.where(domain.trusted, np.maximum(domain.pixels, 0), -np.float32(agreed))
        self._light_or_agreed = self.engine.to_lanes(light_or_agreed)

    def measure(self) -> None:
        """Compute H x, its chi2, and the ratio of Eq. (1)."""
        self.engine.columns(adjoint=False)
        self.engine.row_stage(_ratio_rows, self._light_or_agreed, self.floor, *self.judgement.numbers)


@compiled(fastmath=_SUMS)
def _ratio_rows(spectrum, light, floor, judged, first, last, slope, ground, sums, buffer, corner, start, stop, length, radices, lengths, tw, offsets, place):  # type: ignore[no-untyped-def]  # fmt: skip
    """Replace H x by Eq. (1), with H x at least `floor`; sum (y - H x)^2 / variance over judged pixels."""
    nx = light.shape[1]
    zero = np.float32(0.0)
    least = np.float32(1e-30)
    z = buffer.reshape((-1, 2, LANES))
    for block in range(start, stop):
        buffer_from_spectrum(spectrum, buffer, corner, block, length, place)
        inverse(buffer, length, radices, lengths, tw, offsets)
        sum_here = 0.0
        for i in range(nx):
            sum_row = zero
            for side in range(2):
                for w in range(LANES):
                    y = light[block, i, side, w]
                    model = max(z[i, side, w], floor)
                    misfit = y - model
                    part = judged[block, side, w] * misfit * misfit / max(slope * model + ground, least)
                    sum_row += part if y >= zero else zero
                    z[i, side, w] = y / model if y >= zero else -y
            if first <= i < last:
                sum_here += sum_row
        sums[block] = sum_here
        buffer[nx * 2 * LANES : length * 2 * LANES] = zero
        forward(buffer, length, radices, lengths, tw, offsets)
        spectrum_from_buffer(spectrum, buffer, corner, block, length, place)
