"""The contents of an image's header: size, instrument, wavelength, date, exposure and unit.

Cards that only describe the image may be damaged or missing; their value is then None. Cards that define the structure
of the file must be correct (see `psfcore.fits.blocks`). This module reads no pixels, so the web process can import it.
"""

from __future__ import annotations

import os
import re
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from psfcore.errors import DataError, HeaderError
from psfcore.fits.blocks import FitsLimits, first_image, open_source, skip_data, walk
from psfcore.fits.cards import (
    Cards,
    card_count,
    card_flag,
    card_text,
    lenient_value,
    optional_number,
    optional_text,
    optional_value,
)
from psfcore.fits.frame import plate_scale_arcsec
from psfcore.fits.times import observed_at
from psfcore.instruments.files import match_instrument

if TYPE_CHECKING:
    from astropy.io.fits import Header

# FitsLimits is exported here too: every caller of `read_summary` needs it.
__all__ = [
    "FitsLimits",
    "HeaderSummary",
    "check_all_headers",
    "check_not_deconvolved",
    "content_of",
    "first_image_header",
    "known_instrument",
    "optional_exposure_s",
    "optional_number",
    "optional_text",
    "optional_value",
    "plate_scale_arcsec",
    "read_summary",
    "seen_by",
    "wavelength_angstrom",
]

# WAVEUNIT is the name of a unit, or an exponent: -10 means 1e-10 m.
_ANGSTROM_PER_UNIT = {
    "angstrom": 1.0,
    "a": 1.0,
    "0.1nm": 1.0,
    "-10": 1.0,
    "nm": 10.0,
    "-9": 10.0,
    "um": 1e4,
    "m": 1e10,
}
# The content of a file, see `content_of`.
IMAGE, PRODUCT, PSF, ELSEWHERE = "image", "product", "psf", "deconvolved elsewhere"
_DECONVOLVED = re.compile(
    r"(?<!not )\bdeconvolved\b|_deconvol|richardson.?lucy|psf[ -]correct(ed|ion)", re.IGNORECASE
)
# Names of filters. XRT has two filter wheels and one of the last two cards for each; the others have FILTER.
FILTER_CARDS = ("FILTER", "EC_FW1_", "EC_FW2_")
# The cards that are compared to find out whether a PSF and an image fit together.
ORIGIN_CARDS = ("TELESCOP", "OBSRVTRY", "INSTRUME", "DETECTOR", *FILTER_CARDS)
_FIT_CARDS = (
    *ORIGIN_CARDS, "WAVELNTH", "WAVEUNIT", "GAINCOMB", "PSFNAME", "LVL_NUM", "LEVEL",
    # The cards that `psfcore.fits.frame` reads.
    "CDELT1", "CDELT2", "CUNIT1", "CUNIT2", "CTYPE1", "CTYPE2", "CD1_1", "CD1_2", "CD2_1", "CD2_2", "PC1_1", "PC1_2",
    "PC2_1", "PC2_2", "CROTA", "CROTA1", "CROTA2", "SAT_ROT", "INST_ROT", "P2_ROLL",
)  # fmt: skip


@dataclass(frozen=True)
class HeaderSummary:
    """The first 2-D image of a file: its HDU, its shape (ny, nx) and values of its header.

    A value is None if its card is missing or unusable. content: IMAGE, PRODUCT or PSF, see `content_of`. cards: the usable
    cards that are compared to find out whether a PSF and an image fit together.
    """

    hdu: int
    shape: tuple[int, int]
    bitpix: int
    codec: str | None
    gzipped: bool
    instrument: str | None
    telescop: str | None
    instrume: str | None
    detector: str | None
    wavelnth: float | None
    date_obs: str | None
    exposure_s: float | None
    unit: str | None
    cdelt1: float | None
    cdelt2: float | None
    gain_mode: str | None
    pxbeg: tuple[int, int] | None
    pxend: tuple[int, int] | None
    psf_name: str | None
    psf_version: str | None
    content: str = IMAGE
    cards: dict[str, str | float | bool] = field(default_factory=dict)


