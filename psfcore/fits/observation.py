"""One observation from a file, or from pixels and a header in memory: the only place where heliopsf understands an image.

A deconvolution, a transit, a flare, a measurement of arms and the comparison of a product all read through this module, so a
file has one mask, one unit and one saturation level everywhere.

A telescope or its pipeline fills a lost block of telemetry with a number that no exposure gives: the value of the card BLANK
(which FITS knows for integers only), -32768, -999 and others. Pixels with the value of BLANK are lost. Another such value is
lost if it is far below all other pixels:

    next - value > FAR (median - next),   next: the smallest other value           Eq. (1)

The darkest pixels of an image of light scatter around a value near 0, so none of them is that far from the others.

The level from which pixels are saturated comes from the request, the header, the instrument file, or the pixels. Cards
that give a level: SATURATE, DSATVAL (SECCHI, LASCO, WISPR, PUNCH) and SAT_THR (SUVI), in the unit of the image. DATASAT
and NSATPIX count saturated pixels. AIA has no card with the level, but in 26 level 1 images of a flare of 2012-07-19, NSATPIX is the number of pixels above
15000 DN (in 25 images exactly, in one it is larger by 1), so an AIA image with NSATPIX has this level. A pixel of exactly
15000 DN counts as saturated here too.

Saturation can also be found without a known level: in a saturated image many pixels have exactly the largest value,
because the converter or the software that wrote the image cannot write a larger one. In an image that is not saturated,
the number of pixels per value decreases towards the largest value. Let n be the number of pixels with the largest
value, and m the mean number of pixels per occurring value among the brightest pixels below it. Without saturation, n
should not exceed m:

    P(n) = probability of at least n events of a Poisson distribution with mean m        Eq. (2)

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
from pathlib import Path

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.cards import Cards, optional_number, optional_text
from psfcore.fits.hdus import StoredImage, read_pixels
from psfcore.fits.header import (
    IMAGE,
    check_not_deconvolved,
    content_of,
    known_instrument,
    optional_exposure_s,
)
from psfcore.fits.units import check_linear, parse_unit, per_dn, unit_of
from psfcore.image import Image, MaskBit, Saturation
from psfcore.instruments.model import load_instrument

# Names of images that describe another image: its mask, its errors, the quality of its pixels.
_PLANES = ("MASK", "UNCERT", "UNCERTAINTY", "DQF", "DQ", "ERR", "ERROR", "QUALITY", "VARIANCE")
LARGEST_PIXEL = 1e30  # products are single precision, and methods square the pixels
FAR = 3.0
_FILLED_WITH = (-32768.0, -32767.0, -2147483648.0, -2147483647.0, -9999.0, -999.0, -99999.0, -1e30, -1e31)
# Cards that name the kind of a frame, and the words of frames without the light of the Sun.
_KIND_CARDS = ("IMG_TYPE", "IMGTYPE", "IMAGETYP", "EC_IMTYP", "FRAMETYP", "OBS_TYPE")
# Cards with the value that says that the Earth, the Moon or the pointing hid the Sun (SDO; SWAP).
_HIDDEN = {"ACS_ECLP": "YES", "ACS_SUNP": "NO", "ECLIPSE": "1"}
_NO_SUN = ("dark", "bias", "led", "flat", "calib", "offset", "pinhole")
_FULL_SCALES = tuple(2**bits - 1 for bits in (8, 10, 12, 14, 15, 16))
COMPARED = 100
MASKED_BELOW = 1e-6
DOUBTED_BELOW = 1e-3
AIA_LEVEL_DN = 15000.0
_BLOCK_ROWS = 256
REQUEST, INSTRUMENT, PIXELS = "request", "instrument file", "pixels"
_LEVEL_CARDS = ("SATURATE", "DSATVAL", "SAT_THR")
_SETTING = "set the level with saturation_dn (--saturation)"


def read_observation(
    path: str | Path, limits: FitsLimits, *, saturation_dn: float | None = None, hdu: int | None = None
) -> Image:
    """Read an image of a file and mask its unusable pixels.

    saturation_dn: the saturation level in DN of one exposure; None: the level is taken from the header or the
    instrument file, and the pixels are tested, see Eq. (2). hdu: number of the HDU; None: the first
    2-D image. Raises HeaderError for an unusable header; DataError "unreadable-pixels", and the errors of
    `observation_of`.
    """
    stored = read_pixels(path, limits, hdu=hdu, others=True)
    summary, pixels = stored.summary, stored.pixels
    masks = [
        one.number for one, shape in stored.others if one.name.upper() == "MASK" and shape == summary.shape
    ]
    if summary.content == IMAGE and masks:  # as CCDData writes it
        pixels[read_pixels(path, limits, hdu=masks[-1]).pixels != 0] = np.nan
    image = observation_of(
        pixels, stored.header, saturation_dn=saturation_dn, stored_as_integer=summary.bitpix > 0
    )
    if hdu is not None or summary.content != IMAGE:
        return image
    return image.warned(_unused_images(stored))


def _unused_images(stored: StoredImage) -> dict[str, str]:
    """The warning about images of a file that are not used."""
    others = [
        f"{one.number} ({one.name})" if one.name else str(one.number)
        for one, _ in stored.others
        if one.name.upper() not in _PLANES
    ]
    if not others:
        return {}
    return {
        "several-images": f"the file has {len(others) + 1} images; HDU {stored.summary.hdu} is used. --hdu (hdu in a request) "
        f"takes another one: {', '.join(others[:5])}{', ...' if len(others) > 5 else ''}"
    }


def check_exposure_of_sun(header: Header) -> None:
    """Raise DataError if the header says that a deconvolution of the image makes no sense.

    Codes: "already-deconvolved", "psf-as-image", "not-an-exposure" (a dark, an LED frame, ...), and "bad-unit" for pixels that
    are not proportional to the light.
    """
    check_not_deconvolved(content_of(header))
    for key in (*_KIND_CARDS, *_HIDDEN):
        number = optional_number(header, key)
        kind = optional_text(header, key) if number is None else f"{number:g}"
        if kind is None:
            continue
        words = kind.lower().replace("_", " ").split()
        if kind.upper() == _HIDDEN.get(key) or (key in _KIND_CARDS and any(one in words for one in _NO_SUN)):
            raise DataError(
                "not-an-exposure",
                f"expected an exposure of the Sun; the header says {key} = {kind!r:.40}: use another image, or allow it to be "
                "deconvolved (--again, in a request again = true)",
            )
    check_linear(header)


def _lost_pixels(pixels: NDArray[np.float64], header: Cards) -> NDArray[np.bool_] | None:
    """True for the pixels [y, x] that hold the value of a lost pixel; None if there are none."""
    smallest = float(pixels.min())
    if not np.isfinite(smallest):
        smallest = float(np.min(pixels, where=np.isfinite(pixels), initial=np.inf))
    blank = optional_number(header, "BLANK")
    if blank is not None and smallest == blank < 0:
        return pixels == smallest
    if smallest not in _FILLED_WITH:
        return None
    others = pixels[np.isfinite(pixels) & (pixels != smallest)]
    if others.size == 0:
        return None
    following, middle = float(others.min()), float(np.median(others))
    return pixels == smallest if following - smallest > FAR * (middle - following) else None  # Eq. (1)


def observation_of(
    pixels: NDArray[np.float64],
    header: Header,
    *,
    saturation_dn: float | None = None,
    stored_as_integer: bool = False,
) -> Image:
    """The image of pixels [y, x] and a header, with its unusable pixels masked.

    stored_as_integer: whether the pixels are the numbers of an A/D converter, without a calibration. Raises DataError
    "not-2d", "too-small", "no-exposure", "saturation-unit", "all-nan", "all-saturated", "pixel-too-large", "no-signal".
    """
    lost = _lost_pixels(pixels, header)
    if lost is not None:
        pixels = np.where(lost, np.nan, pixels)
    mask = np.where(np.isfinite(pixels), np.uint8(0), np.uint8(MaskBit.NONFINITE))
    warnings = {}
    if lost is not None:
        mask[lost] |= int(MaskBit.LOST)
        count = int(np.count_nonzero(lost))
        stated = int(max(optional_number(header, key) or 0 for key in ("NMISSING", "MISSVALS")))
        warnings["lost"] = (
            f"{count} pixels were lost on the way to the ground; they are not used, and QUALITY marks them"
            + (f" (the header counts {stated})" if stated not in (0, count) else "")
        )
    image = Image(pixels, mask, header, unit_of(header).text, optional_exposure_s(header), warnings=warnings)
    name = known_instrument(header)
    mode = None if name is None else load_instrument(name).gain_mode(optional_text(header, "GAINCOMB"))
    of_instrument = None if mode is None else mode.saturation_dn
    image = with_saturation(image, requested_dn=saturation_dn, instrument_dn=of_instrument)
    _check_signal(image, stored_as_integer=stored_as_integer)
    return image


def _range_of(pixels: NDArray[np.float64]) -> tuple[float, float]:
    return float(pixels.min()), float(pixels.max())


def _check_signal(image: Image, *, stored_as_integer: bool) -> None:
    valid = image.valid
    if not valid.any():
        finite = image.finite
        if not finite.any():
            raise DataError(
                "all-nan", "expected finite pixels; got only NaN, infinite or BLANK: use another image"
            )
        level = image.pixels[finite].min()
        raise DataError(
            "all-saturated",
            f"expected pixels below saturation; all finite pixels are at {level:g} or above: check the level",
        )
    whole = bool(valid.all())
    smallest, largest = _range_of(image.pixels if whole else image.pixels[image.finite])
    farthest = max(smallest, largest, key=abs)
    if abs(farthest) > LARGEST_PIXEL:
        raise DataError(
            "pixel-too-large",
            f"expected pixels between -{LARGEST_PIXEL:g} and {LARGEST_PIXEL:g}; got one of {farthest:g}: set such pixels to NaN",
        )
    if not whole:  # saturated pixels are finite, but say nothing about the signal
        smallest, largest = _range_of(image.pixels[valid])
    if smallest == largest <= 0 or abs(farthest) < 1 / LARGEST_PIXEL:
        raise DataError("no-signal", f"expected light; the brightest pixel is {largest:g}: use another image")
    if smallest == largest and stored_as_integer and largest in _FULL_SCALES:
        text = f"all pixels are {largest:g}, the largest value of an A/D converter"
        message = f"expected pixels below saturation; {text}: use another image"
        raise DataError("all-saturated", message)


def with_saturation(
    image: Image, *, requested_dn: float | None = None, instrument_dn: float | None = None
) -> Image:
    """The image with its saturated pixels masked, and with the record of how they were found.

    requested_dn, instrument_dn: the levels in DN of one exposure that the request and the instrument file give. The
    level of the request replaces the level of the instrument file. If several levels remain, the lowest one is used. If
    the request gives no level, the pixels are also tested, see Eq. (2). Raises DataError "saturation-unit" if the request
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
    """The largest valid value, the number n of pixels that have it, and the probability P(n) of Eq. (2).

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
    """P(n) of Eq. (2) for n = count, at least 1."""
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
