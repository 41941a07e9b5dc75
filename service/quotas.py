"""How much an owner may have kept: refused before it is sent, or before it is worked on."""

from __future__ import annotations

from service.callers import Caller
from service.problems import Problem
from service.state import State
from workers.owner_rows import MIB, Usage


class Allowed:
    """Counts the bytes of one upload against the caller's rate and against the owner's quota."""

    def __init__(self, state: State, caller: Caller) -> None:
        self._state, self._caller = state, caller
        self._asked = 0

    def __call__(self, count: int) -> None:
        """So many bytes more; ``Problem`` 429 or 413."""
        self._asked += count
        usage = _usage(self._state, self._caller.owner)
        if not usage.allows(self._asked):
            raise _exceeded(413, usage, f"this file needs at least {self._asked} more")
        self._state.rates.take_bytes(self._caller.name, count)


def check_room(state: State, owner: str) -> None:
    """Before work whose results are kept: ``Problem`` 507 where the owner may keep nothing more."""
    usage = _usage(state, owner)
    if usage.full:
        raise _exceeded(507, usage, "what this makes could not be kept")


def _usage(state: State, owner: str) -> Usage:
    return state.catalogue.owners.usage(owner, state.settings.quota_mib)


def _exceeded(status: int, usage: Usage, why: str) -> Problem:
    assert usage.limit_bytes is not None
    return Problem(
        status,
        "quota-exceeded",
        f"expected room for it: {usage.used_bytes / MIB:.1f} of {usage.limit_bytes / MIB:.1f} MiB are used, and {why} "
        "(the operator sets quotas)",
        used_bytes=usage.used_bytes,
        limit_bytes=usage.limit_bytes,
    )
