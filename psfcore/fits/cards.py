"""Read single cards of a FITS header: whole numbers, flags and texts.

A card that defines the structure of a file must be correct and occur once. Source: FITS standard 4.0 (Pence et al.
2010; IAU FITS working group 2018), section 4.4.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from typing import TYPE_CHECKING, Protocol

from psfcore.errors import HeaderError

if TYPE_CHECKING:
    from astropy.io.fits import Header

LARGEST_COUNT = 2**63 - 1
LONGEST_TEXT = 68  # characters of a card's value
_PLAIN_KEY = re.compile(r"[A-Z0-9_-]{0,8}")  # a keyword without HIERARCH
LARGEST_NUMBER = 1e300
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eEdD][+-]?\d{1,3})?")


class Cards(Protocol):
    """Header cards by keyword: the header of a file, or the cards of it that the catalogue stores."""

    def __getitem__(self, key: str, /) -> object:
        """The value of a card. Raises KeyError if there is no such card."""


@cache
def card_trouble() -> tuple[type[Exception], ...]:
    """All types of exception that astropy raises for damaged cards. The type depends on the kind of damage."""
    from astropy.io.fits.verify import VerifyError

    return VerifyError, ValueError, TypeError, IndexError, OverflowError


def bad_card(expected: str, got: object) -> HeaderError:
    """The error for a card that the software cannot use."""
    return HeaderError("bad-card", f"expected {expected}; got {got}: copy or make the file again")


def check_card(good: bool, expected: str, got: object) -> None:
    """Raise `bad_card` unless a card is good."""
    if not good:
        raise bad_card(expected, got)


def check_header(good: bool, code: str, message: str) -> None:
    """Raise HeaderError with this code and message unless a header is good."""
    if not good:
        raise HeaderError(code, message)


def card_value(header: Header, key: str) -> object:
    """The value of a structural card, or None. Raises HeaderError if the card is unreadable or occurs more than
    once.
    """
    if key not in header:
        return None
    check_card(header.count(key) == 1, f"card {key} once", f"it {header.count(key)} times")
    try:
        return header[key]
    except card_trouble():
        raise HeaderError(
            "bad-card",
            f"expected a readable card {key}; its value cannot be read: copy or make the file again",
        ) from None


def card_count(
    header: Header, key: str, *, smallest: int = 0, largest: int = LARGEST_COUNT, default: int | None = None
) -> int:
    """A whole number in a structural card. Raises HeaderError "bad-card" if it is missing or out of range."""
    value = card_value(header, key)
    if value is None and default is not None:
        return default
    if isinstance(value, bool) or not isinstance(value, int) or not smallest <= value <= largest:
        raise bad_card(f"{key} = integer from {smallest} to {largest}", f"{value!r:.40}")
    return value


def card_flag(header: Header, key: str) -> bool:
    """Whether a structural card has the value T."""
    return card_value(header, key) is True


def card_text(header: Header, key: str) -> str | None:
    """The text of a structural card, without surrounding spaces; None if the card is missing or does not hold text."""
    value = card_value(header, key)
    return value.strip() if isinstance(value, str) else None


def optional_text(header: Cards, *keys: str) -> str | None:
    """The text of the first of the cards `keys` that holds a non-empty string; None if no card does.

    Surrounding spaces are removed.
    """
    values = (lenient_value(header, key) for key in keys)
    return next((value.strip() for value in values if isinstance(value, str) and value.strip()), None)


def without_cards(header: Header, keys: Iterable[str]) -> Header:
    """A copy of a header without the cards with these keywords."""
    kept = header.copy()
    for key in keys:
        kept.remove(key, ignore_missing=True, remove_all=True)
    return kept


def plain_value(value: object) -> object:
    """The Python value of a scalar of numpy; other values unchanged. The web process does not load numpy."""
    return value.item() if hasattr(value, "item") and getattr(value, "size", 1) == 1 else value


def long_key(key: str) -> str:
    """A keyword as astropy takes it without a warning: keywords that are longer than 8 characters, or have others than
    FITS allows, need HIERARCH.
    """
    return key if _PLAIN_KEY.fullmatch(key) else f"HIERARCH {key}"


def number_of(value: object, *, text: bool = True) -> float | None:
    """A finite number, as a card, a table in memory or numpy holds it, and with `text` also a number that is written as
    text; None for anything else.
    """
    if isinstance(value, str):
        value = float(re.sub("[dD]", "e", value)) if text and _NUMBER.fullmatch(value.strip()) else None
    if getattr(value, "mask", False) is not False:  # a masked cell of a table
        return None
    value = plain_value(value)
    if value is None or isinstance(value, bool):
        return None
    try:
        number = float(value)  # type: ignore[arg-type]  # of anything else, float raises one of these errors
    except (TypeError, ValueError, OverflowError):
        return None
    return number if -LARGEST_NUMBER < number < LARGEST_NUMBER else None


def optional_number(header: Cards, *keys: str) -> float | None:
    """The value of the first of the cards `keys` that holds a finite number; None if no card does."""
    found = (number_of(lenient_value(header, key)) for key in keys)
    return next((number for number in found if number is not None), None)


def optional_value(header: Cards, key: str) -> str | float | bool | None:
    """The value of a card: True or False, a finite number, or a text without surrounding spaces; otherwise None."""
    value = lenient_value(header, key)
    plain = value if isinstance(value, bool) else number_of(value, text=False)
    return optional_text(header, key) if plain is None else plain


def lenient_value(header: Cards, key: str) -> object:
    """The value of an optional, descriptive card; None if the card is missing or damaged."""
    try:
        return header[key]
    except KeyError:
        return None
    except card_trouble():
        return None


def history_of(header: Cards) -> str:
    """The lines of HISTORY; empty if there are none."""
    return str(lenient_value(header, "HISTORY") or "")
