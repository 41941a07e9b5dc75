"""The number of bytes that each owner keeps, and the owner's quota.

The files of the owner's uploads, PSFs, products, reports and kept solutions count; their pictures do not. The database
rows count too, because a small file takes less room than its row. Rows without files also count: jobs, bulk runs and
their images, contexts, and changes of a PSF's status or of a series. The count changes in the transaction that adds, changes or
removes the row. Rows of which an owner has only a few (keys, turns) do not count.

A transaction that changes jobs or PSFs first locks the owner's row, and then the rows of the jobs or PSFs. To lock the
owner's row, it calls ``add_bytes``, with 0 bytes if nothing is added. So two transactions cannot wait for each other.

A kept solution can be made again, so it takes no room from other things: the oldest solutions are removed if an upload,
a result or another solution needs their room.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import BigInteger, ColumnElement, String, cast, delete, func, literal, select, update
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import CursorResult
from sqlalchemy.orm import InstrumentedAttribute, Session

from workers.catalogue.bulk_tables import BulkRow
from workers.catalogue.database import Database, strict_json
from workers.catalogue.tables import (
    DefaultContextRow,
    ImageRow,
    JobRow,
    OwnerRow,
    PartRow,
    ProductRow,
    PsfChangeRow,
    PsfContextRow,
    PsfRow,
    ReportRow,
    SeriesChangeRow,
    SolutionRow,
    TransitRow,
)

WITH_FILES = (ImageRow, TransitRow, PsfRow, ProductRow, ReportRow, SolutionRow)
MIB = 2**20
ROW_BYTES = 2**10  # the columns of a row without its JSON, and its entries in the indexes
# Reasons for Usage.no_room:
NOT_KEPT = "the result of this job could not be kept"
ROWS_NOT_KEPT = "what this request adds to the database could not be kept"

CountedRow = (
    ImageRow
    | TransitRow
    | PsfRow
    | ProductRow
    | ReportRow
    | SolutionRow
    | JobRow
    | BulkRow
    | PsfContextRow
    | PsfChangeRow
    | SeriesChangeRow
    | DefaultContextRow
    | PartRow
)


@dataclass(frozen=True)
class Usage:
    """The bytes that an owner keeps, and the limit; limit_bytes None: no limit.

    removable_bytes: the part of used_bytes that kept solutions take.
    """

    owner: str
    used_bytes: int
    limit_bytes: int | None
    removable_bytes: int = 0

    def allows(self, more_bytes: int = 0) -> bool:
        """Whether ``more_bytes`` more bytes fit if the kept solutions are removed as needed."""
        if self.limit_bytes is None:
            return True
        return self.used_bytes - self.removable_bytes + more_bytes <= self.limit_bytes

    @property
    def full(self) -> bool:
        """Whether no byte can be added without exceeding the limit."""
        return not self.allows(1)

    def no_room(self, why: str) -> str:
        """The message for a full quota. why: a clause that says what could not be done."""
        assert self.limit_bytes is not None
        return (
            f"expected free room in your quota; {self.used_bytes / MIB:.1f} of {self.limit_bytes / MIB:.1f} MiB are used, and "
            f"{why}: delete products or bulk runs that you no longer need (`heliopsf product delete`, "
            "`heliopsf bulk delete`), or ask the operator for a larger quota"
        )


class OverQuota(Exception):
    """A file or a row does not fit into the owner's quota. usage: the owner's usage without this file or row."""

    def __init__(self, usage: Usage) -> None:
        super().__init__(usage.owner)
        self.usage = usage


class Owners:
    """The table of owners; each method is one transaction."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def usage(self, owner: str, quota_mib: int) -> Usage:
        """The usage of an owner. quota_mib: the limit if the owner has no individual limit; 0: unlimited."""
        with self._database.reading() as session:
            return _usage(session, owner, quota_mib)

    def all(self, quota_mib: int) -> list[Usage]:
        """The usage of all owners who keep files or have an individual limit. quota_mib: as for ``usage``."""
        with self._database.reading() as session:
            names = session.scalars(select(OwnerRow.owner).order_by(OwnerRow.owner)).all()
        return [self.usage(name, quota_mib) for name in names]

    def set_quota(self, owner: str, quota_mib: int | None) -> None:
        """Set the individual limit of an owner. 0: unlimited. None: the default limit is used."""
        with self._database.writing.begin() as session:
            add_bytes(session, owner, 0)
            session.execute(update(OwnerRow).where(OwnerRow.owner == owner).values(quota_mib=quota_mib))

    def recount(self) -> Sequence[str]:
        """Count the bytes of all files and rows again and correct the counts; returns the owners whose count was wrong."""
        wrong = []
        with self._database.writing.begin() as session:
            # Another transaction that adds a row now waits for these locks before it changes the count.
            rows = session.scalars(select(OwnerRow).with_for_update()).all()
            truth: dict[str, int] = {}
            for table, counted in COUNTED.items():
                sums = select(table.owner, func.sum(counted)).group_by(table.owner)
                for owner, total in session.execute(sums):
                    truth[owner] = truth.get(owner, 0) + int(total)
            for row in rows:
                right = truth.pop(row.owner, 0)
                if row.bytes != right:
                    wrong.append(row.owner)
                    row.bytes = right
            for owner, total in truth.items():
                # While this transaction waited, another one may have added this owner's row with its bytes.
                add_bytes(session, owner, 0)
                session.execute(update(OwnerRow).where(OwnerRow.owner == owner).values(bytes=total))
                wrong.append(owner)
        return sorted(wrong)

    def solutions_before(self, time: float) -> Sequence[SolutionRow]:
        """The kept solutions of all owners that were made before this time."""
        with self._database.reading() as session:
            return session.scalars(select(SolutionRow).where(SolutionRow.created_at < time)).all()

    def forget_solutions(self, rows: Sequence[SolutionRow]) -> None:
        """Remove these kept solutions. Their files stay until ``workers.files.collection`` removes them."""
        for row in rows:
            with self._database.writing.begin() as session:
                add_bytes(
                    session, row.owner, 0
                )  # locks the owner first, as `hold_to_quota` does: no deadlock
                _forget(session, row)


