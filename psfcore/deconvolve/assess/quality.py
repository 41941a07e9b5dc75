"""Why a pixel of a deconvolved image is to be used with care: one bit a reason."""

from __future__ import annotations

from enum import IntFlag

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from psfcore.image import Image, MaskBit

NEAR_MASKED_PX = 3.0

Plane = NDArray[np.float64]


class QualityBit(IntFlag):
    """Bits of the quality plane; the first two are those of the mask."""

    NONFINITE = 1  # the input had no value: neither has the result
    SATURATED = 2  # the input was saturated: the result is an estimate from the pixels around
    NEAR_MASKED = 4  # within 3 px of such a pixel
    EDGE = 8  # in the band where the result leans on light from beyond the field
    NEGATIVE = 16  # the result is below zero
    ARTEFACT = 32  # a sign of an artefact of the deconvolution
    NO_ERROR = 64  # no estimate of the noise


def quality_plane(
    image: Image,
    result: Plane,
    *,
    edge_px: int,
    suspected: NDArray[np.bool_] | None = None,
    error: Plane | None = None,
) -> NDArray[np.uint8]:
    """Bits of QualityBit [y, x] of `result`, the deconvolution of `image`.

    edge_px: width of the band at the edges, as `Deconvolved.edge_band_px` has it. suspected: pixels with a sign of an
    artefact. error: the noise plane, where there is one; without it every pixel has NO_ERROR.
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
