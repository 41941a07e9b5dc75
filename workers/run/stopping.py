"""When a worker that was told to stop must let go of its job."""

from __future__ import annotations

import time
from multiprocessing.sharedctypes import RawValue


class Stopping:
    """Shared with children that are forked later: the parent gets the signal, a child has the job.

    One number in shared memory, without a lock: it is written from a signal's handler.
    """

    def __init__(self) -> None:
        self._let_go_at = RawValue(
            "d", 0.0
        )  # time.monotonic(), which is the same in all processes; 0: not asked

    def ask(self, within_s: float) -> None:
        """Take no more jobs, and let go of the one at work after ``within_s``. Asking again changes nothing."""
        if not self.asked:
            self._let_go_at.value = time.monotonic() + within_s

    @property
    def asked(self) -> bool:
        """True once the worker was told to stop."""
        return bool(self._let_go_at.value)

    @property
    def due(self) -> bool:
        """True once a job that still runs is to be handed back."""
        return self.asked and time.monotonic() >= self._let_go_at.value
