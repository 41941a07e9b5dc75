"""Where the instrument files lie, what they hash to, and which of them a header belongs to.

Standard library only, so that a process that never computes can import it.
"""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from psfcore.errors import DataError

_FOLDER = Path(__file__).parent


def instrument_names() -> tuple[str, ...]:
    """Names of all instruments shipped, sorted."""
    return tuple(sorted(path.stem for path in _FOLDER.glob("*.toml")))


def instrument_path(name: str) -> Path:
    """The description of instrument `name`; DataError "unknown-instrument" when there is none."""
    if name not in instrument_names():
        known = ", ".join(instrument_names())
        raise DataError("unknown-instrument", f"expected one of: {known}; got {name!r}")
    return _FOLDER / f"{name}.toml"


def instrument_digest(name: str) -> str:
    """SHA-256 (hex) of the bytes of instrument `name`'s description."""
    return hashlib.sha256(instrument_path(name).read_bytes()).hexdigest()


def match_instrument(cards: Mapping[str, object]) -> str | None:
    """Name of the instrument all of whose [match] cards equal those given, or None."""
    for name in instrument_names():
        wanted = _match_table(name)
        if wanted and all(_same(cards.get(key), value) for key, value in wanted.items()):
            return name
    return None


@cache
def _match_table(name: str) -> dict[str, str]:
    return dict(tomllib.loads(instrument_path(name).read_text("utf-8")).get("match", {}))


def _same(found: object, wanted: str) -> bool:
    return isinstance(found, str) and found.strip().upper() == wanted.upper()
