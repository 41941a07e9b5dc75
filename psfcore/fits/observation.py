"""One observation from a file, or from pixels and a header in memory: the only place where heliopsf understands an image.

A deconvolution, a transit, a flare, a measurement of arms and the comparison of a product all read through this module, so a
file has one mask, one unit and one saturation level everywhere.

A telescope or its pipeline fills a lost block of telemetry with a number that no exposure gives: the value of the card BLANK
(which FITS knows for integers only), -32768, -999 and others. Pixels with the value of BLANK are lost. Another such value is
lost if it is far below all other pixels:

    next - value > FAR (median - next),   next: the smallest other value           Eq. (1)

The darkest pixels of an image of light scatter around a value near 0, so none of them is that far from the others.
"""

from __future__ import annotations

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
from psfcore.fits.saturation import with_saturation
from psfcore.fits.units import check_linear, unit_of
from psfcore.image import Image, MaskBit
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


def read_observation(
    path: str | Path, limits: FitsLimits, *, saturation_dn: float | None = None, hdu: int | None = None
) -> Image:
    """Read an image of a file and mask its unusable pixels.

    saturation_dn: the saturation level in DN of one exposure; None: the level is taken from the header or the
    instrument file, and the pixels are tested, see `psfcore.fits.saturation`. hdu: number of the HDU; None: the first
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
