"""The unit of an image's pixels, as pictures show it."""

from __future__ import annotations

import re

from psfcore.fits.cards import optional_text
from psfcore.image import Image

_UNKNOWN = "unit unknown"
_LONGEST = 30
# Units of counts. The number of counts depends on the exposure time.
_COUNTS = re.compile(r"(dn|adu|ct|counts?|electrons?|photons?|ph)(/?pix(el)?)?", re.IGNORECASE)


def unit_label(image: Image) -> str:
    """The unit of the pixels, such as "DN/s" or "DN in 2 s"; for counts with the exposure time.

    The unit is the card BUNIT, or else the card PIXLUNIT, which AIA uses. Without these cards it is "unit unknown".
    """
    unit = _unit(image)
    if not _COUNTS.fullmatch(unit):
        return unit
    return f"{unit}, exposure unknown" if image.exposure_s is None else f"{unit} in {image.exposure_s:.4g} s"


def rate_label(image: Image) -> str:
    """The unit after counts were divided by the exposure time, such as "DN/s"."""
    unit = _unit(image)
    if unit == _UNKNOWN:
        return f"{_UNKNOWN}, per s"
    return f"{unit}/s" if _COUNTS.fullmatch(unit) else unit


def _unit(image: Image) -> str:
    """The unit without spaces at its ends; the letter $ would start a formula in a label, so it is removed."""
    found = image.unit or optional_text(image.header, "PIXLUNIT") or ""
    return found.replace("$", "").strip()[:_LONGEST] or _UNKNOWN
