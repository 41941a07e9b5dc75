"""The source text that defines effects, of the library or added ones: find and hash it, without running it."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

from psfcore import user_code
from psfcore.errors import DataError

_LIBRARY = Path(__file__).parent / "library"
_CALIBRATION = Path(__file__).parent / "verdict" / "calibration.json"


@cache
def library_sha256() -> str:
    """SHA-256 (hex) of the source texts of the library of effects, and of the calibration that was made with this
    library.
    """
    texts = (*sorted(_LIBRARY.glob("*.py")), _CALIBRATION)
    return hashlib.sha256(b"".join(path.read_bytes() for path in texts)).hexdigest()


def sha256_of_source(source: str) -> str:
    """SHA-256 (hex) of the source text of added effects (`psfcore.user_code`). Raises DataError "bad-effects"."""
    return user_code.sha256_of_source(source, bad_effects)


def bad_effects(source: str, what: str) -> DataError:
    """The error "bad-effects" of a file or module with added effects.

    Parameters
    ----------
    source
        The file or module with the effects.
    what
        A description of the mistake.
    """
    return DataError("bad-effects", f"effects of {source}: {what}")
