"""The text that defines effects which somebody adds: a Python file's, or a module's. Nothing of it is run here."""

from __future__ import annotations

import hashlib
import importlib.util
from pathlib import Path

from psfcore.errors import DataError


def is_file(source: str) -> bool:
    """Whether a name is a file's; else it is a module's."""
    return source.endswith(".py")


def sha256_of_source(source: str) -> str:
    """SHA-256 (hex) of the text of a file, whose path ends in .py, or of a module's. Raises DataError "bad-effects".

    What that text imports is not in it. The packages that a module lies in are imported, to find it.
    """
    try:
        text = _file_of(source).read_bytes()
    except (OSError, ImportError, ValueError) as error:
        message = (
            f"effects of {source}: expected a Python file (.py) or a module that can be read; got {error}"
        )
        raise DataError("bad-effects", message) from error
    return hashlib.sha256(text).hexdigest()


def _file_of(source: str) -> Path:
    if is_file(source):
        return Path(source)
    spec = importlib.util.find_spec(source)
    if spec is None:
        raise ImportError(f"No module named {source!r}")
    if not spec.has_location or spec.origin is None:
        raise ImportError(f"{source!r}, which has no file of its own")
    return Path(spec.origin)
