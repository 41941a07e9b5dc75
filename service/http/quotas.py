"""Checks the storage quota of an owner before an upload is received and before a job is accepted."""

from __future__ import annotations

from service.http.callers import Caller
from service.http.problems import Problem
from service.http.state import State
from workers.catalogue.catalogue import Row
from workers.catalogue.owners import NOT_KEPT, OverQuota, Usage
from workers.catalogue.tables import PsfRow
from workers.files.collection import remove_unnamed


class Allowed:
    """Counts the bytes of one upload against the caller's rate and against the owner's quota."""

    def __init__(self, state: State, caller: Caller) -> None:
        self._state, self._caller = state, caller
        self._asked = 0

    def __call__(self, count: int) -> None:
        """Count further bytes. Raises ``Problem`` 429 if they exceed the rate limit, and 413 if they exceed the quota."""
        self._asked += count
        usage = _usage(self._state, self._caller.owner)
        if not usage.allows(self._asked):
            raise _file_too_large(usage, self._asked)
        self._state.rates.take_bytes(self._caller.name, count)

    def add(self, row: Row) -> tuple[Row, bool]:
        """Add the row of the upload to the catalogue. Raises ``Problem`` 413 if other uploads have filled the quota meanwhile."""
        try:
            return self._state.catalogue.add(row, self._state.settings.quota_mib)
        except OverQuota as over:
            # Nothing stays of a refused upload: its file was stored before its row.
            digest = row.file_sha256 if isinstance(row, PsfRow) else row.id
            remove_unnamed(self._state.catalogue, self._state.store, [digest])
            raise _file_too_large(over.usage, row.bytes) from over


def check_room(state: State, owner: str) -> None:
    """Raise ``Problem`` 507 if the owner's quota is full, because no result could be stored."""
    usage = _usage(state, owner)
    if usage.full:
        raise _exceeded(507, usage, NOT_KEPT)


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
