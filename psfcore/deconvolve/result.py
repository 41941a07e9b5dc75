"""What a deconvolution gives back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.deconvolve.edges import Edges


@dataclass(frozen=True)
class Deconvolved:
    """An estimate of the scene and how it was reached.

    pixels: estimate [y, x] in the image's unit, NaN where the image has no finite value.
    flux_in: sum of the image over its valid pixels, negatives as 0 where the method counts them so.
    flux_out: sum of the estimate over the same pixels. negative_pixels: how many of them were below 0.
    last_change: rms change of the last step over the rms of the estimate.
    edges, margin_px: what was taken to lie beyond the field, and how far it was followed.
    edge_band_px: width of the band along the edges in which the result leans on light from beyond the field.
    noise_amplification: rms noise of the estimate over that of the image, for noise without correlation;
    none where the method is not linear. chi2_per_pixel: how well the estimate fits, where the noise is known.
    """

    pixels: NDArray[np.float64]
    method: str
    steps_done: int
    stopped_because: str
    flux_in: float
    flux_out: float
    negative_pixels: int
    last_change: float
    edges: Edges
    margin_px: int
    edge_band_px: int
    noise_amplification: float | None = None
    chi2_per_pixel: float | None = None
