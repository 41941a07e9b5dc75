"""What a deconvolution gives back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Deconvolved:
    """An estimate of the scene and how it was reached.

    pixels: estimate [y, x] in the image's unit, NaN where the image has no finite value.
    flux_in: sum of the image over its valid pixels, negatives as 0. flux_out: sum of the estimate over the
    same pixels. negative_pixels: how many of them were below 0.
    last_change: rms change of the last step over the rms of the estimate.
    """

    pixels: NDArray[np.float64]
    method: str
    steps_done: int
    stopped_because: str
    flux_in: float
    flux_out: float
    negative_pixels: int
    last_change: float
