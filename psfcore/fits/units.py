"""The unit of an image's pixels: counts of an exposure, a rate of counts, or another quantity.

Counts are DN, ADU or counts; all three mean numbers of the A/D converter. A rate is counts per time. Both may be per
pixel. All spellings that `astropy.units` reads are accepted, and also spellings that observatories use and
`astropy.units` does not read, such as "dn/sec" and "counts / pixel". Saturation levels and noise figures are in DN of
one exposure, so `dn_per_unit` converts them. `unit_label` and `rate_label` are the units that pictures show.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Literal

from psfcore.errors import DataError
from psfcore.fits.cards import LONGEST_TEXT, Cards, history_of, optional_text
from psfcore.image import Image

if TYPE_CHECKING:
    from astropy.units import UnitBase

Kind = Literal["count", "rate", "other", "unknown"]
_MANY_DIGITS = re.compile(r"\d{4}")
# Words of units in headers, in lower case, and the units of astropy that they mean.
_WORDS = {
    **dict.fromkeys(("dn", "adu", "ct", "cts", "count", "counts"), "ct"),
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("pix", "px", "pixel", "pixels"), "pix"),
    "per": "/",
}
_NO_UNIT = ("none", "unitless", "dimensionless", "n/a")
# Marks of units that are not proportional to the light. Pixels in such units cannot be deconvolved.
_NOT_LINEAR = ("log", "sqrt", "mag", "dex", "db", "**0.5", "^0.5", "**(1/2)")
_UNKNOWN = "unit unknown"
_LONGEST = 30
# Units of counts. The number of counts depends on the exposure time.
_COUNTS = re.compile(r"(dn|adu|ct|counts?|electrons?|photons?|ph)(/?pix(el)?)?", re.IGNORECASE)


@dataclass(frozen=True)
class PixelUnit:
    """The unit of an image.

    Attributes
    ----------
    text
        The unit as the header writes it; None: the header gives no unit.
    scale
        Counts, or counts per second, in one unit; 1 for other units.
    """

    text: str | None
    kind: Kind
    scale: float = 1.0

    def dn_per_unit(self, exposure_s: float | None) -> float | None:
        """DN of one exposure in one unit of the image; None if this is not known. Pixels without a unit count as DN."""
        if self.kind == "rate":
            return None if exposure_s is None else self.scale * exposure_s
        return None if self.kind == "other" else self.scale


def unit_of(header: Cards) -> PixelUnit:
    """The unit that a header gives: BUNIT, else PIXLUNIT (AIA); images of XRT are in DN, or in DN/s if HISTORY says
    so.
    """
    return parse_unit(optional_text(header, "BUNIT", "PIXLUNIT") or _unit_of_xrt(header))


@cache
def parse_unit(text: str | None) -> PixelUnit:
    """The unit that a text names."""
    if text is None or text.strip().lower() in ("", *_NO_UNIT):
        return PixelUnit(None, "unknown")
    from astropy import units

    unit = _parsed(text[:LONGEST_TEXT])
    if unit is None:
        return PixelUnit(text, "other")
    unit *= units.pix ** -dict(zip(unit.bases, unit.powers, strict=True)).get(units.pix, 0)
    if unit.is_equivalent(units.ct):
        return PixelUnit(text, "count", float(unit.to(units.ct)))
    if unit.is_equivalent(units.ct / units.s):
        return PixelUnit(text, "rate", float(unit.to(units.ct / units.s)))
    return PixelUnit(text, "other")


def check_linear(header: Cards) -> None:
    """Raise DataError "bad-unit" if the unit says that pixels are a logarithm, a root or a magnitude of the light."""
    text = unit_of(header).text or ""
    if any(mark in text.lower().replace(" ", "") for mark in _NOT_LINEAR):
        raise DataError(
            "bad-unit",
            f"expected pixels that are proportional to the light, such as DN or DN/s; got the unit {text:.40}: "
            "convert the pixels first",
        )


def per_dn(unit: PixelUnit, exposure_s: float | None, purpose: str) -> float:
    """DN of one exposure in one unit of the image.

    Raises DataError "no-exposure" if the image is a rate without an exposure time, and "saturation-unit" if its unit is
    neither counts nor a rate.

    Parameters
    ----------
    purpose
        The purpose of the number, for the message.
    """
    scale = unit.dn_per_unit(exposure_s)
    if scale is not None:
        return scale
    if unit.kind == "rate":
        raise DataError(
            "no-exposure",
            f"expected XPOSURE or EXPTIME in the header, {purpose} of an image in {unit.text}; got neither: add one "
            "of them",
        )
    raise DataError(
        "saturation-unit",
        f"expected an image in DN or DN/s, {purpose}; got an image in {unit.text!s:.30}: use the image in DN",
    )


def dn_per_unit(image: Image) -> float:
    """DN in one exposure per unit of the image: the exposure time (s) if the unit is DN/s, otherwise 1.

    Raises DataError "no-exposure".
    """
    unit = parse_unit(image.unit)
    return 1.0 if unit.kind == "other" else per_dn(unit, image.exposure_s, "to compute the noise")


def _parsed(text: str) -> UnitBase | None:
    """The unit of astropy with all counts as `ct`; None if the text is no unit that astropy reads."""
    from astropy import units

    if _MANY_DIGITS.search(text):  # a large power would take long to compute
        return None
    text = re.sub(r"data numbers?", "DN", text, flags=re.IGNORECASE)
    plain = re.sub(r"[A-Za-z]+", lambda word: _WORDS.get(word[0].lower(), word[0]), text)
    first, *others = re.sub(r"[{}]", "", plain).split("/")
    if len(others) > 1 and "(" not in plain:  # astropy warns about "DN/s/pixel"
        plain = f"{first}/({' '.join(others)})"
    try:
        return units.Unit(plain, parse_strict="raise")
    except (ValueError, TypeError):
        return None


def _unit_of_xrt(header: Cards) -> str | None:
    if (optional_text(header, "INSTRUME") or "").upper() != "XRT":
        return None
    return "DN/s" if "XRT_RENORMALIZE" in history_of(header).upper() else "DN"


def unit_label(image: Image) -> str:
    """The unit of the pixels, such as "DN/s" or "DN in 2 s"; for counts with the exposure time.

    The unit is the card BUNIT, or else the card PIXLUNIT, which AIA uses. Without these cards it is "unit unknown".
    """
    unit = _unit(image)
    exposure = ", exposure unknown" if image.exposure_s is None else f" in {image.exposure_s:.4g} s"
    return f"{unit}{exposure}" if _COUNTS.fullmatch(unit) else unit


def rate_label(image: Image) -> str:
    """The unit after counts were divided by the exposure time, such as "DN/s"."""
    unit = _unit(image)
    if unit == _UNKNOWN:
        return f"{_UNKNOWN}, per s"
    return f"{unit}/s" if _COUNTS.fullmatch(unit) else unit


def _unit(image: Image) -> str:
    """The unit without spaces at its ends; the letter $ would start a formula in a label, so it is removed."""
    text = (image.unit or optional_text(image.header, "PIXLUNIT") or "").replace("$", "")
    return text.strip()[:_LONGEST] or _UNKNOWN
