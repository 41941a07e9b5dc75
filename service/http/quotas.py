"""Checks the storage quota of an owner before an upload is received, and before a job is accepted.

The declared lengths of the owner's open resumable uploads count as used.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

from service.http.callers import Caller
from service.http.problems import Problem
from service.http.rates import Bucket
from service.http.state import State
from workers import checks
from workers.catalogue.catalogue import Row
from workers.catalogue.quotas import MIB, NOT_KEPT, OverQuota, Usage
from workers.files.partial_uploads import PartialUploads
from workers.files.store import STORAGE_FULL


class Allowed:
    """Counts the bytes of one upload against the caller's rate and against the owner's quota.

    Parameters
    ----------
    upload_id
        The id of the resumable upload that the bytes belong to; its declared length does not count as used. None: the
        upload is not resumable.
    """

    def __init__(self, state: State, caller: Caller, upload_id: str | None = None) -> None:
        self._state, self._caller, self._upload_id = state, caller, upload_id
        self._bytes = 0
        self._usage: Usage | None = None

    def __call__(self, count: int) -> None:
        """Count further bytes. Raises ``Problem`` 429 if they exceed the rate limit, and 413 if they exceed the quota.

        The other files of the owner are added up once, at the first bytes; ``keep`` adds them up again.
        """
        if not self._bytes:
            self._usage = _limited(self._state, self._caller.owner, self._upload_id)
        self._bytes += count
        _check_file(self._state, self._usage, self._bytes)
        self._state.rates.take(Bucket.UPLOADS, self._caller.account, math.ceil(count / MIB))

    def keep(self, file: Path, digest: str, row: Row) -> tuple[Row, bool]:
        """Store the uploaded file, and add its row to the catalogue; returns the row, and whether it is new.

        If the row cannot be added, the file is removed again. Raises ``Problem`` 413 if other uploads have filled the
        quota in the meantime.
        """
        with self._state.store.kept_if(file, digest):
            try:
                return self._state.catalogue.add(row, self._state.settings.quota_mib)
            except OverQuota as over:
                raise _file_too_large(over.usage, row.bytes) from over


def check_length(state: State, caller: Caller, count: int) -> None:
    """Raise ``Problem`` 413 if a file of this many bytes exceeds the owner's quota, and 507 if the disk has no room for
    it.
    """
    _check_file(state, _limited(state, caller.owner), count)


def _check_file(state: State, usage: Usage | None, count: int) -> None:
    check_disk(state, count)
    if usage is not None and not usage.allows(count):
        raise _file_too_large(usage, count)


def check_disk(state: State, more_bytes: int = 0) -> None:
    """Raise ``Problem`` 507 if, after ``more_bytes`` more bytes, the data folder's disk would have less free space
    than the setting requires.
    """
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
    usage = _limited(state, owner)
    if usage is not None and usage.full:
        raise _exceeded(507, usage, usage.no_room(NOT_KEPT))


def _limited(state: State, owner: str, but: str | None = None) -> Usage | None:
    """The usage of an owner who has a limit, with the open uploads except ``but``; None if there is no limit."""
    usage = state.catalogue.quotas.limited(owner, state.settings.quota_mib)
    if usage is None:
        return None
    open_bytes = PartialUploads(state.settings.data_dir).declared_bytes(owner, but)
    return replace(usage, used_bytes=usage.used_bytes + open_bytes)


def _file_too_large(usage: Usage, count: int) -> Problem:
    message = usage.no_room(f"this file needs at least {count / MIB:.1f} MiB more")
    return _exceeded(413, usage, message, needed_bytes=count)


def _exceeded(status: int, usage: Usage, message: str, **more: object) -> Problem:
    used, limit = usage.used_bytes, usage.limit_bytes
    return Problem(
        status, "quota-exceeded", message, headers=None, used_bytes=used, limit_bytes=limit, **more
    )