def read_summary(
    path: str | os.PathLike[str], limits: FitsLimits, *, hdu: int | None = None
) -> HeaderSummary:
    """Summary of the first 2-D image of a file, or of the image in HDU `hdu`.

    Raises HeaderError if the file has no usable image there.
    """
    return read_contents(path, limits, hdu=hdu)[0]


@dataclass(frozen=True)
class Neighbour:
    """An image after the one that is used. name: its EXTNAME, or empty."""

    hdu: int
    name: str
    shape: tuple[int, int]


def read_contents(
    path: str | os.PathLike[str], limits: FitsLimits, *, hdu: int | None = None, whole: bool = False
) -> tuple[HeaderSummary, list[Neighbour]]:
    """As `read_summary`. whole: also the images that follow in the file. Planes of products are left out."""
    neighbours: list[Neighbour] = []
    with open_source(Path(path), limits) as source:
        hdus = walk(source, limits)
        image = first_image(hdus, limits, hdu)
        skip_data(source, image, limits)
        # What follows an image is not needed to use it, so damage there is no error.
        with suppress(HeaderError):
            for other in hdus if whole else ():
                if other.kind == "image" and lenient_value(other.header, "PLANE") is not True:
                    name = optional_text(other.header, "EXTNAME") or ""
                    neighbours.append(Neighbour(other.number, name, _shape(other.header)))
        return _summary(image.header, image.number, source.gzipped), neighbours


def first_image_header(path: str | os.PathLike[str], limits: FitsLimits) -> Header:
    """Unchanged header of the first 2-D image of a file. Raises HeaderError if the file has no usable image."""
    with open_source(Path(path), limits) as source:
        image = first_image(walk(source, limits), limits)
        skip_data(source, image, limits)
        return image.header


def check_all_headers(path: str | os.PathLike[str], limits: FitsLimits) -> None:
    """Raise HeaderError if any HDU of a file exceeds the limits.

    Call this before reading HDUs other than the first image.
    """
    with open_source(Path(path), limits) as source:
        for _ in walk(source, limits):
            pass


def content_of(header: Header) -> str:
    """The content of a file: PRODUCT or PSF if the cards show that heliopsf wrote such a file; otherwise IMAGE.

    A product has the card PSFID or PRODID. A PSF has the card PSFSUM. ELSEWHERE: HISTORY says that other software
    deconvolved the image (xrt_deconvolve, aia_deconvolve_richardsonlucy, aiapy, regularizepsf).
    """
    if "PSFID" in header or "PRODID" in header:
        return PRODUCT
    if "PSFSUM" in header:
        return PSF
    history = str(lenient_value(header, "HISTORY") or "")
    return ELSEWHERE if _DECONVOLVED.search(history) else IMAGE


def check_not_deconvolved(content: str) -> None:
    """Raise DataError if the content of a file is not IMAGE. content: the result of `content_of`.

    Codes: "already-deconvolved" for a product and for an image that other software deconvolved, "psf-as-image" for a PSF.
    """
    if content == ELSEWHERE:
        raise DataError(
            "already-deconvolved",
            "expected an image that was not deconvolved before; the HISTORY of its header says that other software "
            "deconvolved it: use the original image, or allow a second deconvolution (--again, in a request again = true)",
        )
    if content == PRODUCT:
        raise DataError(
            "already-deconvolved",
            "expected an image that was not deconvolved before; the header (PSFID) says that heliopsf made it by deconvolution: "
            "use the original image, or allow a second deconvolution (--again, in a request again = true)",
        )
    if content == PSF:
        raise DataError(
            "psf-as-image",
            "expected an image; the header (PSFSUM) says that the file is a PSF: name it as the PSF, or allow it to be "
            "deconvolved (--again, in a request again = true)",
        )


def origin_of(header: Cards) -> tuple[str | None, dict[str, str]]:
    """The instrument of a PSF, and the cards that say for which images it is valid. header: the header of the PSF's
    file.

    In a file that `psfcore.fits.psfs.write_psf` wrote (it has the card PSFNAME), INSTRUME is the name of an instrument
    file.
    """
    own = optional_text(header, "PSFNAME") is not None
    texts = {key: optional_text(header, key) for key in ORIGIN_CARDS}
    named = texts["INSTRUME"] if own else known_instrument(header)
    return named, {
        key: text for key, text in texts.items() if text is not None and not (own and key == "INSTRUME")
    }


