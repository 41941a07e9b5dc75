"""Files of an archive of images: allowed folders, patterns that match files, and names of output files.

The symbolic links in the path of a request are resolved first. The resolved path must lie below a folder that the
operator allows. Every file that a pattern matches is checked in the same way.

After the check, a file is opened safely even if somebody changes a link meanwhile: its path is opened part by part,
from the allowed folder downwards, and no part may be a link. If somebody replaces a part by a link after the check, the
operating system refuses to open it. A file is written and renamed inside the opened folder, not by its path.
"""

from __future__ import annotations

import errno
import hashlib
import operator
import os
import re
import shutil
import stat
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path, PurePath
from typing import Any, BinaryIO

from psfcore.errors import DataError
from psfcore.files import FITS_ENDING, PARTIAL
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.cards import optional_value
from psfcore.fits.header import read_first_image
from workers.contract.bulk import Condition
from workers.files.modes import open_file, open_folder, open_made_folder

ANY_FOLDERS = "**"
_MAGIC = re.compile(r"[*?\[]")
_NOT_IN_A_NAME = re.compile(r"[^A-Za-z0-9._-]+")
_CHUNK = 2**20
_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
# O_NONBLOCK: without this flag, opening a pipe would wait until another process opens the other end of the pipe.
_FILE = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_NEW_FILE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_SIGNS = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge, "!=": operator.ne}
Position = tuple[str, ...]


@dataclass(frozen=True)
class Entry:
    """A folder or an entry of a folder at which a search looked.

    Attributes
    ----------
    position
        The names of the folders below the fixed part of the pattern, and then the name of the entry. For a folder that
        is now read, the last name is empty.
    matches
        Whether the entry is a file that the pattern matches.
    error
        The error if the entry could not be inspected.
    """

    path: Path
    position: Position
    matches: bool = False
    error: DataError | None = None


def roots(folders: str) -> tuple[Path, ...]:
    """The folders of a setting, resolved. The setting separates folders in the same way as PATH."""
    return tuple(Path(folder).resolve() for folder in folders.split(os.pathsep) if folder.strip())


def check_under(path: Path, allowed: Sequence[Path], what: str = "a path") -> Path:
    """Resolve a path and check that it lies below an allowed folder; returns the resolved path.

    Raises DataError "path-not-allowed", or "bad-path" if the links in the path cannot be resolved.
    """
    try:
        resolved = _resolved(path)
    except OSError as error:
        raise DataError(
            "bad-path",
            f"expected {what} that can be resolved; got {ascii(str(path))[:200]}: {reason_of(error)}",
        ) from error
    if any(resolved.is_relative_to(root) for root in allowed):
        return resolved
    none = "a folder that the operator allows (no folder is set in HELIOPSF_BULK_ROOTS, HELIOPSF_BULK_OUTPUT_ROOTS)"
    where = ", ".join(map(str, allowed)) or none
    message = (
        f"expected {what} below {where}; got {ascii(str(path))[:200]}: use another path, or ask the operator to allow "
        "its folder"
    )
    raise DataError("path-not-allowed", message)


def check_glob(glob: str, allowed: Sequence[Path]) -> None:
    """Raise DataError "bad-path" or "path-not-allowed" if the fixed part of a pattern is not in an allowed folder."""
    folder, _parts = _split(glob)
    check_under(folder, allowed)


def find(glob: str, allowed: Sequence[Path], after: Position | None = None) -> Iterator[Entry]:
    """Find the files that a pattern matches, and yield every folder and entry at which the search looks, each once.

    The entries of a folder are sorted by name; those of its subfolders follow. Links that lead out of the allowed
    folders are not followed.

    Parameters
    ----------
    glob
        The pattern.
    allowed
        The folders below which the search may look.
    after
        The position after which an earlier search ended, and this one continues; None: from the beginning. What was
        added or removed before this position since then is not noticed.

    Raises
    ------
    DataError
        "bad-path", "path-not-allowed", "unreadable-folder".
    """
    folder, parts = _split(glob)
    return _walk(check_under(folder, allowed), parts, allowed, after)


def matches(path: Path, where: dict[str, Condition], limits: FitsLimits) -> bool:
    """Whether the header of a file's first image meets all conditions. Raises DataError if it cannot be read."""
    header = read_first_image(path, limits)[1].header
    return all(_met(optional_value(header, key), condition) for key, condition in where.items())


def copy_hashed(file: BinaryIO, target: Path, max_bytes: int) -> str:
    """Copy an opened file; returns the SHA-256 of the copy. Raises DataError "too-large", or OSError.

    The task uses the copy, because the file in the archive may change while the task runs.
    """
    digest, size = hashlib.sha256(), 0
    with target.open("wb") as copy:
        while chunk := file.read(_CHUNK):
            size += len(chunk)
            if size > max_bytes:
                raise DataError(
                    "too-large",
                    f"expected a file of at most {max_bytes} bytes; got a larger one: ask the operator for a higher "
                    "limit",
                )
            digest.update(chunk)
            copy.write(chunk)
    return digest.hexdigest()


