"""What a task may use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from psfcore.header import FitsLimits
from workers.catalogue import Catalogue
from workers.settings import Settings
from workers.store import Store


@dataclass(frozen=True)
class Context:
    """Where things are, and how to say how far the work is; ``report`` raises where it should stop.

    ``call_for_help(n)`` asks up to n idle workers to share the job's parts.
    """

    catalogue: Catalogue
    store: Store
    settings: Settings
    owner: str
    job_id: str
    report: Callable[[str, int, int], None]
    call_for_help: Callable[[int], None] = lambda workers: None

    @property
    def limits(self) -> FitsLimits:
        """Limits of the files that are opened."""
        return FitsLimits(max_pixels=self.settings.max_pixels)
