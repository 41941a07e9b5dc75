"""Finds the instrument files: by name, and by the header of an image; and says which telescopes they describe.

This module imports no numerical library, so that the web process can import it.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from psfcore.errors import DataError, did_you_mean

# Two wavelengths count as the same channel, and two plate scales as the same, if their ratio differs from 1 by at most
# this.
WAVELENGTH_TOLERANCE = 0.01
PLATE_SCALE_TOLERANCE = 0.01
# The numbers in the table [match] may differ from those of an image by this ratio.
_TOLERANCES = {"WAVELNTH": WAVELENGTH_TOLERANCE, "CDELT1": PLATE_SCALE_TOLERANCE}
_MOST_DOTS = 64  # a part of the file without brackets, commas or line ends may contain this number of dots
_FOLDER = Path(__file__).parent
# Names of telescopes whose files match a card that does not name the spacecraft.
_TELESCOPES = {"HRI_EUV": "Solar Orbiter EUI/HRI_EUV", "EUVI": "STEREO/EUVI"}


def instrument_names() -> tuple[str, ...]:
    """Names of all shipped instruments, sorted."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.toml")))


def instrument_path(name: str) -> Path:
    """Path of the file of instrument `name`; raises DataError "unknown-instrument"."""
    if name not in instrument_names():
        names = ", ".join(instrument_names())
        hint = did_you_mean(name, instrument_names())
        raise DataError("unknown-instrument", f"expected one of: {names}; got {name!r}{hint}")
    return _FOLDER / f"{name}.toml"


def parse_toml(text: str) -> dict[str, Any]:
    """The tables of a TOML text, which may begin with a byte order mark. Raises ValueError, RecursionError."""
    # The parser's time grows with the square of a dotted key's length: 64 kB of "a.a.a" would take half a minute.
    for stretch in re.split(r"[^\w\"'. \t-]", text):
        if stretch.count(".") > _MOST_DOTS:
            raise ValueError(f"a key may have at most {_MOST_DOTS} parts; got {stretch.strip()[:40]!r} ...")
    return tomllib.loads(text.removeprefix("\ufeff"))  # Windows editors write the mark


def turned_text(name: str, turn_deg: float) -> str:
    """The text of the file of instrument `name` for images that are turned by this angle against the detector."""
    return f"turn_deg = {turn_deg:.2f}\n{instrument_path(name).read_text('utf-8')}"


def telescope_of(name: str) -> str:
    """The telescope of instrument `name` as people write it, such as "SDO/AIA"."""
    cards = match_table(name)
    card = str(cards.get("TELESCOP") or cards.get("DETECTOR") or name)
    return _TELESCOPES.get(card, card)


@cache
def telescopes() -> dict[str, str]:
    """The telescopes that the shipped files describe, with their channels in angstrom, such as "94 to 335"."""
    by_telescope: dict[str, list[float]] = {}
    for name in instrument_names():
        angstrom = parse_toml(instrument_path(name).read_text("utf-8"))["wavelength_angstrom"]
        by_telescope.setdefault(telescope_of(name), []).append(angstrom)
    ends = {name: dict.fromkeys((min(channels), max(channels))) for name, channels in by_telescope.items()}
    return {name: " to ".join(f"{channel:g}" for channel in channels) for name, channels in ends.items()}


def match_instrument(cards: Mapping[str, object]) -> str | None:
    """Name of the instrument whose cards in the table [match] all equal the given header cards, or None.

    Several instruments may match: the file of a variant of an instrument, for one filter or plate scale, has the cards
    of the instrument and further ones. The instrument with the most cards is chosen; of several, the first by name.

    Parameters
    ----------
    cards
        The values of TELESCOP, OBSRVTRY, INSTRUME, DETECTOR, FILTER, EC_FW1_ and EC_FW2_ as texts, of WAVELNTH in
        angstrom, and of CDELT1 in arcsec/px. `psfcore.fits.header.known_instrument` reads them from a header.
    """
    best, most = None, 0
    for name in instrument_names():
        table = match_table(name)
        matches = (_same(cards.get(key), value, _TOLERANCES.get(key, 0.0)) for key, value in table.items())
        if len(table) > most and all(matches):
            best, most = name, len(table)
    return best


@cache
def match_table(name: str) -> dict[str, str | float]:
    """The table [match] of the file of instrument `name`: header cards and their values; empty if there is none."""
    return dict(parse_toml(instrument_path(name).read_text("utf-8")).get("match", {}))


def _same(card: object, value: str | float, tolerance: float) -> bool:
    if isinstance(value, str):
        return isinstance(card, str) and card.strip().upper() == value.upper()
    if not isinstance(card, (int, float)) or isinstance(card, bool):
        return False
    return abs(card / value - 1) <= tolerance
