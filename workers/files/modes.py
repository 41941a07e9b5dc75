"""Permissions of files. Only the user of the service can read the data folder; output folders follow the operator's
umask.

The data folder contains the files of all owners and the hashes of their keys. A user of the machine who has no key must
not be able to read these files from the disk.
"""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import BinaryIO

log = logging.getLogger(__name__)
OTHERS = 0o077  # the permissions of the group and of all other users
_operators_umask: int | None = None  # set once, when the process becomes private


def keep_private() -> None:
    """Set the umask so that only the user of this process can read the files and folders that the process makes.

    Commands that work with the data folder call this function first. The umask also applies to files that libraries
    make.
    """
    global _operators_umask
    before = os.umask(OTHERS)
    if _operators_umask is None:
        _operators_umask = before


def private_folder(folder: Path) -> None:
    """Make a folder that only its user can read. If it exists and belongs to this user, other users lose their access.

    Raises OSError if the folder cannot be made.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    found = folder.stat()
    if not found.st_mode & OTHERS:
        return
    if found.st_uid != os.geteuid():
        log.warning(
            "expected the data folder %s to be closed to other users; it has mode %o and belongs to another user, so "
            "this process cannot change it: run chmod 700 on it",
            folder,
            found.st_mode & 0o777,
        )
        return
    folder.chmod(found.st_mode & 0o700)
    log.info("closed the data folder %s to other users (mode 700)", folder)


def _opened_mode(mode: int) -> int:
    """``mode`` without the permissions that the operator's umask removes."""
    return mode if _operators_umask is None else mode & ~_operators_umask


def open_folder(folder: Path) -> None:
    """Make a folder, and its parents, with the permissions that the operator's umask gives. Raises OSError."""
    missing = [one for one in (folder, *folder.parents) if not one.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    if _operators_umask is not None:
        for one in missing:
            one.chmod(_opened_mode(0o777))


def open_file(file: BinaryIO) -> None:
    """Give a file that is being written the permissions that the operator's umask gives. Raises OSError."""
    if _operators_umask is not None:
        os.fchmod(file.fileno(), _opened_mode(0o666))


def open_made_folder(name: str, parent: int) -> None:
    """Give a folder that was just made in an opened folder the permissions that the operator's umask gives. Raises
    OSError.
    """
    if _operators_umask is not None:
        os.chmod(name, _opened_mode(0o777), dir_fd=parent)
