"""The cards of all headers of a FITS file, as JSON values. This module reads no pixels, so the web process can import it."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from psfcore.fits.blocks import FitsLimits, open_source, walk
from psfcore.fits.cards import card_trouble

if TYPE_CHECKING:
    from astropy.io import fits

JsonValue = str | int | float | bool | None
_KEYWORD_CHARACTERS = 8


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
    with open_source(Path(path), limits) as source:
        return [_listed(hdu.header, hdu.number) for hdu in walk(source, limits)]


def _listed(header: fits.Header, hdu: int) -> ListedHeader:
    cards = [_shown(card) for card in header.cards]
    names = [value for keyword, value, _comment in cards if keyword == "EXTNAME" and isinstance(value, str)]
    return ListedHeader(hdu, names[0].strip() if names else "PRIMARY" if hdu == 0 else "", cards)


def _shown(card: fits.Card) -> tuple[str, JsonValue, str]:
    try:
        return card.keyword, _json(card.value), str(card.comment)
    except card_trouble():
        # card.image is not used here: astropy would repair the card and warn, and Python keeps the text of every
        # warning.
        text = str(card._image)[_KEYWORD_CHARACTERS:].removeprefix("=")
        return str(card.keyword), text.strip(), ""


def _json(value: object) -> JsonValue:
    """A card's value as JSON; null for a card without a value.

    Complex numbers and infinity, which JSON lacks, become text.
    """
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if value is None or isinstance(value, (str, bool, int, float)):
        return value
    from astropy.io import fits

    return None if isinstance(value, fits.card.Undefined) else str(value)
