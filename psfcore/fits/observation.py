"""One observation, whatever it came in: the only place where heliopsf understands an image.

A deconvolution, a transit, a flare, a measurement of arms and the comparison of a product all read through this module,
so an image has one mask, one unit and one saturation level everywhere: from a file (`read_observation`), from HDUs of
astropy (`observation_of_hdus`), or from pixels and a header in memory (`observation_of`). `unusable` and `saturation`
have the rules.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from astropy.io.fits import Header, ImageHDU
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.cards import lenient_value, optional_number, optional_text
from psfcore.fits.hdus import StoredImage, read_pixels
from psfcore.fits.header import (
    IMAGE,
    check_not_deconvolved,
    content_of,
    known_instrument,
    optional_exposure_s,
)
from psfcore.fits.saturation import SETTING, with_saturation
from psfcore.fits.units import check_linear, unit_of
from psfcore.fits.unusable import ERRORS, FLAGS, unusable_pixels
from psfcore.image import Image, MaskBit
from psfcore.instruments.model import load_instrument

LARGEST_PIXEL = 1e15  # the comparison sums squares of pixels in single precision, which ends at 3e38
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

    Raises HeaderError for an unusable header; DataError "unreadable-pixels", and the errors of `observation_of`.

    Parameters
    ----------
    saturation_dn
        The saturation level in DN of one exposure; None: `saturation` finds it.
    hdu
        Number of the HDU; None: the first 2-D image.
    """
    stored = read_pixels(path, limits, hdu=hdu, others=True)
    return _with_planes(
        stored, lambda number: read_pixels(path, limits, hdu=number).pixels, hdu, saturation_dn
    )


def observation_of_hdus(
    hdus: Mapping[int, ImageHDU],
    number: int,
    *,
    chosen: int | None = None,
    saturation_dn: float | None = None,
) -> Image:
    """The image of one HDU of astropy, with the planes in the HDUs after it.

    Raises the errors of `observation_of`.

    Parameters
    ----------
    hdus
        The HDUs with an image of two axes, by their numbers.
    chosen
        Number of the HDU, the same as `number`, if the caller named it; None: the caller named none.
    """
    hdu = hdus[number]
    # Before its pixels are read: astropy then removes the cards that tell lost pixels.
    header = hdu.header.copy()
    damaged = "data" not in vars(hdu) and hdu.verify_datasum() == 0
    pixels = np.asarray(hdu.data)
    others = [
        (n, str(one.name), one.shape)
        for n, one in hdus.items()
        if n > number and lenient_value(one.header, "PLANE") is not True
    ]
    stored = StoredImage(
        number, stored_bits(pixels, header), real_pixels(pixels), header, others, damaged=damaged
    )
    return _with_planes(stored, lambda number: np.asarray(hdus[number].data), chosen, saturation_dn)


def _with_planes(
    stored: StoredImage,
    read: Callable[[int], NDArray[np.generic]],
    chosen: int | None,
    saturation_dn: float | None,
) -> Image:
    """The image with its planes among the other images of the file. Warnings name the others, and damage.

    Parameters
    ----------
    read
        Function of the number of an HDU that gives the pixels of this HDU.
    chosen
        The number of the HDU, if the caller named it; None: the caller named none.
    """
    planes: dict[str, NDArray[np.generic]] = {}
    others: list[str] = []
    is_image = content_of(stored.header) == IMAGE
    for number, name, shape in stored.others:
        if name.upper() not in (*FLAGS, *ERRORS):
            others.append(f"{number} ({name})" if name else str(number))
        elif is_image and shape == stored.pixels.shape and name.upper() not in planes:
            planes[name.upper()] = read(number)  # further ones belong to further images
    image = observation_of(
        stored.pixels, stored.header, bits=stored.bits, planes=planes, saturation_dn=saturation_dn
    )
    warnings = {}
    if others and chosen is None and is_image:
        warnings["several-images"] = (
            f"the file has {len(others) + 1} images; HDU {stored.number} is used. --hdu (hdu in a request) "
            f"takes another one: {', '.join(others[:5])}{', ...' if len(others) > 5 else ''}"
        )
    if stored.damaged:
        warnings["damaged"] = (
            f"DATASUM of HDU {stored.number} does not agree with its pixels: the file was damaged or changed after "
            "it was written; copy it again"
        )
    return image.warned(warnings) if warnings else image


def stored_bits(data: NDArray[np.generic], header: Header) -> int | None:
    """BITPIX of an image in memory as it was stored: of its header, or of its whole numbers; None: not known."""
    stated = optional_number(header, "BITPIX")
    of_data = 8 * data.dtype.itemsize if data.dtype.kind in "iu" else None
    return of_data if stated is None else int(stated)


