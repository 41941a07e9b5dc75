"""Pixels that hold no measurement: lost blocks, blocks of zeros, counts that wrapped around, and pixels that a plane
declares bad.

**Lost.** A telescope or its pipeline fills a lost block of telemetry with a number that no exposure gives: the value of
the card BLANK (of stored integers), -32768, -999 and others. Pixels with the value of BLANK are lost. Another such
value is lost if it is far below all other pixels:

    next - value > FAR (median - next),   next: the smallest other value           Eq. (1)

The darkest pixels of an image of light scatter around a value near 0, so none of them is that far from the others.

**Wrapped.** A count above 32767 that was written as a signed integer of 16 bits became negative. The image then has
values above half of that range, and its negative values end with a gap for which Eq. (1) holds.

**Zeros.** An interrupted download, or software that replaces NaN, leaves blocks of exact zeros with a sharp edge:
beside them, hardly any pixel is 0, and the darkest pixels are not much darker than the others. Zeros among the counts
of a faint corona are no such block.

**Planes.** Images of a file that describe the image: MASK, DQF, DQ and QUALITY declare pixels that are not 0 as bad,
and UNCERT, ERR and VARIANCE those that are not finite.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from psfcore.fits.cards import Cards, optional_number
from psfcore.image import MaskBit

Pixels = NDArray[np.float64]
Where = NDArray[np.bool_]
FAR = 3.0
_FILLED_WITH = (-32768.0, -32767.0, -2147483648.0, -2147483647.0, -9999.0, -999.0, -99999.0, -1e30, -1e31)
SIGNED_BITS, HALF_RANGE = 16, 2.0**14
BLOCK_PX, BESIDE_PX = 3, 6  # smallest block of zeros, and how far the pixels beside a block reach
ZEROS_BESIDE = 0.01  # largest share of zeros beside a lost block
DARKEST_BESIDE = 0.05  # the darkest pixels beside a lost block, in units of the median there
MOSTLY = 0.5  # share of the row beside rows that were not received
LARGEST_FLAGGED = 0.5  # share of pixels; a plane that declares more as bad does not mean bad pixels
FLAGS, ERRORS = ("MASK", "DQF", "DQ", "QUALITY"), ("UNCERT", "UNCERTAINTY", "ERR", "ERROR", "VARIANCE")


def unusable_pixels(
    pixels: Pixels, header: Cards, bits: int | None, planes: Mapping[str, NDArray[np.generic]]
) -> tuple[NDArray[np.uint8], dict[str, str]]:
    """The mask [y, x] (bits of MaskBit) of pixels without a measurement, and warnings by their codes.

    Parameters
    ----------
    bits
        BITPIX of the stored image; None: unknown.
    planes
        Images of the same shape, by their names (see the module).
    """
    mask = np.where(np.isfinite(pixels), np.uint8(0), np.uint8(MaskBit.NONFINITE))
    warnings = {}
    lost = _lost(pixels, header, bits)
    if lost is not None:
        mask[lost] = int(MaskBit.LOST | MaskBit.NONFINITE)
        count = int(np.count_nonzero(lost))
        stated = int(max(optional_number(header, key) or 0 for key in ("NMISSING", "MISSVALS")))
        warnings["lost"] = (
            f"{count} pixels were lost on the way to the ground; they are not used, and QUALITY marks them"
            + (f" (the header counts {stated})" if stated not in (0, count) else "")
        )
    valid = mask == 0
    for code, where, words in (
        (
            "wrapped",
            _wrapped(pixels, valid, header, bits),
            "are negative because counts above 32767 were written as 16 bits",
        ),
        (
            "zeros",
            _blocks_of_zeros(pixels, valid),
            "of blocks of exactly 0 count as lost, as after an interrupted download",
        ),
    ):
        if where is not None:
            mask[where] |= int(MaskBit.NONFINITE)
            warnings[code] = f"{np.count_nonzero(where)} pixels {words}: they are not used"
    told = []
    for name, plane in planes.items():
        bad = (plane != 0) if name in FLAGS else ~np.isfinite(plane)
        count = int(np.count_nonzero(bad))
        used = count <= LARGEST_FLAGGED * pixels.size or name == "MASK"
        if used:
            mask[bad] |= int(MaskBit.NONFINITE)
        if count and name != "MASK":
            told.append(
                f"the plane {name} of the file declares {count} bad pixels: "
                + (
                    "they are not used"
                    if used
                    else "it is not used, because these are more than half of the image"
                )
            )
    return mask, warnings | ({"quality-plane": "; ".join(told)} if told else {})


def _lost(pixels: Pixels, header: Cards, bits: int | None) -> Where | None:
    """Pixels [y, x] that hold the value of a lost pixel; None if there are none."""
    blank, smallest = (
        optional_number(header, "BLANK"),
        float(np.min(pixels, where=np.isfinite(pixels), initial=np.inf)),
    )
    found = np.zeros(pixels.shape, np.bool_)
    if blank is not None and bits is not None and bits > 0:
        step = optional_number(header, "BSCALE") or 1.0
        level = (optional_number(header, "BZERO") or 0.0) + step * blank
        found = np.isnan(pixels) | (abs(pixels - level) < abs(step) / 2)
    elif blank is not None and bits is None and smallest == blank < 0:
        found = pixels == smallest
    if smallest in _FILLED_WITH:
        others = pixels[np.isfinite(pixels) & (pixels != smallest) & ~found]
        if others.size and others.min() - smallest > FAR * (np.median(others) - others.min()):  # Eq. (1)
            found |= pixels == smallest
    return found if found.any() else None


def _wrapped(pixels: Pixels, valid: Where, header: Cards, bits: int | None) -> Where | None:
    """Pixels [y, x] whose counts wrapped around; None if there are none."""
    negative = valid & (pixels < 0)
    if (
        bits != SIGNED_BITS
        or optional_number(header, "BZERO")
        or not negative.any()
        or pixels.max(where=valid, initial=0) < HALF_RANGE
    ):
        return None
    middle = float(np.median(pixels[valid & ~negative]))
    if pixels.min(where=valid, initial=0) > -FAR * middle:  # no gap can be that wide
        return None
    values = np.unique(np.append(pixels[negative], pixels.min(where=valid & ~negative, initial=np.inf)))
    far = np.flatnonzero(np.diff(values) > FAR * (middle - values[1:]))  # Eq. (1)
    return negative & (pixels <= values[far[-1]]) if far.size else None


def _blocks_of_zeros(pixels: Pixels, valid: Where) -> Where | None:
    """Pixels [y, x] of blocks of zeros that are no measurement; None if there are none."""
    zero = (pixels == 0) & valid
    if np.count_nonzero(zero) < BLOCK_PX**2:
        return None
    cut = _rows_of_zeros(zero)
    if cut is not None:
        return cut
    middles = np.zeros(zero.shape, np.bool_)  # of squares of BLOCK_PX zeros
    columns = zero[:-2] & zero[1:-1] & zero[2:]
    middles[1:-1, 1:-1] = columns[:, :-2] & columns[:, 1:-1] & columns[:, 2:]
    if not middles.any():
        return None
    blocks = _grown(middles, 1)
    box = tuple(
        slice(max(int(at.min()) - BESIDE_PX, 0), int(at.max()) + BESIDE_PX + 1)
        for at in (np.flatnonzero(blocks.any(axis=1 - axis)) for axis in (0, 1))
    )
    beside = pixels[box][_grown(blocks[box], BESIDE_PX) & ~blocks[box] & valid[box]]
    if beside.size < BLOCK_PX * BESIDE_PX or np.count_nonzero(beside == 0) > ZEROS_BESIDE * beside.size:
        return None
    dark, middle = np.percentile(beside, (5, 50))
    return blocks if dark > DARKEST_BESIDE * middle > 0 else None


def _grown(where: Where, reach_px: int) -> Where:
    """Pixels [y, x] that are at most ``reach_px`` rows and columns away from those of ``where``."""
    for axis in (0, 1):
        where, reached = np.swapaxes(where, 0, axis), 0
        while reached < reach_px:
            step = min(reached + 1, reach_px - reached)  # no gap is left between the copies, also at edges
            grown = where.copy()
            grown[step:] |= where[:-step]
            grown[:-step] |= where[step:]
            where, reached = grown, reached + step
        where = np.swapaxes(where, 0, axis)
    return where


def _rows_of_zeros(zero: Where) -> Where | None:
    """The rows of nothing but 0 at the bottom and the top, if the rows beside them are mostly not 0; None if there are
    none.
    """
    some, found = np.flatnonzero(~zero.all(axis=1)), np.zeros(zero.shape, np.bool_)
    if not some.size:
        return None
    first, last = int(some[0]), int(some[-1])
    for count, beside, rows in (
        (first, first, slice(first)),
        (len(zero) - 1 - last, last, slice(last + 1, None)),
    ):
        if count >= BLOCK_PX and np.count_nonzero(zero[beside]) < MOSTLY * zero.shape[1]:
            found[rows] = True
    return found if found.any() else None
