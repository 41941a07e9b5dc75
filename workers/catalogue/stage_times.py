"""How long jobs spend in each stage that they report: summed while an attempt lasts, kept in the catalogue after it.

A report of step n > 0 says that work on the stage was done since the report before, so the seconds between are that
stage's; one of step 0 says that the stage begins, and the seconds before it are those of the stage that went before.
What reporting itself takes, as writing how far a job is, counts for none.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from threading import Lock

from sqlalchemy import select
from sqlalchemy.dialects import postgresql, sqlite

from workers.catalogue.database import Database
from workers.catalogue.tables import StageTimeRow

STARTING = "starting"  # before the first report: looking up what there is
MOST_STAGES, OTHERS = 64, "others"  # of one attempt: names may hold what an operator's own effects are called
MOST_LETTERS = 64
_NUMBER = re.compile(r"[+-]?\d+(\.\d+)?")


@dataclass
class Spent:
    """Work on a stage: seconds, and how many steps were reported."""

    seconds: float = 0.0
    steps: int = 0


@dataclass
class StageTimes:
    """The stages of one attempt. Reports within a report, and those of several threads at once, count once."""

    spent: dict[str, Spent] = field(default_factory=dict)
    _stage: str = STARTING
    _since: float = field(default_factory=time.perf_counter)
    _last: tuple[str, int] = ("", 0)
    _reporting: Lock = field(default_factory=Lock)

    @contextmanager
    def step(self, stage: str, step: int) -> Iterator[None]:
        """While a step is reported: counts the work before it, and not what is done in the block."""
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
        """From now on work is this stage's, until another is reported."""
        with self.step(stage, 0):
            pass

    def end(self) -> Mapping[str, Spent]:
        """All stages, with what was done since the last report."""
        self._add(self._stage)
        self._since = time.perf_counter()
        return self.spent

    def _add(self, name: str) -> None:
        self._of(name).seconds += time.perf_counter() - self._since

    def _of(self, name: str) -> Spent:
        known = name in self.spent or len(self.spent) < MOST_STAGES
        return self.spent.setdefault(name if known else OTHERS, Spent())


def short(stage: str) -> str:
    """A stage's name without what varies: up to its first colon, numbers as n ("fold 3: errors" is "fold n")."""
    return _NUMBER.sub("n", stage.partition(":")[0].strip())[:MOST_LETTERS]


class KeptStageTimes:
    """The table of stages; each method is one transaction."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def add(self, kind: str, spent: Mapping[str, Spent]) -> None:
        """Add what an attempt of a job of this kind spent."""
        insert = sqlite.insert if self._database.sqlite else postgresql.insert
        # In one order, so that no two attempts wait for each other.
        rows = [
            {"kind": kind, "stage": stage, "seconds": one.seconds, "steps": one.steps}
            for stage, one in sorted(spent.items())
        ]
        if not rows:
            return
        new = insert(StageTimeRow).values(rows)
        sums = {
            "seconds": StageTimeRow.seconds + new.excluded.seconds,
            "steps": StageTimeRow.steps + new.excluded.steps,
        }
        with self._database.writing.begin() as session:
            session.execute(new.on_conflict_do_update(index_elements=["kind", "stage"], set_=sums))

    def all(self) -> dict[tuple[str, str], Spent]:
        """What was spent in all, by kind of job and stage."""
        query = select(StageTimeRow).order_by(StageTimeRow.kind, StageTimeRow.stage)
        with self._database.reading() as session:
            return {(row.kind, row.stage): Spent(row.seconds, row.steps) for row in session.scalars(query)}
