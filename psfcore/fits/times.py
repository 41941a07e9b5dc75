"""The time of an observation, from the cards that give it."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta

from psfcore.errors import DataError
from psfcore.fits.cards import Cards, optional_text

_DATE_ONLY = re.compile(r"\d{4}-\d\d-\d\d")
_OLD_DATE = re.compile(r"(\d\d)/(\d\d)/(\d\d)")  # FITS before 1998: day, month, year - 1900
_LEAP_SECOND = re.compile(r"(.*T\d\d:\d\d):60(\.\d*)?(Z?)")


def observed_at(header: Cards) -> str | None:
    """The start of the exposure in UTC: DATE-BEG, DATE-OBS or DATE_OBS, with TIME-OBS where the card holds a date alone.

    The text of the card, if it is ISO 8601 in UTC; converted to that form, if TIMESYS is TAI or TT, or if the second is a
    leap second. None if there is no such card.
    """
    text = optional_text(header, "DATE-BEG", "DATE-OBS", "DATE_OBS")
    if text is None:
        return None
    old = _OLD_DATE.fullmatch(text)
    if old is not None:
        text = f"19{old[3]}-{old[2]}-{old[1]}"
    time = optional_text(header, "TIME-OBS", "TIME_OBS")
    if time is not None and _DATE_ONLY.fullmatch(text):
        text = f"{text}T{time}"
    scale = (optional_text(header, "TIMESYS") or "UTC").split()[0].upper()
    if scale in ("TAI", "TT"):
        return _in_utc(text, scale.lower())
    if _LEAP_SECOND.fullmatch(text):
        at = instant(text)
        return text if at is None else at.replace(tzinfo=None).isoformat()
    return text


def instant(text: str) -> datetime | None:
    """The instant of a date. A date without a time zone is in UTC; a leap second is the first of the next minute. None if
    the date cannot be read."""
    leap = _LEAP_SECOND.fullmatch(text)
    try:
        if leap is not None:
            minute = instant(f"{leap[1]}:00{leap[3]}")
            return None if minute is None else minute + timedelta(seconds=60 + float(f"0{leap[2] or '.0'}"))
        at = datetime.fromisoformat(text)
    except ValueError:
        return None
    return at if at.tzinfo is not None else at.replace(tzinfo=UTC)


def _in_utc(text: str, scale: str) -> str:
    from astropy.time import Time  # slow to import, and few headers need it

    try:
        return str(Time(text.rstrip("Z"), scale=scale, format="isot").utc.isot)
    except ValueError:
        return text


def utc_time(given: datetime | str, name: str) -> datetime:
    """A time with a zone. A time without a zone is in UTC; a date means the start of that day.

    name: name of the field, for the message. Raises DataError "bad-time".
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
