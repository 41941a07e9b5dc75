"""The quota of each owner: the bytes of the files that the owner keeps, and the number of database rows without a file.

The files of the owner's uploads, PSFs, products, reports and kept solutions count; their pictures do not. The sums are
read from the rows, so they are always exact. A transaction that adds a file under a quota first locks the owner's
row; therefore two transactions cannot use the same room.

Jobs, bulk runs with their images, contexts with their pins, and changes of PSFs, series and default contexts have no
file. Their number is limited, so that one owner cannot fill the database: each MiB of the quota allows ROWS_PER_MIB of
them. Requests that arrive at the same moment may exceed this number slightly.

A kept solution can be made again, so it takes no room from other things: the oldest solutions are removed if an upload,
a result or another solution needs their room.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import ColumnElement, Select, delete, func, select, update
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from workers.catalogue.bulk_tables import BulkRow
from workers.catalogue.database import Database
from workers.catalogue.tables import (
    DefaultContextRow,
    ImageRow,
    JobRow,
    OwnerRow,
    ProductRow,
    PsfChangeRow,
    PsfContextRow,
    PsfRow,
    ReportRow,
    SeriesChangeRow,
    SolutionRow,
    TransitRow,
)

MIB = 2**20
ROWS_PER_MIB = 256
WITH_FILES = (ImageRow, TransitRow, PsfRow, ProductRow, ReportRow, SolutionRow)
# The tables without files, and how many rows each of their rows stands for.
WITHOUT_FILES: dict[type[Any], ColumnElement[int]] = {
    JobRow: func.count(),
    BulkRow: func.sum(BulkRow.total + 1),
    PsfContextRow: func.sum(PsfContextRow.pins + 1),
    PsfChangeRow: func.count(),
    SeriesChangeRow: func.count(),
    DefaultContextRow: func.count(),
}
# Reasons for Usage.no_room and Usage.too_many_rows:
NOT_KEPT = "the result of this job could not be kept"
ROWS_NOT_KEPT = "what this request adds to the database could not be kept"

FileRow = ImageRow | TransitRow | PsfRow | ProductRow | ReportRow | SolutionRow


@dataclass(frozen=True)
class Usage:
    """What an owner keeps, and the limit; limit_bytes None: no limit.

    used_rows: the number of database rows without a file. removable_bytes: the part of used_bytes that kept solutions
    take.
    """

    owner: str
    used_bytes: int
    used_rows: int
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

    def allows_rows(self, more_rows: int) -> bool:
        """Whether ``more_rows`` more rows without a file may be added."""
        return self.limit_bytes is None or self.used_rows + more_rows <= self._limit_rows

    def no_room(self, why: str) -> str:
        """The message for a full quota. why: a clause that says what could not be done."""
        assert self.limit_bytes is not None
        return (
            f"expected free room in your quota; {self.used_bytes / MIB:.1f} of {self.limit_bytes / MIB:.1f} MiB are used, and "
            f"{why}: delete products that you no longer need (`heliopsf product delete`), or ask the operator for a larger "
            "quota"
        )

    def too_many_rows(self, why: str) -> str:
        """The message for too many rows. why: a clause that says what could not be done."""
        return (
            f"expected free room in your quota; it allows {self._limit_rows} database rows, {self.used_rows} are there (jobs, "
            f"bulk runs with their images, contexts and changes of PSFs), and {why}: delete bulk runs and ended jobs that you "
            "no longer need (`heliopsf bulk delete`), or ask the operator for a larger quota"
        )

    @property
    def _limit_rows(self) -> int:
        assert self.limit_bytes is not None
        return self.limit_bytes // MIB * ROWS_PER_MIB


class OverQuota(Exception):
    """A file or rows do not fit into the owner's quota. usage: the owner's usage without them."""

    def __init__(self, usage: Usage) -> None:
        super().__init__(usage.owner)
        self.usage = usage


class Owners:
    """The limits of owners, and what they keep; each method is one transaction."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def usage(self, owner: str, quota_mib: int) -> Usage:
        """The usage of an owner. quota_mib: the limit if the owner has no individual limit; 0: unlimited."""
        with self._database.reading() as session:
            return _usage(session, owner, _limit_mib(session, owner, quota_mib))

    def limited(self, owner: str, quota_mib: int) -> Usage | None:
        """The usage of an owner who has a limit; None if there is no limit. quota_mib: as for ``usage``."""
        with self._database.reading() as session:
            return _limited(session, owner, quota_mib)

    def all(self, quota_mib: int) -> list[Usage]:
        """The usage of all owners who keep files, made a key or have an individual limit. quota_mib: as for ``usage``."""
        with self._database.reading() as session:
            owners = {name for row in (OwnerRow, *WITH_FILES) for name in session.scalars(_names(row))}
        return [self.usage(name, quota_mib) for name in sorted(owners)]

    def set_quota(self, owner: str, quota_mib: int | None) -> None:
        """Set the individual limit of an owner. 0: unlimited. None: the default limit is used."""
        with self._database.writing.begin() as session:
            lock_owner(session, owner)
            session.execute(update(OwnerRow).where(OwnerRow.owner == owner).values(quota_mib=quota_mib))

    def solutions_before(self, time: float) -> Sequence[SolutionRow]:
        """The kept solutions of all owners that were made before this time."""
        with self._database.reading() as session:
            return session.scalars(select(SolutionRow).where(SolutionRow.created_at < time)).all()

    def forget_solutions(self, rows: Sequence[SolutionRow]) -> None:
        """Remove these kept solutions. Their files stay until ``workers.files.collection`` removes them."""
        for row in rows:
            with self._database.writing.begin() as session:
                _forget(session, row)


