"""The queries with which streams of events find changed jobs and bulk runs of an owner.

A stream makes these queries every half second. Therefore no query reads more than ``MOST`` rows, and every query uses
an index that begins with the owner. A query reads only the few columns that show whether a row has changed. The whole
row is read only after a change.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from sqlalchemy import ColumnElement, select, tuple_

from workers.catalogue.database import Database
from workers.catalogue.tables import BulkRow, JobRow
from workers.contract.bulk import OPEN
from workers.contract.jobs import Phase
from workers.contract.kinds import KINDS

MOST = 300

Followable = TypeVar("Followable", bound=JobRow | BulkRow)


@dataclass(frozen=True)
class State:
    """The state of a row.

    A row has changed if its state is not equal to the earlier state. ended_at: None if the row has not ended.
    """

    id: str
    ended_at: float | None
    values: tuple[Any, ...]


@dataclass(frozen=True)
class Place:
    """A place in the order in which an owner's rows ended: after the row ``id`` that ended at ``at`` (s since 1970)."""

    at: float
    id: str = ""


class Followed(Generic[Followable]):
    """The rows of a table, as streams of events need them; each method is one transaction."""

    def __init__(
        self,
        database: Database,
        table: type[Followable],
        *,
        columns: Sequence[str],
        open_phases: Sequence[Collection[str]],
        only: ColumnElement[bool] | None = None,
    ) -> None:
        """columns: the columns whose values form the state. open_phases: groups of phases; the newest ``MOST`` rows of
        each group are followed.

        only: a condition on the rows; None: all rows.
        """
        self._database, self._names = database, tuple(columns)
        self._table: type[Followable] = table
        self._columns = [table.id, table.ended_at, *(getattr(table, name) for name in columns)]
        self._open_phases = [sorted(group) for group in open_phases]
        self._conditions = [] if only is None else [only]

    def now(self) -> float:
        """The time of the database's clock, s since 1970."""
        return self._database.clock()

    def open(self, owner: str) -> list[State]:
        """Rows that have not ended: the newest ``MOST`` rows of each group of phases, newest first."""
        table, states = self._table, []
        with self._database.reading() as session:
            for group in self._open_phases:
                phase = table.phase == group[0] if len(group) == 1 else table.phase.in_(group)
                query = select(*self._columns).where(table.owner == owner, phase, *self._conditions)
                newest = query.order_by(table.created_at.desc(), table.id.desc()).limit(MOST)
                states += _states(session.execute(newest))
        return states

    def ended(self, owner: str, after: Place) -> list[State]:
        """The next ``MOST`` rows that ended after a place, in the order in which they ended."""
        table = self._table
        later = tuple_(table.ended_at, table.id) > (after.at, after.id)
        query = select(*self._columns).where(table.owner == owner, later, *self._conditions)
        return _states(self._database.lines(query.order_by(table.ended_at, table.id).limit(MOST)))

    def among(self, owner: str, ids: Collection[str]) -> list[State]:
        """The states of the rows with these ids, in any phase; unknown ids are left out. Pass only a few ids."""
        if not ids:
            return []
        return _states(self._database.lines(select(*self._columns).where(self._these(owner, ids))))

    def rows(self, owner: str, ids: Collection[str]) -> dict[str, tuple[State, Followable]]:
        """For each id that the owner has: the state of the row and the complete row. Pass only a few ids."""
        if not ids:
            return {}
        rows = self._database.all(select(self._table).where(self._these(owner, ids)))
        return {row.id: (self.state(row), row) for row in rows}

    def named(self, ids: Collection[str]) -> dict[str, Followable]:
        """The rows with these ids, of any owner and kind; unknown ids are left out. Pass only a few ids."""
        return {row.id: row for row in self._database.all(select(self._table).where(self._table.id.in_(ids)))}

    def _these(self, owner: str, ids: Collection[str]) -> ColumnElement[bool]:
        given = self._table.id.in_(sorted(ids)) & (self._table.owner == owner)
        for condition in self._conditions:
            given &= condition
        return given

    def state(self, row: Followable) -> State:
        """The state of a row that was read."""
        return State(row.id, row.ended_at, tuple(getattr(row, name) for name in self._names))


def followed_jobs(database: Database) -> Followed[JobRow]:
    """The jobs of the job kinds that clients can submit. The turns of bulk runs do not belong to them."""
    submitted = sorted(name for name, kind in KINDS.items() if kind.parameters is not None)
    return Followed(
        database,
        JobRow,
        columns=("phase", "attempt", "stage", "step", "steps", "cancel_requested", "queue"),
        open_phases=({Phase.EXECUTING}, {Phase.QUEUED}),
        only=JobRow.kind.in_(submitted),
    )


def followed_bulks(database: Database) -> Followed[BulkRow]:
    """The bulk runs. Paused and failed ones are open too, because they can be resumed."""
    return Followed(database, BulkRow, columns=("phase", "total", "done", "failed"), open_phases=(OPEN,))


def _states(rows: Iterable[Any]) -> list[State]:
    return [State(row_id, ended_at, tuple(values)) for row_id, ended_at, *values in rows]
