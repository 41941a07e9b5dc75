"""The quality plane: one bit for each reason to use a pixel of a deconvolved image with care."""

from __future__ import annotations

from enum import IntFlag

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from psfcore.image import Image, MaskBit

NEAR_MASKED_PX = 3.0

Plane = NDArray[np.float64]


class QualityBit(IntFlag):
    """Bits of the quality plane. The first two are the bits of the mask plane."""

    NONFINITE = 1  # the input has no finite value, so the result has no finite value
    SATURATED = 2  # the input is saturated; the result is an estimate from the surrounding pixels
    NEAR_MASKED = 4  # the pixel is within 3 px of a nonfinite or saturated pixel
    EDGE = 8  # the pixel is in the band at the edges where the result depends on light from beyond the field
    NEGATIVE = 16  # the result is below zero
    ARTEFACT = 32  # the pixel shows a sign of an artefact
    NO_ERROR = 64  # there is no estimate of the noise


def quality_plane(
    image: Image,
    result: Plane,
    *,
    edge_px: int,
    suspected: NDArray[np.bool_] | None = None,
    error: Plane | None = None,
) -> NDArray[np.uint8]:
    """Make the quality plane, bits of QualityBit [y, x], for `result`, the deconvolution of `image`.

    edge_px: width of the band at the edges (`Deconvolved.edge_band_px`). suspected: pixels with a sign of an
    artefact. error: noise plane; if it is None, every pixel has NO_ERROR.
    """
    plane = np.zeros(result.shape, dtype=np.uint8)
    for mask_bit, bit in (
        (MaskBit.NONFINITE, QualityBit.NONFINITE),
        (MaskBit.SATURATED, QualityBit.SATURATED),
    ):
        plane[(image.mask & mask_bit) != 0] |= np.uint8(bit)
    if not image.valid.all():
        plane[image.valid & (distance_transform_edt(image.valid) <= NEAR_MASKED_PX)] |= np.uint8(
            QualityBit.NEAR_MASKED
        )
    plane[_edge_band(result.shape, edge_px)] |= np.uint8(QualityBit.EDGE)
    plane[result < 0] |= np.uint8(QualityBit.NEGATIVE)  # False for NaN
    if suspected is not None:
        plane[suspected] |= np.uint8(QualityBit.ARTEFACT)
    plane[slice(None) if error is None else ~np.isfinite(error)] |= np.uint8(QualityBit.NO_ERROR)
    return plane


def _edge_band(shape: tuple[int, ...], edge_px: int) -> NDArray[np.bool_]:
    band = np.ones(shape, dtype=bool)
    band[edge_px : shape[0] - edge_px, edge_px : shape[1] - edge_px] = False
    return band
