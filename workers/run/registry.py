"""Imports all tasks in the process of a worker."""

from __future__ import annotations

from workers.contract.kinds import KINDS


def load_tasks() -> None:
    """Import every task, so that the first job of each kind does not wait for its libraries."""
    for kind in KINDS.values():
        kind.load_task()
