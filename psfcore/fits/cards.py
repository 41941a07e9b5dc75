"""Read single cards of a FITS header: whole numbers, flags and texts.

A card that defines the structure of a file must be correct and occur once. Source: FITS standard 4.0 (Pence et al. 2010;
IAU FITS working group 2018), section 4.4.
"""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, Any, Protocol

from psfcore.errors import HeaderError

if TYPE_CHECKING:
    from astropy.io.fits import Header

LARGEST_COUNT = 2**63 - 1
LONGEST_TEXT = 68  # characters of a card's value


class Cards(Protocol):
    """Header cards by keyword: the header of a file, or the cards of it that the catalogue stores."""

    def __getitem__(self, key: str, /) -> Any:
        """The value of a card. Raises KeyError if there is no such card."""
        ...


@cache
def card_trouble() -> tuple[type[Exception], ...]:
    """All types of exception that astropy raises for damaged cards. The type depends on the kind of damage."""
    from astropy.io.fits.verify import VerifyError

    return VerifyError, ValueError, TypeError, IndexError, OverflowError


def bad_card(expected: str, got: object) -> HeaderError:
    """The error for a card that the software cannot use."""
    return HeaderError("bad-card", f"expected {expected}; got {got}: copy or make the file again")


def card_value(header: Header, key: str) -> object:
    """The value of a structural card, or None. Raises HeaderError if the card is unreadable or occurs more than once."""
    try:
        if header.count(key) > 1:
            raise bad_card(f"card {key} once", f"it {header.count(key)} times")
        return header[key]
    except KeyError:
        return None
    except HeaderError:
        raise
    except card_trouble():
        message = f"expected a readable card {key}; its value cannot be read: copy or make the file again"
        raise HeaderError("bad-card", message) from None


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
    for key in keys:
        value = lenient_value(header, key)
        if isinstance(value, str) and value.strip():
            return value.strip()
    return None


def optional_number(header: Cards, *keys: str) -> float | None:
    """The value of the first of the cards `keys` that holds a finite number; None if no card does."""
    for key in keys:
        value = lenient_value(header, key)
        if isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e300:
            return float(value)
    return None


def optional_value(header: Cards, key: str) -> str | float | bool | None:
    """The value of a card: True or False, a finite number, or a text without surrounding spaces; otherwise None."""
    value = lenient_value(header, key)
    if isinstance(value, bool):
        return value
    number = optional_number(header, key)
    return optional_text(header, key) if number is None else number


def lenient_value(header: Cards, key: str) -> object:
    """The value of an optional, descriptive card; None if the card is missing or damaged."""
    try:
        return header[key]
    except KeyError:
        return None
    except card_trouble():
        return None
