"""The contents of an image's header: size, instrument, wavelength, date, exposure and unit.

Cards that only describe the image may be damaged or missing; their value is then None. Cards that define the structure
of the file must be correct (see `psfcore.fits.blocks`). This module reads no pixels, so the web process can import it.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from typing_extensions import TypedDict

from psfcore.errors import DataError, HeaderError
from psfcore.fits.blocks import FitsLimits, Hdu, first_image, open_source, skip_data, walk
from psfcore.fits.cards import (
    Cards,
    card_count,
    card_flag,
    card_text,
    card_trouble,
    history_of,
    lenient_value,
    optional_number,
    optional_text,
    optional_value,
)
from psfcore.fits.frame import frame_of, plate_scale_arcsec
from psfcore.instruments.files import match_instrument
from psfcore.instruments.observation import Observation

if TYPE_CHECKING:
    from astropy.io.fits import Card, Header

JsonValue = str | int | float | bool | None
# WAVEUNIT is the name of a unit, or an exponent: -10 means 1e-10 m.
_ANGSTROM_PER_UNIT = {
    **dict.fromkeys(("angstrom", "angstroms", "ang", "aa", "a", "å", "0.1nm", "-10"), 1.0),
    "nm": 10.0,
    "-9": 10.0,
    "um": 1e4,
    "m": 1e10,
}
_DATE_ONLY = re.compile(r"\d{4}-\d\d-\d\d")
_OLD_DATE = re.compile(r"\A(\d\d)/(\d\d)/(\d\d)\Z")  # FITS before 1998: day, month, year - 1900
_LEAP_SECOND = re.compile(r"(.*T\d\d:\d\d):60(\.\d*)?(Z?)")
# The content of a file, see `content_of`.
IMAGE, PRODUCT, PSF, ELSEWHERE = "image", "product", "psf", "deconvolved elsewhere"
FIELD = "FIELD"  # name of the extensions with the terms of a PSF that changes over the field
_DECONVOLVED = re.compile(
    r"(?<!not )\bdeconvolved\b|_deconvol|richardson.?lucy|psf[ -]correct(ed|ion)", re.IGNORECASE
)
_TWICE = "use the original image, or allow a second deconvolution"
_NOT_AGAIN = {
    ELSEWHERE: (
        "already-deconvolved",
        "expected an image that was not deconvolved before; the HISTORY of its header says that other software "
        "deconvolved it: " + _TWICE,
    ),
    PRODUCT: (
        "already-deconvolved",
        "expected an image that was not deconvolved before; the header (PSFID) says that heliopsf made it by "
        "deconvolution: " + _TWICE,
    ),
    PSF: (
        "psf-as-image",
        "expected an image; the header (PSFSUM) says that the file is a PSF: name it as the PSF, or allow it to be "
        "deconvolved",
    ),
}
# Names of filters. XRT has two filter wheels and one of the last two cards for each; the others have FILTER.
FILTER_CARDS = ("FILTER", "EC_FW1_", "EC_FW2_")
# The cards that are compared to find out whether a PSF and an image fit together.
ORIGIN_CARDS = ("TELESCOP", "OBSRVTRY", "INSTRUME", "DETECTOR", *FILTER_CARDS)
_FIT_CARDS = (
    *ORIGIN_CARDS, "PSFDOI", "PSFREF", "WAVELNTH", "WAVEUNIT", "WAVE_LEN", "GAINCOMB", "PSFNAME", "LVL_NUM", "LEVEL",
    # The cards that `psfcore.fits.frame` reads.
    "CDELT1", "CDELT2", "CUNIT1", "CUNIT2", "CTYPE1", "CTYPE2", "CD1_1", "CD1_2", "CD2_1", "CD2_2", "PC1_1", "PC1_2",
    "PC2_1", "PC2_2", "CROTA", "CROTA1", "CROTA2", "SAT_ROT", "INST_ROT", "P2_ROLL", "SC_ROLL",
)  # fmt: skip


class HduJson(TypedDict):
    """The first values of a `HeaderSummary` as JSON: those of the HDU."""

    hdu: int
    shape: Sequence[int]
    bitpix: int
    codec: str | None
    gzipped: bool


class HeaderJson(HduJson, Observation):
    """A `HeaderSummary` as JSON."""

    pxbeg: Sequence[int] | None
    pxend: Sequence[int] | None
    psf_name: str | None
    psf_version: str | None
    content: str
    cards: dict[str, str | float | bool]


@dataclass(frozen=True)
class HeaderSummary:
    """The first 2-D image of a file: its HDU, its shape (ny, nx) and values of its header.

    A value is None if its card is missing or unusable.

    Attributes
    ----------
    content
        The kind of the content: IMAGE, PRODUCT or PSF, see `content_of`.
    cards
        The usable cards that are compared to find out whether a PSF and an image fit together, and those of the
        publication of a PSF.
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
    """The summary of the first 2-D image of a file, or of the image in HDU `hdu`.

    Raises HeaderError if the file has no usable image there.
    """
    return read_first_image(path, limits, hdu=hdu)[0]


