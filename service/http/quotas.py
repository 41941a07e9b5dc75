"""Checks the storage quota of an owner before an upload is received, before a job is accepted, and when rows are added."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from service.http.callers import Caller
from service.http.problems import Problem
from service.http.state import State
from workers import checks
from workers.catalogue.catalogue import Row
from workers.catalogue.owners import MIB, NOT_KEPT, ROWS_NOT_KEPT, OverQuota, Usage, counted_bytes
from workers.files.full_disk import STORAGE_FULL


class Allowed:
    """Counts the bytes of one upload against the caller's rate and against the owner's quota."""

    def __init__(self, state: State, caller: Caller) -> None:
        self._state, self._caller = state, caller
        self._asked = 0

    def __call__(self, count: int) -> None:
        """Count further bytes. Raises ``Problem`` 429 if they exceed the rate limit, and 413 if they exceed the quota."""
        self._asked += count
        check_disk(self._state, self._asked)
        usage = _usage(self._state, self._caller.owner)
        if not usage.allows(self._asked):
            raise _file_too_large(usage, self._asked)
        self._state.rates.take_bytes(self._caller.name, count)

    def keep(self, file: Path, digest: str, row: Row) -> tuple[Row, bool]:
        """Store the uploaded file, and add its row to the catalogue; returns the row, and whether it is new.

        If the row cannot be added, the file is removed again. Raises ``Problem`` 413 if other uploads have filled the
        quota in the meantime.
        """
        with self._state.store.kept_if(file, digest):
            try:
                return self._state.catalogue.add(row, self._state.settings.quota_mib)
            except OverQuota as over:
                raise _file_too_large(over.usage, counted_bytes(row)) from over


def check_length(state: State, caller: Caller, count: int) -> None:
    """Raise ``Problem`` 413 if a file of this many bytes exceeds the owner's quota, and 507 if the disk has no room for it."""
    check_disk(state, count)
    usage = _usage(state, caller.owner)
    if not usage.allows(count):
        raise _file_too_large(usage, count)


def check_disk(state: State, more_bytes: int = 0) -> None:
    """Raise ``Problem`` 507 if, after ``more_bytes`` more bytes, the data folder's disk would have less free space
    than the setting requires."""
    free = checks.free_bytes(state.settings.data_dir)
    least = state.settings.min_free_mib * MIB
    if free - more_bytes < least:
        raise Problem(
            507,
            STORAGE_FULL,
            f"expected {least / MIB:.0f} MiB of free disk space after this request (HELIOPSF_MIN_FREE_MIB); "
            f"{max(0, free - more_bytes) / MIB:.0f} MiB would be left: ask the operator to make room, then try again",
        )


def check_room(state: State, owner: str) -> None:
    """Raise ``Problem`` 507 if the owner's quota or the disk is full, because no result could be stored."""
    check_disk(state)
    usage = _usage(state, owner)
    if usage.full:
        raise _exceeded(507, usage, NOT_KEPT)


@contextmanager
def rows_held() -> Iterator[None]:
    """Raise ``Problem`` 507 if the rows that the block adds do not fit into the owner's quota."""
    try:
        yield
    except OverQuota as over:
        raise _exceeded(507, over.usage, ROWS_NOT_KEPT) from over


def _usage(state: State, owner: str) -> Usage:
    return state.catalogue.owners.usage(owner, state.settings.quota_mib)


def _file_too_large(usage: Usage, count: int) -> Problem:
    return _exceeded(413, usage, f"this file needs at least {count} more")


def _exceeded(status: int, usage: Usage, why: str) -> Problem:
    return Problem(
        status,
        "quota-exceeded",
        usage.no_room(why),
        used_bytes=usage.used_bytes,
        limit_bytes=usage.limit_bytes,
    )