def lock_owner(session: Session, owner: str) -> None:
    """Let other transactions that call this function for the owner wait until this transaction ends.

    On SQLite, a writing transaction already excludes all others.
    """
    insert = sqlite.insert if session.get_bind().dialect.name == "sqlite" else postgresql.insert
    session.execute(insert(OwnerRow).values(owner=owner).on_conflict_do_nothing())
    session.execute(select(OwnerRow.owner).where(OwnerRow.owner == owner).with_for_update())


def hold_to_quota(session: Session, row: FileRow, quota_mib: int) -> None:
    """Check the file of a row that this transaction has just added. Call ``lock_owner`` before the row is added.

    If the file does not fit, the owner's oldest kept solutions are removed until it fits. If it would not fit even
    without any kept solution, raises OverQuota. If several uploads fit one by one but not together, the last ones are
    refused. quota_mib: as for ``Owners.usage``.
    """
    now = _limited(session, row.owner, quota_mib)
    if now is None or now.limit_bytes is None:
        return
    removable_bytes = now.removable_bytes - (row.bytes if isinstance(row, SolutionRow) else 0)
    before = replace(now, used_bytes=now.used_bytes - row.bytes, removable_bytes=removable_bytes)
    if not before.allows(row.bytes):
        raise OverQuota(before)
    _make_room(session, row.owner, now.used_bytes - now.limit_bytes)


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
    """Remove a solution. If another transaction removed or replaced it, do nothing."""
    same = (
        SolutionRow.owner == row.owner,
        SolutionRow.id == row.id,
        SolutionRow.created_at == row.created_at,
    )
    session.execute(delete(SolutionRow).where(*same))


def _names(row: type[Any]) -> Select[str]:
    """A query for the owners of the rows of a table."""
    return select(row.owner).distinct()


def _limit_mib(session: Session, owner: str, quota_mib: int) -> int:
    """The individual limit of an owner, or else ``quota_mib``. 0: unlimited."""
    own = session.scalar(select(OwnerRow.quota_mib).where(OwnerRow.owner == owner))
    return quota_mib if own is None else own


def _limited(session: Session, owner: str, quota_mib: int) -> Usage | None:
    """The usage of an owner who has a limit; None if there is no limit. Without a limit, no sum is read."""
    limit_mib = _limit_mib(session, owner, quota_mib)
    return _usage(session, owner, limit_mib) if limit_mib else None


def _usage(session: Session, owner: str, limit_mib: int) -> Usage:
    sums = {**{row: func.sum(row.bytes) for row in WITH_FILES}, **WITHOUT_FILES}
    queries = (select(total).where(row.owner == owner).scalar_subquery() for row, total in sums.items())
    row_of_sums = session.execute(select(*queries)).one()
    totals = {table: int(total or 0) for table, total in zip(sums, row_of_sums, strict=True)}
    return Usage(
        owner,
        used_bytes=sum(totals[row] for row in WITH_FILES),
        used_rows=sum(totals[row] for row in WITHOUT_FILES),
        limit_bytes=limit_mib * MIB if limit_mib else None,
        removable_bytes=totals[SolutionRow],
    )
