"""Why a pixel of a deconvolved image is to be used with care: one bit a reason.

Near an edge, light came in from scenes that are not in the image. With the sum of the PSF's weights over all
offsets that reach across a straight edge at distance d,

    L(d) = sum over o >= d + 1 of the row (or column) sums of h[o]      Eq. (1)

the band ends where L(d) has fallen to `EDGE_SHARE`. A uniform Sun would put that share into its last pixel.

| symbol | name | unit |
|---|---|---|
| h | psf.kernel | - |
| d | pixels between a pixel and the edge | px |
"""

from __future__ import annotations

from enum import IntFlag

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from psfcore.image import Image, MaskBit
from psfcore.psf import Psf

NEAR_MASKED_PX = 3.0
EDGE_SHARE = 0.10

Plane = NDArray[np.float64]


class QualityBit(IntFlag):
    """Bits of the quality plane; the first two are those of the mask."""

    NONFINITE = 1  # the input had no value: neither has the result
    SATURATED = 2  # the input was saturated: the result is an estimate from the pixels around
    NEAR_MASKED = 4  # within 3 px of such a pixel
    EDGE = 8  # more than a tenth of the light may come from outside the field
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

    edge_px: width of the band at the edges, as `edge_band_px` gives it. suspected: pixels with a sign of an
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


def edge_band_px(psf: Psf, *, share: float = EDGE_SHARE) -> int:
    """Width of the band along every edge in which more than `share` of the light may come from outside, px."""
    return max(
        _reach_across(sums, share)
        for axis in (0, 1)
        for sums in _halves(psf.kernel.sum(axis=1 - axis), psf.kernel.shape[axis] // 2)
    )


def _halves(sums: Plane, centre: int) -> tuple[Plane, Plane]:
    """Sums at offsets 1, 2, ... to either side of the centre."""
    return sums[centre + 1 :], sums[:centre][::-1]


def _reach_across(sums: Plane, share: float) -> int:
    """Number of distances d = 0, 1, ... at which Eq. (1) is above `share`."""
    across = np.cumsum(sums[::-1])[::-1]  # Eq. (1)
    return int(np.count_nonzero(across > share))


def _edge_band(shape: tuple[int, ...], edge_px: int) -> NDArray[np.bool_]:
    band = np.ones(shape, dtype=bool)
    band[edge_px : shape[0] - edge_px, edge_px : shape[1] - edge_px] = False
    return band
