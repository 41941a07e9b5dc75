"""Finds the instrument files: by name, and by the header of an image.

This module imports no numerical library, so that the web process can import it.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from psfcore.errors import DataError

WAVELENGTH_TOLERANCE = (
    0.01  # two wavelengths count as the same channel if their ratio differs from 1 by at most this
)
_FOLDER = Path(__file__).parent


def instrument_names() -> tuple[str, ...]:
    """Names of all shipped instruments, sorted."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.toml")))


def instrument_path(name: str) -> Path:
    """Path of the file of instrument `name`; raises DataError "unknown-instrument"."""
    if name not in instrument_names():
        known = ", ".join(instrument_names())
        raise DataError("unknown-instrument", f"expected one of: {known}; got {name!r}")
    return _FOLDER / f"{name}.toml"


def match_instrument(cards: Mapping[str, object]) -> str | None:
    """Name of the first instrument whose cards in the table [match] all equal the given header cards, or None.

    cards: TELESCOP, INSTRUME and DETECTOR as texts, and WAVELNTH in angstrom. `psfcore.fits.header.known_instrument`
    reads them from a header.
    """
    for name in instrument_names():
        wanted = match_table(name)
        if wanted and all(_same(cards.get(key), value) for key, value in wanted.items()):
            return name
    return None


@cache
def match_table(name: str) -> dict[str, str | float]:
    """The table [match] of the file of instrument `name`: header cards and their values; empty if there is none."""
    return dict(tomllib.loads(instrument_path(name).read_text("utf-8")).get("match", {}))


def _same(found: object, wanted: str | float) -> bool:
    if isinstance(wanted, str):
        return isinstance(found, str) and found.strip().upper() == wanted.upper()
    if not isinstance(found, (int, float)) or isinstance(found, bool):
        return False
    return abs(found / wanted - 1) <= WAVELENGTH_TOLERANCE
