"""Open and write files safely below allowed folders, even if somebody changes a link after a path was checked.

First the links in a path are resolved and the path is checked (``workers.files.archive.check_under``). Then the path is
opened part by part, from the allowed folder downwards, and no part may be a link. If somebody replaces a part by a link
after the check, the operating system refuses to open it. A file is written and renamed inside the opened folder, not by
its path.
"""

from __future__ import annotations

import errno
import os
import shutil
import stat
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from typing import BinaryIO

from psfcore.errors import DataError
from psfcore.whole_files import PARTIAL
from workers.files.archive import check_under
from workers.files.modes import open_file, open_folder, open_made_folder

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
# O_NONBLOCK: without this flag, opening a pipe would wait until another process opens the other end of the pipe.
_FILE = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_NEW_FILE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_CHUNK = 2**20


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

    replace: whether an existing file is replaced. Raises the same DataErrors as ``opened``, and OSError; FileExistsError if
    there is a file that must not be replaced, even if another process writes it at the same moment.
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
    """Open a folder below an allowed one, part by part and without following links. make: make the missing parts."""
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
    try:
        os.mkdir(name, dir_fd=folder)
        open_made_folder(name, folder)
    except FileExistsError:
        return


def _remove(name: str, folder: int) -> None:
    try:
        os.unlink(name, dir_fd=folder)
    except FileNotFoundError:
        return
