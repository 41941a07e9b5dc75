"""What Richardson-Lucy methods share: the ratio of observation and model.

    w y / (H x) + (1 - w) a        Eq. (1)

a is the ratio at which a masked pixel counts as agreeing with the model. One plane holds both: the light of
a trusted pixel, at least 0, or minus a. A negative pixel is noise about zero and counts as 0: these methods
know no negative light.

| symbol | name | unit |
|---|---|---|
| y | light, trusted pixels, over the domain's scale | - |
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

# float32's resolution of the brightest pixel: below it the transform's rounding decides, and a floor
# there keeps denormal numbers, which are slow, out of the loop.
FLOOR_OF_MAXIMUM = 2.0**-23
# An estimate below this part of the floor is dark.
DARK_OF_FLOOR = 1e-6
# The order of a sum is the compiler's and fixed; rows are summed block by block, whatever the threads.
_SUMS: Any = {"contract", "reassoc"}

Single = NDArray[np.float32]


def light_above_floor(problem: Problem) -> Single:
    """The first estimate [y, x], above the floor. Raises DataError "no-signal" without light."""
    domain = problem.domain
    if not (domain.pixels[domain.trusted] > 0).any():
        raise DataError("no-signal", "expected a trusted pixel above zero; got none")
    estimate = first_estimate(problem)
    return np.maximum(estimate, np.float32(FLOOR_OF_MAXIMUM * float(estimate.max())))


class Ratio:
    """Brings Eq. (1) into the engine's spectrum, where the spectrum held the rows of x.

    agreed [y, x]: a of Eq. (1), above 0. brightest: of the first estimate; the model's floor follows from it.
    """

    def __init__(self, problem: Problem, agreed: Single | float, brightest: float) -> None:
        domain = problem.domain
        self.engine, self.judgement = problem.engine, problem.judgement
        self.floor = np.float32(FLOOR_OF_MAXIMUM * brightest)
        light_or_agreed = np.where(domain.trusted, np.maximum(domain.pixels, 0), -np.float32(agreed))
        self._light_or_agreed = self.engine.to_lanes(light_or_agreed)

    def measure(self) -> None:
        """H x, how it fits, and the ratio."""
        self.engine.columns(adjoint=False)
        self.engine.row_stage(_ratio_rows, self._light_or_agreed, self.floor, *self.judgement.numbers)


@compiled(fastmath=_SUMS)
def _ratio_rows(spectrum, light, floor, judged, first, last, slope, ground, sums, buffer, corner, start, stop, length, radices, lengths, tw, offsets, place):  # type: ignore[no-untyped-def]  # fmt: skip
    """H x <- Eq. (1), H x not below the floor; sums of (y - H x)^2 / variance over judged pixels."""
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
                    seen = max(z[i, side, w], floor)
                    misfit = y - seen
                    part = judged[block, side, w] * misfit * misfit / max(slope * seen + ground, least)
                    sum_row += part if y >= zero else zero
                    z[i, side, w] = y / seen if y >= zero else -y
            if first <= i < last:
                sum_here += sum_row
        sums[block] = sum_here
        buffer[nx * 2 * LANES : length * 2 * LANES] = zero
        forward(buffer, length, radices, lengths, tw, offsets)
        spectrum_from_buffer(spectrum, buffer, corner, block, length, place)