def counted_bytes(row: CountedRow) -> int:
    """The bytes that a row adds to the count of its owner: the file and the row itself; for a kept solution only the
    file.

    A bulk run counts together with its images, a context with its pins, and a job with its UWS terms. The progress, the
    estimate and the error of a job are short: they are part of ROW_BYTES.
    """
    match row:
        case SolutionRow():
            return row.bytes
        case ImageRow() | TransitRow():
            return row.bytes + ROW_BYTES + len(strict_json(row.summary))
        case PsfRow() | ProductRow() | ReportRow():
            return row.bytes + ROW_BYTES + len(strict_json(row.details))
        case JobRow():
            return ROW_BYTES + len(strict_json(row.parameters))
        case BulkRow():
            return (row.total + 1) * ROW_BYTES + len(strict_json(row.request))
        case PsfContextRow():
            return (row.pins + 1) * ROW_BYTES
        case _:
            return ROW_BYTES


def _length(column: InstrumentedAttribute[dict[str, Any]]) -> ColumnElement[int]:
    return func.length(cast(column, String))


# ``counted_bytes`` of the rows of each table, in SQL.
COUNTED: dict[type[Any], ColumnElement[int]] = {
    **{row: row.bytes + ROW_BYTES + _length(row.summary) for row in (ImageRow, TransitRow)},
    **{row: row.bytes + ROW_BYTES + _length(row.details) for row in (PsfRow, ProductRow, ReportRow)},
    SolutionRow: SolutionRow.bytes.expression,
    JobRow: ROW_BYTES + _length(JobRow.parameters),
    BulkRow: cast(BulkRow.total + 1, BigInteger) * ROW_BYTES + _length(BulkRow.request),
    PsfContextRow: (PsfContextRow.pins + 1) * ROW_BYTES,
    **{row: literal(ROW_BYTES) for row in (PsfChangeRow, SeriesChangeRow, DefaultContextRow, PartRow)},
}


