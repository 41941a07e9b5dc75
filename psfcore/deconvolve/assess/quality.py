"""The quality of the pixels of a deconvolved image: one bit for each reason to use a pixel with care."""

from __future__ import annotations

from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from psfcore.deconvolve.edges import inside_band
from psfcore.image import Image, MaskBit

Plane = NDArray[np.floating]
NEAR_MASKED_PX = 3


class QualityBit(IntFlag):
    """Bits of the quality plane; a pixel without a bit is good. The bits of `psfcore.image.MaskBit` have the same
    values.

    A negative pixel has no bit: noise makes some dark pixels negative, and a mean over the other pixels only would be
    too large. The value 16 is not used.
    """

    NONFINITE = 1
    SATURATED = 2
    NEAR_MASKED = 4
    EDGE = 8
    ARTEFACT = 32
    NO_ERROR = 64
    LOST = 128


# What the bits mean, for the header of the plane. A comment of a FITS card has room for about 36 characters here.
MEANINGS: dict[IntFlag, str] = {
    QualityBit.NONFINITE: "input not finite, no result",
    QualityBit.SATURATED: "input saturated, result estimated",
    QualityBit.NEAR_MASKED: f"within {NEAR_MASKED_PX:g} px of value 1 or 2",
    QualityBit.EDGE: "depends on light beyond the edges",
    QualityBit.ARTEFACT: "sign of an artefact",
    QualityBit.NO_ERROR: "no value in the plane ERROR",
    QualityBit.LOST: "lost on the way, no result",
}


def quality_plane(
    image: Image,
    result: Plane,
    *,
    edge_px: int,
    suspected: NDArray[np.bool_] | None = None,
    error: Plane | None = None,
) -> NDArray[np.uint8]:
    """Make the quality plane, bits of QualityBit [y, x], for `result`, the deconvolution of `image`.

    Parameters
    ----------
    edge_px
        Width of the band at the edges (`Deconvolved.edge_band_px`).
    suspected
        Pixels with a sign of an artefact.
    error
        Noise plane; None: no noise plane was computed, and no pixel has NO_ERROR.
    """
    plane = np.zeros(result.shape, dtype=np.uint8)
    for mask_bit, bit in (
        (MaskBit.NONFINITE, QualityBit.NONFINITE),
        (MaskBit.SATURATED, QualityBit.SATURATED),
        (MaskBit.LOST, QualityBit.LOST),
    ):
        plane[(image.mask & mask_bit.value) != 0] |= np.uint8(bit)
    if not image.valid.all():
        plane[image.valid & _near(~image.valid, NEAR_MASKED_PX)] |= np.uint8(QualityBit.NEAR_MASKED)
    plane[~inside_band(result.shape, edge_px)] |= np.uint8(QualityBit.EDGE)
    if suspected is not None:
        plane[suspected] |= np.uint8(QualityBit.ARTEFACT)
    if error is not None:
        plane[~np.isfinite(error)] |= np.uint8(QualityBit.NO_ERROR)
    return plane


def _near(marked: NDArray[np.bool_], radius_px: int) -> NDArray[np.bool_]:
    """Pixels [y, x] whose distance from a marked pixel is at most `radius_px`: the marked pixels, shifted by each
    offset.
    """
    ny, nx = marked.shape
    near = np.zeros_like(marked)
    reach = range(-radius_px, radius_px + 1)
    for dy, dx in ((dy, dx) for dy in reach for dx in reach if dy**2 + dx**2 <= radius_px**2):
        near[max(dy, 0) : ny + min(dy, 0), max(dx, 0) : nx + min(dx, 0)] |= marked[
            max(-dy, 0) : ny + min(-dy, 0), max(-dx, 0) : nx + min(-dx, 0)
        ]
    return near
