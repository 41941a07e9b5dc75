"""Imports all tasks in the process of a worker, and the libraries that tasks load when they need them."""

from __future__ import annotations

from importlib import import_module

from workers.contract.kinds import KINDS

LATE = ("psfcore.build", "psfcore.drawing.plots")


def load_tasks() -> None:
    """Import every task, so that the first job of each kind does not wait for its libraries."""
    for kind in KINDS.values():
        kind.load_task()
    for name in LATE:
        import_module(name)
