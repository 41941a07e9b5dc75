"""Tells a worker's processes that it has to stop, and when it must hand back its job."""

from __future__ import annotations

import time
from multiprocessing.sharedctypes import RawValue


class Stopping:
    """The stop flag, shared with child processes that are forked later: the parent gets the signal, and a child runs the job.

    The flag is one number in shared memory. The flag has no lock, because a signal handler writes it.
    """

    def __init__(self) -> None:
        self._let_go_at = RawValue(
            "d", 0.0
        )  # the deadline, as a time of time.monotonic(), a clock that all processes share; 0: the worker need not stop

    def ask(self, within_s: float) -> None:
        """Tell the worker to take no more jobs, and to hand back the running job after ``within_s`` seconds.

        If the worker was already told, the call changes nothing.
        """
        if not self.asked:
            self._let_go_at.value = time.monotonic() + within_s

    @property
    def asked(self) -> bool:
        """True after the worker was told to stop."""
        return bool(self._let_go_at.value)

    @property
    def due(self) -> bool:
        """True when the running job must be handed back."""
        return self.asked and time.monotonic() >= self._let_go_at.value
