"""Files of an archive: where the operator lets them be read and written, which of them a pattern names, what they are called.

A path that a request names is resolved first, symbolic links and all, and must then lie below a folder that the
operator allows. So must every file that a pattern finds, and again when it is read.
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path, PurePath
from typing import Any

from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits, first_image_header, optional_value
from workers.contract.bulk import Condition

ANY_FOLDERS = "**"
_MAGIC = re.compile(r"[*?\[]")
_FITS_ENDING = re.compile(r"\.(fits|fit|fts)(\.gz)?$", re.IGNORECASE)
_NOT_IN_A_NAME = re.compile(r"[^A-Za-z0-9._-]+")
_CHUNK = 2**20


@dataclass(frozen=True)
class Found:
    """What a pattern names: a file, or an entry of a folder that cannot be looked at, and why."""

    path: Path
    error: DataError | None = None


def roots(folders: str) -> tuple[Path, ...]:
    """Folders in a setting, as the system separates paths, each resolved."""
    return tuple(Path(folder).resolve() for folder in folders.split(os.pathsep) if folder.strip())


def check_under(path: Path, allowed: Sequence[Path], what: str = "a path") -> Path:
    """The path resolved, where it lies below a folder that is allowed.

    Raises DataError "path-not-allowed", or "bad-path" where its links lead nowhere.
    """
    try:
        resolved = _resolved(path)
    except OSError as error:
        raise DataError(
            "bad-path",
            f"expected {what} that leads somewhere; got {ascii(str(path))[:200]}: {reason_of(error)}",
        ) from error
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


def find(glob: str, allowed: Sequence[Path], tick: Callable[[], None] = lambda: None) -> Iterator[Found]:
    """Files that a pattern names, each once: those of a folder by name, then those below it. Links out are not followed.

    An entry that is meant and cannot be looked at comes with its error. ``tick`` is called for each folder and each
    entry, whether it is meant or not; what it raises ends the walk.
    Raises DataError "bad-path", "path-not-allowed", "unreadable-folder".
    """
    folder, parts = _split(glob)
    return _walk(check_under(folder, allowed), parts, allowed, tick)


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


def shown(path: PurePath) -> str:
    """A path as text that any database and any answer takes: bytes that are not UTF-8 as \\xff."""
    return str(path).encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def _split(glob: str) -> tuple[Path, tuple[str, ...]]:
    """The folder before the first part with a wildcard in it, and the parts from there on.

    Of several ** in a row there is one; the last part is never one.
    """
    path = PurePath(glob)
    if not path.is_absolute() or ".." in path.parts:
        raise DataError("bad-path", f"expected an absolute path without '..'; got {ascii(glob)[:200]}")
    fixed = next((n for n, part in enumerate(path.parts) if _MAGIC.search(part)), len(path.parts) - 1)
    parts: list[str] = []
    for part in path.parts[fixed:]:
        if part != ANY_FOLDERS or parts[-1:] != [ANY_FOLDERS]:
            parts.append(part)
    if parts[-1] == ANY_FOLDERS:
        parts.append("*")
    return Path(*path.parts[:fixed]), tuple(parts)


def _walk(
    top: Path, parts: tuple[str, ...], allowed: Sequence[Path], tick: Callable[[], None]
) -> Iterator[Found]:
    """Each folder is looked through once, for all parts that may come next there: several ** do not multiply."""
    left = [(top, frozenset({0}))]
    while left:
        folder, places = left.pop()
        tick()
        places |= {place + 1 for place in places if parts[place] == ANY_FOLDERS}  # it may stand for none
        below: list[tuple[Path, frozenset[int]]] = []
        for entry in _entries(folder):
            tick()
            path = Path(entry.path)
            try:
                meant, further = _meant(entry, parts, places, allowed)
            except OSError as error:
                message = f"expected a file or folder that can be looked at: {reason_of(error)}"
                yield Found(path, DataError("unreadable-file", message))
                continue
            if meant:
                yield Found(path)
            if further:
                below.append((path, further))
        left += reversed(below)


def _meant(
    entry: os.DirEntry[str], parts: tuple[str, ...], places: frozenset[int], allowed: Sequence[Path]
) -> tuple[bool, frozenset[int]]:
    """Whether an entry is a file that is meant; the parts that may come next in it, none where it is no folder.

    Raises OSError where that cannot be seen.
    """
    further = {place for place in places if parts[place] == ANY_FOLDERS}
    if further and (entry.name.startswith(".") or not entry.is_dir(follow_symlinks=False)):
        further.clear()
    named = {n for n in places if parts[n] != ANY_FOLDERS and _named(entry.name, parts[n])}
    if not named or not any(_resolved(Path(entry.path)).is_relative_to(root) for root in allowed):
        return False, frozenset(further)
    last = len(parts) - 1
    if named != {last} and entry.is_dir():
        further |= {place + 1 for place in named - {last}}
    return last in named and entry.is_file(), frozenset(further)


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            return sorted(entries, key=lambda entry: entry.name)
    except OSError as error:
        raise DataError(
            "unreadable-folder",
            f"expected a folder that can be read; got {shown(folder)}: {reason_of(error)}",
        ) from error


def _resolved(path: Path) -> Path:
    """The path without links in it. Raises OSError."""
    try:
        return path.resolve()
    except RuntimeError as error:  # what Python before 3.13 raises for links that lead round in a circle
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP)) from error


def reason_of(error: OSError) -> str:
    """What the system says of it, without the path."""
    return error.strerror or type(error).__name__


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