def read_first_image(
    path: str | os.PathLike[str], limits: FitsLimits, *, hdu: int | None = None
) -> tuple[HeaderSummary, Hdu]:
    """As `read_summary`, and the HDU of the image."""
    with open_source(Path(path), limits) as source:
        image = first_image(walk(source, limits), limits, hdu)
        skip_data(source, image)
        return summary_of(image, gzipped=source.gzipped), image


def all_hdus(path: str | os.PathLike[str], limits: FitsLimits) -> list[Hdu]:
    """All HDUs of a file. Call this before other code reads more of a file than its first image.

    Raises HeaderError if a header is unusable or exceeds the limits.
    """
    with open_source(Path(path), limits) as source:
        return list(walk(source, limits))


def is_plane(hdu: Hdu) -> bool:
    """Whether an HDU is a plane of a product, see `psfcore.fits.images`."""
    return hdu.kind == "image" and lenient_value(hdu.header, "PLANE") is True


def field_hdus(path: str | os.PathLike[str], limits: FitsLimits) -> list[Hdu]:
    """The HDUs of the terms of a PSF that changes over the field: images named FIELD.

    Damage behind the first image of a file is no error here, because it is none for a PSF without terms.
    """
    found: list[Hdu] = []
    with suppress(HeaderError), open_source(Path(path), limits) as source:
        found.extend(hdu for hdu in walk(source, limits) if hdu.kind == "image" and hdu.name == FIELD)
    return found


def content_of(header: Header) -> str:
    """The content of a file: PRODUCT or PSF if the cards show that heliopsf wrote such a file; otherwise IMAGE.

    A product has the card PSFID or PRODID. A PSF has the card PSFSUM. ELSEWHERE: HISTORY says that other software
    deconvolved the image (xrt_deconvolve, aia_deconvolve_richardsonlucy, aiapy, regularizepsf).
    """
    if "PSFID" in header or "PRODID" in header:
        return PRODUCT
    if "PSFSUM" in header:
        return PSF
    return ELSEWHERE if _DECONVOLVED.search(history_of(header)) else IMAGE


def check_not_deconvolved(content: str) -> None:
    """Raise DataError if the content of a file is not IMAGE.

    Codes: "already-deconvolved" for a product and for an image that other software deconvolved, "psf-as-image" for a
    PSF.

    Parameters
    ----------
    content
        The result of `content_of`.
    """
    if content in _NOT_AGAIN:
        code, message = _NOT_AGAIN[content]
        raise DataError(code, f"{message} (--again, in a request again = true)")


def origin_of(header: Cards) -> tuple[str | None, dict[str, str]]:
    """The instrument of a PSF, and the cards that say for which images it is valid.

    In a file that `psfcore.fits.psfs.write_psf` wrote (it has the card PSFNAME), INSTRUME is the name of an instrument
    file.

    Parameters
    ----------
    header
        The header of the PSF's file.
    """
    own = optional_text(header, "PSFNAME") is not None
    texts = {key: optional_text(header, key) for key in ORIGIN_CARDS}
    return texts["INSTRUME"] if own else known_instrument(header), {
        key: text for key, text in texts.items() if text is not None and not (own and key == "INSTRUME")
    }