def safe_name(name: str, identity: str) -> str:
    """Make the name of a product's file from the name of its image and the product's identity.

    The name has only letters, digits, full stops, underscores and hyphens.
    """
    return f"{stem_of(name)}-{identity[:16]}.fits"


def stem_of(name: str) -> str:
    """The name of a file without its ending, made of letters, digits, full stops, underscores and hyphens."""
    return _NOT_IN_A_NAME.sub("_", FITS_ENDING.sub("", PurePath(name).name)).strip("._-")[:80] or "image"


def shown(path: PurePath) -> str:
    r"""A path as valid UTF-8 text. A byte that is not UTF-8 is written in the form \xff."""
    return str(path).encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def _split(glob: str) -> tuple[Path, tuple[str, ...]]:
    """Split a pattern: the folder before the first part with a wildcard, and the parts from that part on.

    Several consecutive ** become one, and a final ** becomes ** followed by *. Raises DataError "bad-path".
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
    top: Path, parts: tuple[str, ...], allowed: Sequence[Path], after: Position | None
) -> Iterator[Entry]:
    """Read each folder only once, and compare its entries with all parts of the pattern that can match at this depth.

    Several ** in a pattern therefore cost no additional time.
    """
    left = [(top, Position(), frozenset({0}))]
    while left:
        folder, names, indices = left.pop()
        if _is_after((*names, ""), after):
            yield Entry(folder, (*names, ""))
        # ** also matches no folder.
        indices |= {index + 1 for index in indices if parts[index] == ANY_FOLDERS}
        below: list[tuple[Path, Position, frozenset[int]]] = []
        for entry in _entries(folder):
            path, position = Path(entry.path), (*names, entry.name)
            meant, further, error = False, frozenset[int](), None
            try:
                meant, further = _meant(entry, parts, indices, allowed)
            except OSError as failed:
                message = (
                    f"expected a file or folder that can be inspected; the system says: {reason_of(failed)}"
                )
                error = DataError("unreadable-file", message)
            if _is_after(position, after):
                yield Entry(path, position, meant, error)
            if further and _leads_after(position, after):
                below.append((path, position, further))
        left += reversed(below)


def _is_after(position: Position, after: Position | None) -> bool:
    """Whether a search looks at a position later than at ``after``: folders come in the order of their names, and the
    entries of a folder come before those of its subfolders.
    """
    return after is None or (position[:-1], position[-1]) > (after[:-1], after[-1])


def _leads_after(folder: Position, after: Position | None) -> bool:
    """Whether the positions in a folder and below it are after ``after``, or some of them are."""
    return after is None or folder >= after[:-1] or folder == after[: len(folder)]


def _meant(
    entry: os.DirEntry[str], parts: tuple[str, ...], indices: frozenset[int], allowed: Sequence[Path]
) -> tuple[bool, frozenset[int]]:
    """Whether an entry is a matching file; and the parts of the pattern that may match entries inside it.

    The second result is empty if the entry is not a folder. Raises OSError if the entry cannot be inspected.
    """
    further = {index for index in indices if parts[index] == ANY_FOLDERS}
    if further and (entry.name.startswith(".") or not entry.is_dir(follow_symlinks=False)):
        further.clear()
    named = {n for n in indices if parts[n] != ANY_FOLDERS and _named(entry.name, parts[n])}
    if not named or not any(_resolved(Path(entry.path)).is_relative_to(root) for root in allowed):
        return False, frozenset(further)
    last = len(parts) - 1
    if named != {last} and entry.is_dir():
        further |= {index + 1 for index in named - {last}}
    return last in named and entry.is_file(), frozenset(further)


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            return sorted(entries, key=lambda entry: entry.name)
    except OSError as error:
        raise DataError(
            "unreadable-folder",
            f"expected a readable folder; got {shown(folder)}: {reason_of(error)}",
        ) from error


def _resolved(path: Path) -> Path:
    """The path with all links resolved. Raises OSError for circular links, which `Path.resolve` treats in its own way
    in each version of Python.
    """
    try:
        os.stat(path)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise
    return Path(os.path.realpath(path))


def reason_of(error: OSError) -> str:
    """The message of the operating system, without the path."""
    return error.strerror or type(error).__name__


def unreadable(error: OSError) -> DataError:
    """The error "unreadable-file" for a file that the operating system cannot read; it does not name the path."""
    return DataError("unreadable-file", f"expected a readable file; the system says: {reason_of(error)}")


def _named(name: str, pattern: str) -> bool:
    """Whether a name matches a pattern. A wildcard does not match the first full stop of a name."""
    return fnmatchcase(name, pattern) and (not name.startswith(".") or pattern.startswith("."))


def _met(value: str | float | bool | None, condition: Condition) -> bool:
    if value is None:
        return False
    if isinstance(condition, dict):
        return all(_compared(value, sign, other) for sign, other in condition.items())
    if isinstance(condition, list):
        return any(_same(value, other) for other in condition)
    return _same(value, condition)


def _same(value: object, other: object) -> bool:
    return isinstance(value, bool) == isinstance(other, bool) and bool(value == other)


def _compared(value: Any, sign: str, other: Any) -> bool:
    """Compare numbers with numbers, and texts with texts (ISO times are compared as texts).

    For a number and a text, and for True or False, only the condition != is met.
    """
    if isinstance(value, bool) or isinstance(value, str) != isinstance(other, str):
        return sign == "!="
    return bool(_SIGNS[sign](value, other))


# Files below allowed folders ------------------------------------------------------------------------


@contextmanager
def opened(path: Path, allowed: Sequence[Path]) -> Iterator[BinaryIO]:
    """Open a file below an allowed folder for reading.

    Raises DataError "path-not-allowed", "bad-path", or "unreadable-file" if it is not a regular file; and OSError.
    """
    resolved = check_under(path, allowed)
    with _folder(resolved.parent, allowed, make=False) as folder:
        handle = os.open(resolved.name, _FILE, dir_fd=folder)
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise DataError("unreadable-file", "expected a regular file; got a folder, pipe or device")
    with open(handle, "rb") as file:
        yield file


def reopened(file: BinaryIO) -> Path:
    """A path that leads to the opened file itself, for functions that read a file by its path."""
    return Path(f"/dev/fd/{file.fileno()}")


def make_folder(folder: Path, allowed: Sequence[Path]) -> None:
    """Make a folder below an allowed one, and check that files can be written into it.

    Raises the same DataErrors as ``opened``, and OSError.
    """
    with _folder(folder, allowed, make=True) as handle:
        if not os.access(".", os.W_OK | os.X_OK, dir_fd=handle):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


def put(source: Path, target: Path, allowed: Sequence[Path], *, replace: bool = True) -> None:
    """Copy a file to a path below an allowed folder in one step: a reader sees either the whole file or no file.

    Parameters
    ----------
    replace
        Whether an existing file is replaced.

    Raises
    ------
    DataError
        The same errors as ``opened``.
    FileExistsError
        There is a file that must not be replaced, even if another process writes it at the same moment.
    OSError
        Another error of the file system.
    """
    with source.open("rb") as file, _folder(target.parent, allowed, make=True) as folder:
        partial = f".{target.name}.{uuid.uuid4().hex}{PARTIAL}"
        try:
            with open(os.open(partial, _NEW_FILE, 0o666, dir_fd=folder), "wb") as copy:
                open_file(copy)
                shutil.copyfileobj(file, copy, _CHUNK)
                copy.flush()
                os.fsync(copy.fileno())
            if replace:
                os.replace(partial, target.name, src_dir_fd=folder, dst_dir_fd=folder)
            else:
                # A link fails if the name exists; a rename would replace the file.
                os.link(partial, target.name, src_dir_fd=folder, dst_dir_fd=folder, follow_symlinks=False)
                _remove(partial, folder)
        except BaseException:
            _remove(partial, folder)
            raise
        os.fsync(folder)  # the folder entry must also be on the disk before the file counts as written


def remove_partials(target: Path, allowed: Sequence[Path]) -> None:
    """Remove the partial copies of a file that a killed process left.

    Raises the same DataErrors as ``opened``, and OSError.
    """
    with _folder(target.parent, allowed, make=False) as folder:
        for name in os.listdir(folder):
            if name.startswith(f".{target.name}.") and fnmatchcase(name, f"*{PARTIAL}"):
                _remove(name, folder)


@contextmanager
def _folder(folder: Path, allowed: Sequence[Path], *, make: bool) -> Iterator[int]:
    """Open a folder below an allowed one, part by part and without following links. With ``make``, missing parts are
    made.
    """
    resolved = check_under(folder, allowed)
    root = next(one for one in allowed if resolved.is_relative_to(one))
    if make:
        open_folder(root)
    handle = os.open(root, _FOLDER)
    try:
        for part in resolved.relative_to(root).parts:
            if make:
                _make(part, handle)
            below = os.open(part, _FOLDER, dir_fd=handle)
            os.close(handle)
            handle = below
        yield handle
    finally:
        os.close(handle)


def _make(name: str, folder: int) -> None:
    with suppress(FileExistsError):
        os.mkdir(name, dir_fd=folder)
        open_made_folder(name, folder)


def _remove(name: str, folder: int) -> None:
    with suppress(FileNotFoundError):
        os.unlink(name, dir_fd=folder)
