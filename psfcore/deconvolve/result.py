"""The result of a deconvolution."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.deconvolve.box import Box
from psfcore.deconvolve.edges import Edges
from psfcore.image import Image


@dataclass(frozen=True)
class OfBox:
    """How a box of an image was deconvolved alone (`psfcore.deconvolve.region`).

    box: the box in the pixels of the whole image. rim_px: largest width of the rim around it. error: bound of the
    difference from the deconvolution of the whole image, in the unit of the image; 0: there is no difference.
    """

    box: Box
    rim_px: int
    error: float


@dataclass(frozen=True)
class Deconvolved:
    """An estimate of the scene, and how the method reached it.

    pixels: estimate [y, x] in the image's unit; NaN where the image has no finite value.
    stopped_because: reason why the iteration ended.
    flux_in: sum of the image over its valid pixels. Negative pixels are included.
    flux_out: sum of the estimate over the same pixels. negative_pixels: number of valid pixels below 0 in the image.
    last_change: rms of the change in the last step, divided by the rms of the estimate.
    edges, margin_px: assumption about the scene beyond the field, and width of the margin.
    edge_band_px: width of the band along the edges in which the result depends on light from beyond the field.
    noise_amplification: rms noise of the estimate divided by the rms noise of the image, for uncorrelated noise; None if
    the method is not linear. chi2_per_pixel: chi2 of the fit divided by the number of judged pixels
    (`psfcore.deconvolve.stopping`); None if the noise is not known. of_box: how the box was deconvolved, if the result is a
    box of an image; None for a whole image.
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
    of_box: OfBox | None = None

    @property
    def flux_change_pct(self) -> float:
        """Change of the flux, percent of the absolute value of the flux before; 0 if that is 0."""
        return 100 * (self.flux_out - self.flux_in) / abs(self.flux_in) if self.flux_in else 0.0


def fluxes(image: Image, pixels: NDArray[np.float64]) -> tuple[float, float, int]:
    """`flux_in`, `flux_out` and `negative_pixels` of a `Deconvolved` with these pixels."""
    # The sums use no copies of planes: here most of the memory of a deconvolution is in use.
    counted = image.valid
    negative = image.pixels < 0
    negative &= counted
    return (
        float(image.pixels.sum(where=counted)),
        float(pixels.sum(where=counted)),
        int(np.count_nonzero(negative)),
    )