def wavelength_angstrom(header: Cards) -> float | None:
    """The wavelength of an image in angstrom: WAVELNTH in the unit WAVEUNIT; without WAVELNTH, the text WAVE_LEN of
    TRACE.

    If WAVEUNIT is missing, the unit is angstrom. Returns None if WAVELNTH is missing or not above 0, or if the unit is
    unknown.
    """
    value = optional_number(header, "WAVELNTH")
    of_trace = optional_text(header, "WAVE_LEN")
    if value is None and of_trace is not None and of_trace.isdecimal():
        value = float(of_trace)
    power = optional_number(header, "WAVEUNIT")
    unit = (optional_text(header, "WAVEUNIT") or "angstrom") if power is None else f"{power:g}"
    factor = _ANGSTROM_PER_UNIT.get(unit.replace(" ", "").lower())
    return None if value is None or value <= 0 or factor is None else value * factor


def known_instrument(header: Cards) -> str | None:
    """Name of the shipped instrument whose table [match] agrees with this header; None if there is none."""
    texts = {key: optional_text(header, key) for key in ORIGIN_CARDS}
    return match_instrument(
        {**texts, "WAVELNTH": wavelength_angstrom(header), "CDELT1": plate_scale_arcsec(header)}
    )


def optional_exposure_s(header: Cards) -> float | None:
    """The exposure time in s: the value of XPOSURE, or else of EXPTIME. None if neither card holds a number above
    zero.
    """
    exposures = (optional_number(header, key) or 0.0 for key in ("XPOSURE", "EXPTIME"))
    return next((exposure for exposure in exposures if exposure > 0), None)


def seen_by(header: Cards) -> Observation:
    """The values of a header that describe the observation."""
    scale_x, scale_y = frame_of(header).scale_arcsec
    return {
        "instrument": known_instrument(header),
        "telescop": optional_text(header, "TELESCOP"),
        "instrume": optional_text(header, "INSTRUME"),
        "detector": optional_text(header, "DETECTOR"),
        "wavelnth": wavelength_angstrom(header),
        "date_obs": observed_at(header),
        "exposure_s": optional_exposure_s(header),
        "unit": optional_text(header, "BUNIT", "PIXLUNIT"),
        "cdelt1": scale_x,
        "cdelt2": scale_y,
        "gain_mode": optional_text(header, "GAINCOMB"),
    }


def _pair(header: Header, stem: str) -> tuple[int, int] | None:
    first, second = (optional_number(header, f"{stem}{axis}") for axis in (1, 2))
    return None if first is None or second is None else (int(first), int(second))


def shape_of(header: Header) -> tuple[int, int]:
    """The shape (ny, nx) that the header of a 2-D image declares. Raises HeaderError "bad-card"."""
    z = "Z" if card_flag(header, "ZIMAGE") else ""
    return card_count(header, f"{z}NAXIS2"), card_count(header, f"{z}NAXIS1")


