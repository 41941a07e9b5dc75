"""The level from which pixels are saturated: from the request, the header, the instrument file, or the pixels.

Cards that give a level: SATURATE, DSATVAL (SECCHI, LASCO, WISPR, PUNCH) and SAT_THR (SUVI), in the unit of the image. DATASAT
and NSATPIX count saturated pixels. AIA has no card with the level, but in 26 level 1 images of a flare of 2012-07-19, NSATPIX is the number of pixels above
15000 DN (in 25 images exactly, in one it is larger by 1), so an AIA image with NSATPIX has this level. A pixel of exactly
15000 DN counts as saturated here too.

Saturation can also be found without a known level: in a saturated image many pixels have exactly the largest value,
because the converter or the software that wrote the image cannot write a larger one. In an image that is not saturated,
the number of pixels per value decreases towards the largest value. Let n be the number of pixels with the largest
value, and m the mean number of pixels per occurring value among the brightest pixels below it. Without saturation, n
should not exceed m:

    P(n) = probability of at least n events of a Poisson distribution with mean m        Eq. (1)

If P is below MASKED_BELOW, the pixels with the largest value are masked as saturated, except if other pixels reach the
higher level that a card gives.
If P is only below DOUBTED_BELOW, they may be saturated, and the image gets a warning. The test does not depend on the unit, because values
that are equal stay equal after a division by the exposure time. If a flat field or an interpolation made the values of
saturated pixels different from each other, the test cannot find these pixels.

| symbol | name | unit |
|---|---|---|
| n | pixels with the largest value | - |
| m | mean number of pixels per value among the COMPARED brightest pixels below it | - |
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray

from psfcore.fits.cards import optional_number, optional_text
from psfcore.fits.units import parse_unit, per_dn
from psfcore.image import Image, MaskBit, Saturation

COMPARED = 100
MASKED_BELOW = 1e-6
DOUBTED_BELOW = 1e-3
AIA_LEVEL_DN = 15000.0
_BLOCK_ROWS = 256
REQUEST, INSTRUMENT, PIXELS = "request", "instrument file", "pixels"
_LEVEL_CARDS = ("SATURATE", "DSATVAL", "SAT_THR")
_SETTING = "set the level with saturation_dn (--saturation)"


def with_saturation(
    image: Image, *, requested_dn: float | None = None, instrument_dn: float | None = None
) -> Image:
    """The image with its saturated pixels masked, and with the record of how they were found.

    requested_dn, instrument_dn: the levels in DN of one exposure that the request and the instrument file give. The
    level of the request replaces the level of the instrument file. If several levels remain, the lowest one is used. If
    the request gives no level, the pixels are also tested, see Eq. (1). Raises DataError "saturation-unit" if the request
    gives a level and the unit of the image is neither counts nor a rate of counts, and "no-exposure".
    """
    levels = _levels(image, requested_dn, instrument_dn)
    source = min(levels, key=lambda key: levels[key], default=None)
    level = None if source is None else levels[source]
    warning = None
    mask = image.mask if level is None else _masked(image, level)
    if source == "NSATPIX" and mask is not image.mask:
        warning = _missing_from(image, mask)
    if requested_dn is None:
        top, count, chance = largest_value(image.pixels, mask == 0)
        confirmed = source in _LEVEL_CARDS and bool(np.any(mask & MaskBit.SATURATED.value))
        if chance < MASKED_BELOW and not confirmed:
            if source is not None:
                warning = (
                    f"{count} pixels have the value {top:g}, the largest below the saturation level {level:g} "
                    f"({source}); they are masked as saturated: if they are not, {_SETTING}"
                )
            source, level = PIXELS, top
            mask = _masked(image, top)
        elif chance < DOUBTED_BELOW:
            warning = (
                f"{count} pixels have the largest value, {top:g}; they may be saturated, but are not masked: "
                f"if they are saturated, {_SETTING}"
            )
    return replace(image, mask=mask, saturation=Saturation(level, source, warning))


def largest_value(pixels: NDArray[np.float64], valid: NDArray[np.bool_]) -> tuple[float, int, float]:
    """The largest valid value, the number n of pixels that have it, and the probability P(n) of Eq. (1).

    pixels: [y, x]. valid: True for the pixels that are tested. P is 1 if no valid pixel is below the largest value.
    """
    top = float(np.max(pixels, initial=-np.inf, where=valid))
    count = int(np.count_nonzero((pixels == top) & valid))
    brightest = _brightest_below(pixels, valid, top)
    if brightest.size == 0:
        return top, count, 1.0
    mean_per_value = brightest.size / np.unique(brightest).size
    return top, count, _at_least(count, mean_per_value)


def _at_least(count: int, mean: float) -> float:
    """P(n) of Eq. (1) for n = count, at least 1."""
    if count == 1:  # most images have one brightest pixel, and need no library here
        return -math.expm1(-mean)
    from scipy.special import pdtrc

    return float(pdtrc(count - 1, mean))


def _brightest_below(
    pixels: NDArray[np.float64], valid: NDArray[np.bool_], top: float
) -> NDArray[np.float64]:
    """The COMPARED largest valid values below `top`. Rows are read in blocks, so that large images need no copy."""
    brightest, least = np.empty(0), -np.inf
    for first in range(0, pixels.shape[0], _BLOCK_ROWS):
        rows = slice(first, first + _BLOCK_ROWS)
        block = pixels[rows]
        chosen = valid[rows] & (block < top) & (block >= least)
        brightest = np.concatenate([brightest, block[chosen]])
        if brightest.size > COMPARED:
            brightest = np.partition(brightest, brightest.size - COMPARED)[-COMPARED:]
            least = float(brightest.min())  # few pixels of the later blocks are above it
    return brightest


def _levels(image: Image, requested_dn: float | None, instrument_dn: float | None) -> Mapping[str, float]:
    """All known levels in the unit of the image, by their sources."""
    cards = {key: optional_number(image.header, key) for key in _LEVEL_CARDS}
    levels = {key: level for key, level in cards.items() if level is not None and level > 0}
    unit = parse_unit(image.unit)
    if requested_dn is not None:
        scale = per_dn(unit, image.exposure_s, "because the saturation level is in DN")
        return levels | ({REQUEST: requested_dn / scale} if scale > 0 else {})
    scale = unit.dn_per_unit(image.exposure_s) or 0.0
    in_dn = {INSTRUMENT: instrument_dn, "NSATPIX": _aia_level_dn(image.header)}
    if scale > 0:
        levels |= {source: level / scale for source, level in in_dn.items() if level is not None}
    return levels


def _aia_level_dn(header: Header) -> float | None:
    """The saturation level of an AIA image with NSATPIX; None for other images."""
    is_aia = (optional_text(header, "TELESCOP") or "").upper() == "SDO/AIA"
    return AIA_LEVEL_DN if is_aia and optional_number(header, "NSATPIX") is not None else None


def _masked(image: Image, level: float) -> NDArray[np.uint8]:
    mask = image.mask.copy()
    mask[image.pixels >= level] |= int(MaskBit.SATURATED)  # for NaN the comparison is False
    return mask


def _missing_from(image: Image, mask: NDArray[np.uint8]) -> str | None:
    """A warning if NSATPIX is above 0 but the mask contains no saturated pixel; otherwise None."""
    counted = optional_number(image.header, "NSATPIX") or 0
    if counted == 0 or np.any(mask & MaskBit.SATURATED):
        return None
    return (
        f"NSATPIX counts {counted:g} saturated pixels, but no pixel is at {AIA_LEVEL_DN:g} DN or above: the image "
        f"was cut or its values were changed; saturated pixels that are left are not masked: {_SETTING}"
    )