def real_pixels(data: NDArray[np.generic]) -> NDArray[np.float64]:
    """Pixels [y, x] as real numbers. Raises DataError "bad-input" for another type, and "not-2d"."""
    if data.dtype.kind not in "iufb":
        raise DataError("bad-input", f"expected pixels that are real numbers; got the type {data.dtype}")
    if data.ndim != 2:
        raise DataError("not-2d", f"expected an image with two axes; got {data.ndim}")
    return np.asarray(data, dtype=np.float64)


def check_exposure_of_sun(header: Header) -> None:
    """Raise DataError if the header says that a deconvolution of the image makes no sense.

    Codes: "already-deconvolved", "psf-as-image", "not-an-exposure" (a dark, an LED frame, ...), and "bad-unit" for
    pixels that are not proportional to the light.
    """
    check_not_deconvolved(content_of(header))
    for key in (*_KIND_CARDS, *_HIDDEN):
        number = optional_number(header, key)
        kind = (optional_text(header, key) or "") if number is None else f"{number:g}"
        words = kind.lower().replace("_", " ").split()
        if kind.upper() == _HIDDEN.get(key) or (key in _KIND_CARDS and any(one in words for one in _NO_SUN)):
            raise DataError(
                "not-an-exposure",
                f"expected an exposure of the Sun; the header says {key} = {kind!r:.40}: use another image, or allow "
                "it to be deconvolved (--again, in a request again = true)",
            )
    check_linear(header)


def observation_of(
    pixels: NDArray[np.float64],
    header: Header,
    *,
    bits: int | None = None,
    planes: Mapping[str, NDArray[np.generic]] | None = None,
    saturation_dn: float | None = None,
) -> Image:
    """The image of pixels [y, x] and a header, with its unusable pixels masked.

    Raises DataError "not-2d", "too-small", "no-exposure", "saturation-unit", "all-nan", "all-saturated",
    "pixel-too-large", "no-signal".

    Parameters
    ----------
    bits, planes
        BITPIX of the stored image, and further images by name, see `unusable.unusable_pixels`.
    """
    mask, warnings = unusable_pixels(pixels, header, bits, planes or {})
    if (unused := (mask != 0) & np.isfinite(pixels)).any():
        pixels = np.where(unused, np.nan, pixels)
    image = Image(pixels, mask, header, unit_of(header).text, optional_exposure_s(header), warnings=warnings)
    name = known_instrument(header)
    mode = None if name is None else load_instrument(name).gain_mode(optional_text(header, "GAINCOMB"))
    image = with_saturation(
        image, requested_dn=saturation_dn, instrument_dn=None if mode is None else mode.saturation_dn
    )
    _check_signal(image, stored_as_integer=bits is not None and bits > 0)
    return image


def _range_of(pixels: NDArray[np.float64]) -> tuple[float, float]:
    return float(pixels.min()), float(pixels.max())


def _check_signal(image: Image, *, stored_as_integer: bool) -> None:
    valid = image.valid
    if not valid.any():
        if not image.finite.any():
            raise DataError(
                "all-nan", "expected finite pixels; got only NaN, infinite or BLANK: use another image"
            )
        raise DataError(
            "all-saturated",
            f"expected pixels below saturation; all finite pixels are at {image.pixels[image.finite].min():g} or "
            "above: check the level",
        )
    whole = bool(valid.all())
    smallest, largest = _range_of(image.pixels if whole else image.pixels[image.finite])
    farthest = max(smallest, largest, key=abs)
    if abs(farthest) > LARGEST_PIXEL:
        raise DataError(
            "pixel-too-large",
            f"expected pixels between -{LARGEST_PIXEL:g} and {LARGEST_PIXEL:g}; got one of {farthest:g}: set such "
            "pixels to NaN, or use a larger unit",
        )
    if not whole:  # saturated pixels are finite, but say nothing about the signal
        smallest, largest = _range_of(image.pixels[valid])
    if smallest == largest <= 0 or abs(farthest) < 1 / LARGEST_PIXEL:
        saturated = int(np.count_nonzero(image.mask & MaskBit.SATURATED.value))
        others = f", and {saturated} brighter pixels count as saturated" if saturated else ""
        raise DataError(
            "no-signal",
            f"expected light; the brightest pixel {'below saturation ' if saturated else ''}is {largest:g}{others}: "
            + (f"if they are not saturated, {SETTING}" if saturated else "use another image"),
        )
    if smallest == largest and stored_as_integer and largest in _FULL_SCALES:
        raise DataError(
            "all-saturated",
            f"expected pixels below saturation; all pixels are {largest:g}, the largest value of an A/D converter: "
            "use another image",
        )
