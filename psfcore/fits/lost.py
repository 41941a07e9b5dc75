"""Pixels that were lost on the way to the ground, and files that are no exposure of the Sun.

A telescope or its pipeline fills a lost block of telemetry with a number that no exposure gives: the value of the card BLANK
(which FITS knows for integers only), -32768, -999 and others. Pixels with the value of BLANK are lost. Another such value is lost if it is far below all other
pixels:

    next - value > FAR (median - next),   next: the smallest other value           Eq. (1)

The darkest pixels of an image of light scatter around a value near 0, so none of them is that far from the others.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.cards import Cards, optional_number, optional_text

FAR = 3.0
_FILLED_WITH = (-32768.0, -32767.0, -2147483648.0, -2147483647.0, -9999.0, -999.0, -99999.0, -1e30, -1e31)
_COUNTS = ("NMISSING", "MISSVALS")
# Cards that name the kind of a frame, and the words of frames without the light of the Sun.
_KIND_CARDS = ("IMG_TYPE", "IMGTYPE", "IMAGETYP", "EC_IMTYP", "FRAMETYP", "OBS_TYPE")
# Cards with the value that says that the Earth, the Moon or the pointing hid the Sun (SDO; SWAP).
_HIDDEN = {"ACS_ECLP": "YES", "ACS_SUNP": "NO", "ECLIPSE": "1"}
_NO_SUN = ("dark", "bias", "led", "flat", "calib", "offset", "pinhole")


def lost_pixels(pixels: NDArray[np.float64], header: Cards) -> NDArray[np.bool_] | None:
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


def count_of_lost(header: Cards) -> int:
    """The number of lost pixels that the header states; 0 if it states none."""
    return int(max(optional_number(header, key) or 0 for key in _COUNTS))


def check_exposure(header: Cards) -> None:
    """Raise DataError "not-an-exposure" if a card says that the frame does not show the Sun: a dark, an eclipse, ..."""
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
