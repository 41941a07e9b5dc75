"""Measures the time of the stages that a job reports while it runs.

A report of step n > 0 means that the job has worked on this stage since the previous report: the time between the two
reports counts for this stage. A report of step 0 means that a stage begins: the time since the previous report counts
for the previous stage. The time that reporting itself takes, such as writing the progress to the database, counts for
no stage.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Lock

STARTING = "starting"  # the stage before the first report
# The number of stages of one attempt is limited, because the names of an operator's own effects may be stages too.
# The time of further stages counts for OTHERS.
MOST_STAGES, OTHERS = 64, "others"
MOST_LETTERS = 64  # longest name of a stage
_NUMBER = re.compile(r"[+-]?\d+(\.\d+)?")


@dataclass
class StageTime:
    """Seconds spent in a stage, and the number of steps reported."""

    seconds: float = 0.0
    steps: int = 0


@dataclass
class StageTimer:
    """The stages of one attempt of a job.

    A report made during another report, in the same thread or in another one, is ignored.
    """

    spent: dict[str, StageTime] = field(default_factory=dict)
    _stage: str = STARTING
    _since: float = field(default_factory=time.perf_counter)
    _last: tuple[str, int] = ("", 0)
    _reporting: Lock = field(default_factory=Lock)

    @contextmanager
    def step(self, stage: str, step: int) -> Iterator[None]:
        """Count the work before a reported step. The time spent in the ``with`` block itself is not counted."""
        if not self._reporting.acquire(blocking=False):
            yield
            return
        try:
            name = short(stage)
            self._add(name if step > 0 else self._stage)
            if step > 0 and (stage, step) != self._last:
                self._of(name).steps += 1
            self._stage, self._last = name, (stage, step)
            yield
        finally:
            self._since = time.perf_counter()
            self._reporting.release()

    def begin(self, stage: str) -> None:
        """Begin a stage: the time from now on counts for this stage, until another stage is reported."""
        with self.step(stage, 0):
            pass

    def end(self) -> Mapping[str, StageTime]:
        """The times of all stages, including the time since the last report."""
        self._add(self._stage)
        self._since = time.perf_counter()
        return self.spent

    def _add(self, name: str) -> None:
        self._of(name).seconds += time.perf_counter() - self._since

    def _of(self, name: str) -> StageTime:
        known = name in self.spent or len(self.spent) < MOST_STAGES
        return self.spent.setdefault(name if known else OTHERS, StageTime())


def short(stage: str) -> str:
    """A stage's name without its variable parts: cut at the first colon, numbers replaced by n.

    "fold 3: errors" becomes "fold n".
    """
    return _NUMBER.sub("n", stage.partition(":")[0].strip())[:MOST_LETTERS]
