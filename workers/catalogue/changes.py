"""What changed since: the jobs and bulk runs of an owner, as streams of events read them.

Each write to a row of these tables sets ``changed_at``, except those that no reader can see, such as a heartbeat. The
value only grows, and two states of a row never have the same.

A stream makes these queries every half second. Therefore they read times and ids by an index that begins with the
owner, and at most ``MOST`` rows where nothing else bounds their number. Complete rows are read only after a change.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Generic, TypeVar

from sqlalchemy import ColumnElement, Select, select, true, tuple_
from sqlalchemy.orm import InstrumentedAttribute

from workers.catalogue.database import Database
from workers.catalogue.tables import BulkRow, JobRow
from workers.contract.bulk import OPEN
from workers.contract.jobs import Phase
from workers.contract.kinds import KINDS

MOST = 300

Row = TypeVar("Row", bound=JobRow | BulkRow)
Moment = tuple[float, str]  # when a row changed last, s since 1970, and its id


class Changes(Generic[Row]):
    """The changes of the rows of one table; each method is one transaction."""

    def __init__(
        self,
        database: Database,
        table: type[Row],
        phases: Collection[str],
        *order: InstrumentedAttribute[str],
        only: ColumnElement[bool] | None = None,
    ) -> None:
        """Find the changes of the rows of ``table``.

        Parameters
        ----------
        phases
            The phases of rows that have not ended.
        *order
            The columns by which rows that have not ended are sorted first; rows that are equal there come newest first.
        only
            A condition on the rows that ``open`` and ``since`` find; None: all rows.
        """
        self._database, self._order = database, order
        self._table: type[Row] = table
        self._only = true() if only is None else only
        self._open = table.phase.in_(sorted(phases))

    def since(self, owner: str, after: Moment) -> Sequence[Moment]:
        """The next ``MOST`` rows that changed after a row, in the order of their last changes."""
        changed = (self._table.changed_at, self._table.id)
        later = self._moments(owner).where(tuple_(*changed) > after, self._only)
        return self._database.lines(later.order_by(*changed).limit(MOST))

    def open(self, owner: str) -> Sequence[Moment]:
        """The newest ``MOST`` rows that have not ended."""
        query = self._moments(owner).where(self._open, self._only)
        newest = query.order_by(*self._order, self._table.created_at.desc(), self._table.id.desc())
        return self._database.lines(newest.limit(MOST))

    def among(self, owner: str, ids: Collection[str]) -> Sequence[Moment]:
        """The rows with these ids, in any phase; unknown ids are left out."""
        query = self._moments(owner).where(self._table.id.in_(sorted(ids)))
        return self._database.lines(query) if ids else []

    def rows(self, ids: Collection[str]) -> Sequence[Row]:
        """The complete rows with these ids; unknown ids are left out."""
        return self._database.all(select(self._table).where(self._table.id.in_(sorted(ids)))) if ids else []

    def _moments(self, owner: str) -> Select[float, str]:
        return select(self._table.changed_at, self._table.id).where(self._table.owner == owner)


def changes_of_jobs(database: Database) -> Changes[JobRow]:
    """The jobs that clients submitted. The turns of bulk runs do not belong to them, nor UWS jobs before their
    start.
    """
    submitted = sorted(name for name, kind in KINDS.items() if kind.parameters is not None)
    only = JobRow.kind.in_(submitted) & (JobRow.phase != Phase.PENDING)
    # EXECUTING comes before QUEUED, of which there may be very many.
    return Changes(database, JobRow, (Phase.EXECUTING, Phase.QUEUED), JobRow.phase, only=only)


def changes_of_bulks(database: Database) -> Changes[BulkRow]:
    """The bulk runs. Paused and failed ones are open too, because they can be resumed."""
    return Changes(database, BulkRow, OPEN)
