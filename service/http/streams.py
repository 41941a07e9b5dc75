"""Answers that stay open: how many each caller may have at a time."""

from __future__ import annotations

import threading
from collections import Counter

from service.http.problems import Problem


class Streams:
    """How many streams each caller has open in this process, and no more than so many."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._open: Counter[str] = Counter()
        self._lock = threading.Lock()

    def open(self, who: str) -> None:
        """Count one more; ``Problem`` 429 where there are too many."""
        with self._lock:
            if self._open[who] >= self._most:
                raise Problem(
                    429,
                    "too-many-streams",
                    f"expected at most {self._most} streams of events at a time; close one",
                )
            self._open[who] += 1

    def close(self, who: str) -> None:
        """Count one less."""
        with self._lock:
            self._open[who] -= 1
            if not self._open[who]:
                del self._open[who]
