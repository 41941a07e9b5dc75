"""The ratio of observation to model, which all Richardson-Lucy methods use.

    w y / (H x) + (1 - w) a        Eq. (1)

a is the ratio of a masked pixel. Its value is chosen so that the pixel has no influence on the estimate. One plane
stores the light (at least 0) of the trusted pixels, and -a for the masked pixels. Negative pixels are due to noise
around zero. They count as 0, because these methods cannot represent negative light.

| symbol | name | unit |
|---|---|---|
| y | light of trusted pixels, divided by the domain's scale | - |
| w | trusted, 1 or 0 | - |
| a | agreed: ratio at which a masked pixel agrees with the model | - |
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

# Smallest value of a model pixel, as a fraction of the brightest pixel (the "floor"). The floor is the
# resolution of float32;
# smaller values are dominated by the rounding of the transform. The floor also avoids denormal numbers, which are slow.
FLOOR_OF_MAXIMUM = 2.0**-23
# An estimate below this fraction of the floor is set to 0.
DARK_OF_FLOOR = 1e-6
# The compiler may reorder a sum within a block. The new order is fixed, so it does not depend on the threads.
_SUMS: Any = {"contract", "reassoc"}

Single = NDArray[np.float32]


def light_above_floor(problem: Problem) -> Single:
    """The first estimate [y, x], with values below the floor raised to the floor.

    Raises DataError "no-signal" if no trusted pixel is above zero.
    """
    domain = problem.domain
    if not (domain.pixels[domain.trusted] > 0).any():
        raise DataError(
            "no-signal",
            "expected at least one trusted pixel above zero; got none: use another image or the method linear",
        )
    estimate = first_estimate(problem)
    return np.maximum(estimate, np.float32(FLOOR_OF_MAXIMUM * float(estimate.max())), out=estimate)


class Ratio:
    """Replaces the estimate x in the engine's spectrum by the ratio of Eq. (1).

    agreed [y, x]: a of Eq. (1), above 0. brightest: largest value of the first estimate; the floor is a fraction of it.
    """

    def __init__(self, problem: Problem, agreed: Single | float, brightest: float) -> None:
        domain = problem.domain
        self.engine, self.judgement = problem.engine, problem.judgement
        self.floor = np.float32(FLOOR_OF_MAXIMUM * brightest)
        of_masked = np.broadcast_to(np.float32(agreed), domain.shape)

        def light_or_agreed(rows: slice) -> Single:
            return np.where(domain.trusted[rows], np.maximum(domain.pixels[rows], 0), -of_masked[rows])

        self._light_or_agreed = self.engine.lanes_of(light_or_agreed)

    def measure(self) -> None:
        """Compute H x, the chi2 of H x, and the ratio of Eq. (1)."""
        self.engine.columns(adjoint=False)
        self.engine.row_stage(_ratio_rows, self._light_or_agreed, self.floor, *self.judgement.numbers)


@compiled(fastmath=_SUMS, error_model="numpy")
def _ratio_rows(spectrum, light, floor, judged, first, last, slope, ground, sums, buffer, corner, start, stop, length, passes, lengths, tw, offsets, place):  # type: ignore[no-untyped-def]  # fmt: skip
    """Replace H x, raised to `floor` where it is smaller, by Eq. (1). Add up (y - H x)^2 / variance over the judged
    pixels."""
    nx = light.shape[1]
    zero = np.float32(0.0)
    least = np.float32(1e-30)
    z = buffer.reshape((-1, 2, LANES))
    for block in range(start, stop):
        buffer_from_spectrum(spectrum, buffer, corner, block, length, place)
        inverse(buffer, length, passes, lengths, tw, offsets)
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
        forward(buffer, length, passes, lengths, tw, offsets)
        spectrum_from_buffer(spectrum, buffer, corner, block, length, place)
