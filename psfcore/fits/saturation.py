"""The saturated pixels of an image: the level from which pixels are saturated, and where it comes from.

The level comes from the request, the header, the instrument file, or the pixels. Cards that give a level: SATURATE,
DSATVAL (SECCHI, LASCO, WISPR, PUNCH) and SAT_THR (SUVI), in the unit of the image. AIA has no card with the level, but
in 26 level 1 images of a flare of 2012-07-19, NSATPIX is the number of pixels above 15000 DN (in 25 images exactly, in
one it is larger by 1), so an AIA image with NSATPIX has this level. A pixel of exactly 15000 DN counts as saturated
here too.

NSATPIX and DATASAT count the saturated pixels of the exposure. A cut-out has fewer, but no image has more pixels above
its level. If it has, its values were changed after they were counted (a correction of the degradation, sums of pixels),
and the level does not belong to them: then as many pixels are masked as the header counts, the brightest ones. The same
count decides if a level in DN cannot be converted to the unit of the image and the brightest pixels stand apart from
the others, and whether a level of the header of a rate is a rate or in DN of the exposure.

Saturation can also be found without a known level: in a saturated image many pixels have exactly the largest value,
because the converter or the software that wrote the image cannot write a larger one. In an image that is not saturated,
the number of pixels per value decreases towards the largest value. Let n be the number of pixels with the largest
value, and m the mean number of pixels per occurring value among the brightest pixels below it. Without saturation, n
should not exceed m:

    P(n) = probability of at least n events of a Poisson distribution with mean m        Eq. (1)

If P is below MASKED_BELOW, the pixels with the largest value are masked as saturated, except if other pixels reach the
higher level that a card gives. If P is only below DOUBTED_BELOW, they may be saturated, and the image gets a warning.
The test does not depend on the unit, because values that are equal stay equal after a division by the exposure time. If
a flat field or an interpolation made the values of saturated pixels different from each other, the test cannot find
these pixels.

| symbol | name | unit |
|---|---|---|
| n | pixels with the largest value | - |
| m | mean number of pixels per value among the COMPARED brightest pixels below it | - |
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from psfcore.fits.cards import optional_number, optional_text
from psfcore.fits.units import parse_unit, per_dn
from psfcore.image import Image, MaskBit, Saturation

Pixels = NDArray[np.float64]
COMPARED = 100
MASKED_BELOW = 1e-6
DOUBTED_BELOW = 1e-3
AIA_LEVEL_DN = 15000.0
LARGEST_COUNTED = 0.01  # share of the pixels; a larger count may be that of a larger image
COUNT_ERROR = 1.1  # an image that was interpolated after the count has about as many saturated pixels
_BLOCK_ROWS = 256
REQUEST, INSTRUMENT, PIXELS = "request", "instrument file", "pixels"
_COUNTS = ("NSATPIX", "DATASAT")
_LEVEL_CARDS = ("SATURATE", "DSATVAL", "SAT_THR")
SETTING = "set the level with saturation_dn (--saturation)"


def with_saturation(
    image: Image, *, requested_dn: float | None = None, instrument_dn: float | None = None
) -> Image:
    """The image with its saturated pixels masked, and with the record of how they were found.

    The level of the request replaces the level of the instrument file. If several levels remain, the lowest one is
    used. If the request gives no level, the count of the header is compared, and the pixels are tested, see Eq. (1).

    Raises DataError "saturation-unit" if the request gives a level and the unit of the image is neither counts nor a
    rate of counts, and "no-exposure".

    Parameters
    ----------
    requested_dn, instrument_dn
        The levels in DN of one exposure that the request and the instrument file give.
    """
    level = _level(image, requested_dn, instrument_dn)
    if level.found != REQUEST:
        level = _counted(image, level)
    mask = image.mask if level.level is None else _masked(image, level.level)
    if requested_dn is None:
        top, count, chance = largest_value(image.pixels, mask == 0)
        confirmed = level.found in (*_LEVEL_CARDS, *_COUNTS) and bool(np.any(mask & MaskBit.SATURATED.value))
        if chance < MASKED_BELOW and not confirmed:
            below = (
                "" if level.level is None else f" below the saturation level {level.level:g} ({level.found})"
            )
            told = (
                f"{count} pixels have the value {top:g}, the largest{below}; they are masked as saturated: if they "
                f"are not, {SETTING}"
                if below or level.warning
                else None
            )
            level, mask = Saturation(top, PIXELS, told), _masked(image, top)
        elif chance < DOUBTED_BELOW and not level.warning:
            level = replace(
                level,
                warning=f"{count} pixels have the largest value, {top:g}; they may be saturated, but are not masked: "
                f"if they are saturated, {SETTING}",
            )
    return replace(
        image, mask=mask, saturation=level if level.level is not None else replace(level, found=None)
    )


def _level(image: Image, requested_dn: float | None, instrument_dn: float | None) -> Saturation:
    """The lowest known level."""
    unit, header = parse_unit(image.unit), image.header
    levels = [
        Saturation(level, key, None)
        for key in _LEVEL_CARDS
        if (level := optional_number(header, key) or 0.0) > 0
    ]
    is_aia = (optional_text(header, "TELESCOP") or "").upper() == "SDO/AIA"
    in_dn = {
        INSTRUMENT: instrument_dn,
        "NSATPIX": AIA_LEVEL_DN if is_aia and optional_number(header, "NSATPIX") is not None else None,
    }
    scale = unit.dn_per_unit(image.exposure_s)
    if requested_dn is not None:
        scale = per_dn(unit, image.exposure_s, "because the saturation level is in DN")
        in_dn = {REQUEST: requested_dn}
    for source, dn in in_dn.items():
        if dn is not None and scale is not None and scale > 0:
            levels.append(Saturation(dn / scale, source, None))
        elif dn is not None and not levels:
            why = f"its unit is {unit.text}" if unit.kind == "other" else "the header gives no exposure time"
            return Saturation(
                None,
                source,
                f"the saturation level of {dn:g} DN cannot be compared with the image, because {why}: {SETTING}",
            )
    found = min(levels, key=lambda one: one.level or 0.0, default=Saturation(None, None, None))
    return (
        _rate_or_counts(image, found, scale) if unit.kind == "rate" and found.found in _LEVEL_CARDS else found
    )


def _rate_or_counts(image: Image, level: Saturation, scale: float | None) -> Saturation:
    """The level of a card of an image in DN/s. It may also be in DN of the exposure, if only then pixels are
    saturated.
    """
    if level.level is None or scale is None or np.any(image.pixels >= level.level):
        return level
    counted, there = _stated(image), np.count_nonzero(image.pixels >= level.level / scale)
    if scale <= 1 or there == 0 or counted == 0:
        return level
    if counted is not None and there <= counted:
        return replace(level, level=level.level / scale)
    return replace(
        level,
        warning=f"no pixel reaches the saturation level {level.found} = {level.level:g}, but {there} pixels do if it "
        f"is in DN of one exposure: if it is, {SETTING}",
    )


def _stated(image: Image) -> int | None:
    """The number of saturated pixels that the header counts."""
    counted = optional_number(image.header, *_COUNTS)
    return None if counted is None or counted < 0 else int(counted)


def _counted(image: Image, level: Saturation) -> Saturation:
    """The level after the comparison with the count of the header."""
    counted = _stated(image)
    if counted is None or level.found is None:
        return level
    card = next(key for key in _COUNTS if optional_number(image.header, key) is not None)
    if level.level is None:
        values = image.pixels[image.finite]
        if not 0 < counted <= LARGEST_COUNTED * values.size:
            return level if counted else replace(level, warning=None)
        next_one, brightest = np.partition(values, (-counted - 1, -counted))[[-counted - 1, -counted]]
        if (
            brightest - next_one <= values.max() - brightest
        ):  # they do not stand apart: the count may be of a larger image
            return level
        return Saturation(
            float(brightest),
            card,
            f"{level.warning}. {card} counts {counted} saturated pixels, so the {counted} brightest are masked",
        )
    above = int(np.count_nonzero((image.pixels > level.level) & image.finite))
    if above > COUNT_ERROR * counted:
        values = image.pixels[image.finite]
        return Saturation(
            float(np.partition(values, -counted)[-counted]) if counted else None,
            card,
            f"{above} pixels are above the saturation level {level.level:g}, but {card} counts {counted} saturated "
            "pixels: the values were changed after they were counted; "
            f"{f'about {counted} of the brightest are' if counted else 'none of them is'} masked: if this is wrong, "
            f"{SETTING}",
        )
    if level.found == "NSATPIX" and counted and not np.any(image.pixels >= level.level):
        return replace(
            level,
            warning=f"NSATPIX counts {counted} saturated pixels, but no pixel is at {AIA_LEVEL_DN:g} DN or above: the "
            f"image was cut or its values were changed; saturated pixels that are left are not masked: {SETTING}",
        )
    return level


def largest_value(pixels: Pixels, valid: NDArray[np.bool_]) -> tuple[float, int, float]:
    """The largest valid value, the number n of pixels that have it, and the probability P(n) of Eq. (1).

    P is 1 if no valid pixel is below the largest value.

    Parameters
    ----------
    pixels
        The pixels [y, x].
    valid
        True for the pixels that are tested.
    """
    top = float(np.max(pixels, initial=-np.inf, where=valid))
    count = int(np.count_nonzero((pixels == top) & valid))
    brightest = _brightest_below(pixels, valid, top)
    if brightest.size == 0:
        return top, count, 1.0
    return top, count, _at_least(count, brightest.size / np.unique(brightest).size)


def _at_least(count: int, mean: float) -> float:
    """P(n) of Eq. (1) for n = count, at least 1."""
    if count == 1:  # most images have one brightest pixel, and need no library here
        return -math.expm1(-mean)
    from scipy.special import pdtrc

    return float(pdtrc(count - 1, mean))


def _brightest_below(pixels: Pixels, valid: NDArray[np.bool_], top: float) -> Pixels:
    """The COMPARED largest valid values below `top`. Rows are read in blocks, so that large images need no copy."""
    brightest, least = np.empty(0), -np.inf
    for first in range(0, pixels.shape[0], _BLOCK_ROWS):
        rows = slice(first, first + _BLOCK_ROWS)
        block = pixels[rows]
        brightest = np.concatenate([brightest, block[valid[rows] & (block < top) & (block >= least)]])
        if brightest.size > COMPARED:
            brightest = np.partition(brightest, brightest.size - COMPARED)[-COMPARED:]
            least = float(brightest.min())  # few pixels of the later blocks are above it
    return brightest


def _masked(image: Image, level: float) -> NDArray[np.uint8]:
    mask = image.mask.copy()
    mask[image.pixels >= level] |= int(MaskBit.SATURATED)  # for NaN the comparison is False
    return mask