def add_bytes(session: Session, owner: str, count: int) -> None:
    """Add bytes to an owner's count, and lock the count.

    Call this in the transaction that adds, changes or removes the row.
    """
    insert = sqlite.insert if session.get_bind().dialect.name == "sqlite" else postgresql.insert
    row = insert(OwnerRow).values(owner=owner, bytes=count)
    session.execute(
        row.on_conflict_do_update(index_elements=["owner"], set_={"bytes": OwnerRow.bytes + count})
    )


def add_held(
    session: Session, owner: str, count: int, quota_mib: int | None, *, removable: bool = False
) -> None:
    """Add bytes to an owner's count, and raise OverQuota if they do not fit. quota_mib, removable: as for ``hold_to_quota``.

    quota_mib None: no limit applies. A change that adds no bytes is never refused.
    """
    add_bytes(session, owner, count)
    if quota_mib is not None and count > 0:
        hold_to_quota(session, owner, count, quota_mib, removable=removable)


def check_fits(session: Session, owner: str, count: int, quota_mib: int | None) -> None:
    """Raise OverQuota if ``count`` more bytes would exceed the quota now, even without the kept solutions.

    Nothing is locked, so the quota may fill up later: ``add_held`` decides when the bytes are added.
    """
    if quota_mib is None:
        return
    usage = _usage(session, owner, quota_mib)
    if not usage.allows(count):
        raise OverQuota(usage)


def hold_to_quota(session: Session, owner: str, count: int, quota_mib: int, *, removable: bool) -> None:
    """Check ``count`` bytes that this transaction has just added to the count.

    If these bytes do not fit, the oldest kept solutions are removed until they fit. If they would not fit even
    without any kept solution, raises OverQuota. removable: whether the bytes are those of a solution. Other
    transactions of the owner wait until this one ends. If several uploads fit one by one but not together, the last
    ones are refused.
    """
    counted = _usage(session, owner, quota_mib)
    before = replace(
        counted,
        used_bytes=counted.used_bytes - count,
        removable_bytes=counted.removable_bytes - (count if removable else 0),
    )
    if not before.allows(count):
        raise OverQuota(before)
    if counted.limit_bytes is not None:
        _make_room(session, owner, counted.used_bytes - counted.limit_bytes)


def _make_room(session: Session, owner: str, missing_bytes: int) -> None:
    """Remove the owner's oldest solutions until ``missing_bytes`` bytes are free."""
    if missing_bytes <= 0:
        return
    oldest = select(SolutionRow).where(SolutionRow.owner == owner).order_by(SolutionRow.created_at)
    for row in session.scalars(oldest).all():
        if missing_bytes <= 0:
            return
        missing_bytes -= row.bytes
        _forget(session, row)


def _forget(session: Session, row: SolutionRow) -> None:
    """Remove a solution, and subtract its bytes from the count. If another transaction removed or replaced it, do
    nothing."""
    same = (
        SolutionRow.owner == row.owner,
        SolutionRow.id == row.id,
        SolutionRow.created_at == row.created_at,
    )
    result = session.execute(delete(SolutionRow).where(*same))
    assert isinstance(result, CursorResult)
    if result.rowcount:
        add_bytes(session, row.owner, -row.bytes)


def _usage(session: Session, owner: str, quota_mib: int) -> Usage:
    # populate_existing: an object that this session read earlier does not contain the changes that `add_bytes` made.
    row = session.get(OwnerRow, owner, populate_existing=True)
    own = None if row is None else row.quota_mib
    limit_mib = quota_mib if own is None else own
    removable = session.scalar(
        select(func.coalesce(func.sum(SolutionRow.bytes), 0)).where(SolutionRow.owner == owner)
    )
    used = 0 if row is None else row.bytes
    return Usage(owner, used, limit_mib * MIB if limit_mib else None, int(removable or 0))