def wavelength_angstrom(header: Cards) -> float | None:
    """Wavelength of an image in angstrom: WAVELNTH in the unit WAVEUNIT; without WAVELNTH, the text WAVE_LEN of TRACE.

    If WAVEUNIT is missing, the unit is angstrom. Returns None if WAVELNTH is missing or not above 0, or if the unit is
    unknown.
    """
    value = optional_number(header, "WAVELNTH")
    of_trace = optional_text(header, "WAVE_LEN")
    if value is None and of_trace is not None and of_trace.isdecimal():
        value = float(of_trace)
    power = optional_number(header, "WAVEUNIT")
    unit = optional_text(header, "WAVEUNIT") or ("angstrom" if power is None else f"{power:g}")
    factor = _ANGSTROM_PER_UNIT.get(unit.replace(" ", "").lower())
    return None if value is None or value <= 0 or factor is None else value * factor


def known_instrument(header: Cards) -> str | None:
    """Name of the shipped instrument whose table [match] agrees with this header; None if there is none."""
    cards: dict[str, object] = {
        key: optional_text(header, key) for key in ("TELESCOP", "INSTRUME", "DETECTOR", *FILTER_CARDS)
    }
    cards |= {"WAVELNTH": wavelength_angstrom(header), "CDELT1": plate_scale_arcsec(header)}
    return match_instrument(cards)


def optional_exposure_s(header: Cards) -> float | None:
    """Exposure time in s: the value of XPOSURE, or else of EXPTIME. None if neither card holds a number above zero."""
    for key in ("XPOSURE", "EXPTIME"):
        exposure = optional_number(header, key)
        if exposure is not None and exposure > 0:
            return exposure
    return None


def seen_by(header: Cards) -> dict[str, Any]:
    """The values of a header that describe the observation: the fields of `HeaderSummary` from instrument to
    gain_mode."""
    return {
        "instrument": known_instrument(header),
        "telescop": optional_text(header, "TELESCOP"),
        "instrume": optional_text(header, "INSTRUME"),
        "detector": optional_text(header, "DETECTOR"),
        "wavelnth": wavelength_angstrom(header),
        "date_obs": observed_at(header),
        "exposure_s": optional_exposure_s(header),
        "unit": optional_text(header, "BUNIT", "PIXLUNIT"),
        "cdelt1": plate_scale_arcsec(header, 1),
        "cdelt2": plate_scale_arcsec(header, 2),
        "gain_mode": optional_text(header, "GAINCOMB"),
    }


def _pair(header: Header, stem: str) -> tuple[int, int] | None:
    first, second = (lenient_value(header, f"{stem}{axis}") for axis in (1, 2))
    if isinstance(first, int) and isinstance(second, int):
        return int(first), int(second)
    return None


def _shape(header: Header) -> tuple[int, int]:
    z = "Z" if card_flag(header, "ZIMAGE") else ""
    return card_count(header, f"{z}NAXIS2"), card_count(header, f"{z}NAXIS1")


def _summary(header: Header, hdu: int, gzipped: bool) -> HeaderSummary:
    compressed = card_flag(header, "ZIMAGE")
    z = "Z" if compressed else ""
    return HeaderSummary(
        hdu=hdu,
        shape=_shape(header),
        bitpix=card_count(header, f"{z}BITPIX", smallest=-64, largest=64),
        codec=card_text(header, "ZCMPTYPE") if compressed else None,
        gzipped=gzipped,
        **seen_by(header),
        pxbeg=_pair(header, "PXBEG"),
        pxend=_pair(header, "PXEND"),
        psf_name=optional_text(header, "PSFNAME"),
        psf_version=optional_text(header, "PSFVERS"),
        content=content_of(header),
        cards={key: value for key in _FIT_CARDS if (value := optional_value(header, key)) is not None},
    )
