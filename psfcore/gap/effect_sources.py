"""The source text that defines effects, of the library or added ones: find and hash it, without running it."""

from __future__ import annotations

import hashlib
import importlib.util
from functools import cache
from pathlib import Path

from psfcore.errors import DataError

_LIBRARY = Path(__file__).parent / "library"


@cache
def library_sha256() -> str:
    """SHA-256 (hex) of the source texts of the library of effects."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in sorted(_LIBRARY.glob("*.py")))).hexdigest()


def is_file(source: str) -> bool:
    """Whether a source is a file name (it ends in .py); otherwise it is the name of a module."""
    return source.endswith(".py")


def sha256_of_source(source: str) -> str:
    """SHA-256 (hex) of the source text of a file (path ending in .py) or of a module. Raises DataError "bad-effects".

    The hash does not cover other files that the text imports. To find a module, Python imports its parent packages.
    """
    try:
        text = _file_of(source).read_bytes()
    except (OSError, ImportError, ValueError) as error:
        message = f"effects of {source}: expected a readable Python file (.py) or module; got {error}"
        raise DataError("bad-effects", message) from error
    return hashlib.sha256(text).hexdigest()


def _file_of(source: str) -> Path:
    if is_file(source):
        return Path(source)
    spec = importlib.util.find_spec(source)
    if spec is None:
        raise ImportError(f"No module named {source!r}")
    if not spec.has_location or spec.origin is None:
        raise ImportError(f"the module {source!r}, which has no source file")
    return Path(spec.origin)
