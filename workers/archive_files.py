"""Files of an archive: where the operator lets them be read and written, which of them a pattern names, what they are called.

A path that a request names is resolved first, symbolic links and all, and must then lie below a folder that the
operator allows. So must every file that a pattern finds, and again when it is read.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from pathlib import Path, PurePath
from typing import Any

from psfcore.errors import DataError
from psfcore.header import FitsLimits, first_image_header, optional_value
from workers.bulk_contract import Condition

ANY_FOLDERS = "**"
_MAGIC = re.compile(r"[*?\[]")
_FITS_ENDING = re.compile(r"\.(fits|fit|fts)(\.gz)?$", re.IGNORECASE)
_NOT_IN_A_NAME = re.compile(r"[^A-Za-z0-9._-]+")
_CHUNK = 2**20


def roots(folders: str) -> tuple[Path, ...]:
    """Folders in a setting, as the system separates paths, each resolved."""
    return tuple(Path(folder).resolve() for folder in folders.split(os.pathsep) if folder.strip())


def check_under(path: Path, allowed: Sequence[Path], what: str = "a path") -> Path:
    """The path resolved, where it lies below a folder that is allowed; else DataError "path-not-allowed"."""
    resolved = path.resolve()
    if any(resolved.is_relative_to(root) for root in allowed):
        return resolved
    none = (
        "a folder that the operator allows; there is none (HELIOPSF_BULK_ROOTS, HELIOPSF_BULK_OUTPUT_ROOTS)"
    )
    where = ", ".join(map(str, allowed)) or none
    raise DataError("path-not-allowed", f"expected {what} below {where}; got {ascii(str(path))[:200]}")


def check_glob(glob: str, allowed: Sequence[Path]) -> None:
    """DataError "bad-path" or "path-not-allowed" for a pattern whose fixed part is no folder that may be read."""
    folder, _parts = _split(glob)
    check_under(folder, allowed)


def find(glob: str, allowed: Sequence[Path]) -> Iterator[Path]:
    """Files that a pattern names, in the order of their names. Links to elsewhere are not followed.

    Raises DataError "bad-path", "path-not-allowed", "unreadable-folder".
    """
    folder, parts = _split(glob)
    yield from _walk(check_under(folder, allowed), parts, allowed)


def matches(path: Path, where: dict[str, Condition], limits: FitsLimits) -> bool:
    """Whether the header of a file's image says what is asked. Raises DataError where there is none to ask."""
    if not where:
        return True
    header = first_image_header(path, limits)
    return all(_met(optional_value(header, key), condition) for key, condition in where.items())


def copy_hashed(source: Path, target: Path, max_bytes: int) -> str:
    """Copy a file; the SHA-256 of what was copied. Raises DataError "too-large", OSError.

    What is worked on is the copy: an archive may change meanwhile.
    """
    digest, size = hashlib.sha256(), 0
    with source.open("rb") as file, target.open("wb") as copy:
        while chunk := file.read(_CHUNK):
            size += len(chunk)
            if size > max_bytes:
                raise DataError("too-large", f"expected a file of at most {max_bytes} bytes; got more")
            digest.update(chunk)
            copy.write(chunk)
    return digest.hexdigest()


def safe_name(name: str, identity: str) -> str:
    """What a product's file is called: after its image, with nothing in it but letters, digits and . _ -"""
    stem = _NOT_IN_A_NAME.sub("_", _FITS_ENDING.sub("", PurePath(name).name)).strip("._-")[:80] or "image"
    return f"{stem}-{identity[:16]}.fits"


def _split(glob: str) -> tuple[Path, tuple[str, ...]]:
    """The folder before the first part with a wildcard in it, and the parts from there on."""
    path = PurePath(glob)
    if not path.is_absolute() or ".." in path.parts:
        raise DataError("bad-path", f"expected an absolute path without '..'; got {ascii(glob)[:200]}")
    fixed = next((n for n, part in enumerate(path.parts) if _MAGIC.search(part)), len(path.parts) - 1)
    return Path(*path.parts[:fixed]), path.parts[fixed:]


def _walk(folder: Path, parts: tuple[str, ...], allowed: Sequence[Path]) -> Iterator[Path]:
    head, rest = parts[0], parts[1:]
    if head == ANY_FOLDERS:
        yield from _walk(folder, rest or ("*",), allowed)
        for entry in _entries(folder):
            if entry.is_dir(follow_symlinks=False) and not entry.name.startswith("."):
                yield from _walk(Path(entry.path), parts, allowed)
        return
    for entry in _entries(folder):
        if not _named(entry.name, head):
            continue
        path = Path(entry.path)
        if not any(path.resolve().is_relative_to(root) for root in allowed):
            continue
        if rest and entry.is_dir():
            yield from _walk(path, rest, allowed)
        elif not rest and entry.is_file():
            yield path


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            return sorted(entries, key=lambda entry: entry.name)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise DataError(
            "unreadable-folder", f"expected a folder that can be read; got {folder}: {reason}"
        ) from error


def _named(name: str, pattern: str) -> bool:
    """Whether a name is meant; what begins with a full stop is hidden from wildcards."""
    return fnmatchcase(name, pattern) and (not name.startswith(".") or pattern.startswith("."))


def _met(value: str | float | bool | None, condition: Condition) -> bool:
    if value is None:
        return False
    if isinstance(condition, dict):
        return all(_compared(value, sign, other) for sign, other in condition.items())
    if isinstance(condition, list):
        return any(_same(value, other) for other in condition)
    return _same(value, condition)


def _same(value: Any, other: Any) -> bool:
    return isinstance(value, bool) == isinstance(other, bool) and bool(value == other)


def _compared(value: Any, sign: str, other: Any) -> bool:
    """Numbers with numbers, texts with texts, as ISO times are ordered; whatever else is not met."""
    if isinstance(value, bool) or isinstance(value, str) != isinstance(other, str):
        return sign == "!="
    match sign:
        case "<":
            return bool(value < other)
        case "<=":
            return bool(value <= other)
        case ">":
            return bool(value > other)
        case ">=":
            return bool(value >= other)
        case _:
            return bool(value != other)
