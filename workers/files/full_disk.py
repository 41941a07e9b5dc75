"""Recognises errors that say that the disk of the files or of the database is full."""

from __future__ import annotations

import errno

from sqlalchemy.exc import SQLAlchemyError

STORAGE_FULL = "storage-full"  # the code of such an error
NO_ROOM = "expected free space on the disk of the service; the disk is full: ask the operator to make room, then try again"
_FULL = frozenset({errno.ENOSPC, errno.EDQUOT})


def is_disk_full(error: BaseException) -> bool:
    """Whether an exception says that a disk is full, or that a quota of the file system is used up.

    While a library handles the OSError of the system, it may raise another OSError; the error of the system is then the
    context of the new error. Databases have codes of their own: SQLITE_FULL of SQLite, 53100 of PostgreSQL.
    """
    if isinstance(error, SQLAlchemyError):
        original = getattr(error, "orig", None)
        return (
            getattr(original, "sqlite_errorname", None) == "SQLITE_FULL"
            or getattr(original, "sqlstate", None) == "53100"
        )
    cause: BaseException | None = error
    while isinstance(cause, OSError):
        if cause.errno in _FULL:
            return True
        cause = cause.__cause__ or cause.__context__
    return False