def summary_of(image: Hdu, *, gzipped: bool) -> HeaderSummary:
    """The summary of an HDU that `first_image` chose.

    Parameters
    ----------
    gzipped
        Whether the file is compressed as a whole.
    """
    header = image.header
    compressed = card_flag(header, "ZIMAGE")
    return HeaderSummary(
        hdu=image.number,
        shape=shape_of(header),
        bitpix=card_count(header, "ZBITPIX" if compressed else "BITPIX", smallest=-64, largest=64),
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


def observed_at(header: Cards) -> str | None:
    """The start of the exposure in UTC: DATE-BEG, DATE-OBS or DATE_OBS, with TIME-OBS where the card holds a date
    alone.

    The text of the card, if it is ISO 8601 in UTC; converted to that form, if TIMESYS is TAI or TT, or if the second is
    a leap second. None if there is no such card.
    """
    text = optional_text(header, "DATE-BEG", "DATE-OBS", "DATE_OBS")
    if text is None:
        return None
    text = _OLD_DATE.sub(r"19\3-\2-\1", text)
    time = optional_text(header, "TIME-OBS", "TIME_OBS")
    if time is not None and _DATE_ONLY.fullmatch(text):
        text = f"{text}T{time}"
    scale = (optional_text(header, "TIMESYS") or "UTC").split()[0].upper()
    if scale in ("TAI", "TT"):
        return _in_utc(text, scale.lower())
    at = instant(text) if _LEAP_SECOND.fullmatch(text) else None
    return text if at is None else at.replace(tzinfo=None).isoformat()


def instant(text: str) -> datetime | None:
    """The instant of a date. A date without a time zone is in UTC; a leap second is the first of the next minute. None
    if the date cannot be read.
    """
    leap, later = _LEAP_SECOND.fullmatch(text), timedelta()
    if leap is not None:
        text, later = f"{leap[1]}:00{leap[3]}", timedelta(seconds=60 + float(f"0{leap[2] or '.0'}"))
    try:
        at = datetime.fromisoformat(text) + later
    except (ValueError, OverflowError):
        return None
    return at if at.tzinfo is not None else at.replace(tzinfo=UTC)


def _in_utc(text: str, scale: str) -> str:
    from astropy.time import Time  # slow to import, and few headers need it

    try:
        return str(Time(text.rstrip("Z"), scale=scale, format="isot").utc.isot)
    except ValueError:
        return text


@dataclass(frozen=True)
class ListedHeader:
    """The header of HDU ``index``: the HDU's name (EXTNAME, or empty), and (keyword, value, comment) of each card."""

    index: int
    name: str
    cards: list[tuple[str, JsonValue, str]]


def all_cards(path: str | os.PathLike[str], limits: FitsLimits) -> list[ListedHeader]:
    """All headers of a file, with their cards in the order of the file.

    If a card cannot be read, its value is its text. For a tile-compressed image, the header is the header of the table
    that contains it. Raises HeaderError if a header is unusable or exceeds the limits.
    """
    return [_listed(hdu.header, hdu.number) for hdu in all_hdus(path, limits)]


def _listed(header: Header, hdu: int) -> ListedHeader:
    cards = [_shown(card) for card in header.cards]
    names = [value for keyword, value, _comment in cards if keyword == "EXTNAME" and isinstance(value, str)]
    return ListedHeader(hdu, names[0].strip() if names else "PRIMARY" if hdu == 0 else "", cards)


def _shown(card: Card) -> tuple[str, JsonValue, str]:
    try:
        return card.keyword, _json(card.value), str(card.comment)
    except card_trouble():
        # card.image is not used here: astropy would repair the card and warn, and Python keeps the text of every
        # warning.
        return str(card.keyword), str(card._image)[8:].removeprefix("=").strip(), ""


def _json(value: object) -> JsonValue:
    """A card's value as JSON; null for a card without a value.

    Complex numbers and infinity, which JSON lacks, become text.
    """
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    from astropy.io.fits.card import Undefined

    return None if isinstance(value, Undefined) else str(value)


def utc_time(given: datetime | str, name: str) -> datetime:
    """A time with a zone. A time without a zone is in UTC; a date means the start of that day.

    Raises DataError "bad-time".

    Parameters
    ----------
    name
        Name of the field, for the message.
    """
    try:
        at = given if isinstance(given, datetime) else datetime.fromisoformat(given)
    except (TypeError, ValueError) as error:
        raise bad_time(given, name) from error
    return at if at.tzinfo else at.replace(tzinfo=UTC)


def bad_time(given: object, name: str) -> DataError:
    """The error for something that is not a time."""
    return DataError(
        "bad-time", f"{name}: expected a time such as 2024-03-01T12:00:00Z, got {ascii(given)[:60]}"
    )
