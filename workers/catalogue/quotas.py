"""The files to which rows refer, and the quota of each owner.

The quota limits the bytes of the files that the owner keeps.

The files of the owner's uploads, PSFs, products, reports and kept solutions count; their pictures do not. The sums are
read from the rows, so they are always exact. A transaction that adds a file under a quota first locks the owner's
row; therefore two transactions cannot use the same room.

A kept solution can be made again, so it takes no room from other things: the oldest solutions are removed if an upload,
a result or another solution needs their room.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

from sqlalchemy import (
    JSON,
    ColumnElement,
    Delete,
    FromClause,
    String,
    Table,
    cast,
    delete,
    func,
    literal,
    or_,
    select,
    tuple_,
    update,
)
from sqlalchemy.orm import Session

from workers.catalogue.database import Queries, insert_into
from workers.catalogue.tables import (
    Base,
    BulkItemRow,
    BulkRow,
    ImageRow,
    JobRow,
    OwnerRow,
    ProductRow,
    PsfRow,
    ReportRow,
    SolutionRow,
    TransitRow,
)
from workers.contract.bulk import BULK_ENDED
from workers.contract.jobs import ENDED

MIB = 2**20
MOST_QUOTA_MIB = 2**31 - 1  # the largest number in the column of quotas
FileRow = ImageRow | TransitRow | PsfRow | ProductRow | ReportRow | SolutionRow
WITH_FILES: tuple[type[FileRow], ...] = (ImageRow, TransitRow, PsfRow, ProductRow, ReportRow, SolutionRow)
# The kinds of things that the operator can keep for some time only (setting HELIOPSF_KEEP_DAYS).
UPLOADED: dict[str, type[Base]] = {"image": ImageRow, "transit": TransitRow}
KEPT: dict[str, type[Any]] = UPLOADED | {
    "product": ProductRow,
    "report": ReportRow,
    "job": JobRow,
    "bulk": BulkRow,
}
NOT_KEPT = "the result of this job could not be kept"  # a reason for Usage.no_room

BATCH = 1000  # rows that are read at once
_DIGEST = re.compile(r"[0-9a-f]{64}")
# The table of the images of bulk runs is very long, and the tables of images and products refer to all of its files.
_SKIPPED = frozenset({BulkItemRow.__tablename__})


@dataclass(frozen=True)
class Usage:
    """What an owner keeps, and the limit of the owner.

    Attributes
    ----------
    used_bytes
        Size of the files that the owner keeps.
    limit_bytes
        The limit; None: no limit.
    removable_bytes
        The part of ``used_bytes`` that kept solutions take.
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
        """The message for a full quota. The clause ``why`` says what could not be done."""
        assert self.limit_bytes is not None
        return (
            f"expected free room in your quota; {self.used_bytes / MIB:.1f} of {self.limit_bytes / MIB:.1f} MiB are "
            f"used, and {why}: delete products that you no longer need (`heliopsf product delete`), or ask the "
            "operator for a larger quota"
        )


class OverQuota(Exception):
    """A file does not fit into the owner's quota.

    Attributes
    ----------
    usage
        The owner's usage without this file.
    """

    def __init__(self, usage: Usage) -> None:
        super().__init__(usage.owner)
        self.usage = usage


class Quotas(Queries):
    """The limits of owners, and what they keep."""

    def usage(self, owner: str, quota_mib: int) -> Usage:
        """The usage of an owner.

        Parameters
        ----------
        quota_mib
            The limit if the owner has no individual limit, MiB; 0: unlimited.
        """
        with self._database.reading() as session:
            return _usage(session, owner, _limit_mib(session, owner, quota_mib))

    def limited(self, owner: str, quota_mib: int) -> Usage | None:
        """The usage of an owner who has a limit; None if there is no limit.

        Parameters
        ----------
        quota_mib
            The limit if the owner has no individual limit, MiB; 0: unlimited.
        """
        with self._database.reading() as session:
            return _limited(session, owner, quota_mib)

    def all(self, quota_mib: int) -> list[Usage]:
        """The usage of all owners who keep files, made a key or have an individual limit.

        Parameters
        ----------
        quota_mib
            The limit of owners who have no individual limit, MiB; 0: unlimited.
        """
        with self._database.reading() as session:
            tables: tuple[type[OwnerRow | FileRow], ...] = (OwnerRow, *WITH_FILES)
            owners = {name for row in tables for name in session.scalars(select(row.owner).distinct())}
        return [self.usage(name, quota_mib) for name in sorted(owners)]

    def set_quota(self, owner: str, quota_mib: int | None) -> None:
        """Set the individual limit of an owner. 0: unlimited. None: the default limit is used."""
        with self._database.writing.begin() as session:
            lock_owner(session, owner)
            session.execute(update(OwnerRow).where(OwnerRow.owner == owner).values(quota_mib=quota_mib))

    def solutions_before(self, time: float) -> Sequence[SolutionRow]:
        """The kept solutions of all owners that were made before this time."""
        return self._database.all(select(SolutionRow).where(SolutionRow.created_at < time))

    def forget_solutions(self, rows: Sequence[SolutionRow]) -> None:
        """Remove these kept solutions. Their files stay until ``workers.files.garbage`` removes them."""
        for row in rows:
            self._database.change(_removal(row))

    def old(
        self, kind: str, before: float, owner: str, others: Collection[str]
    ) -> list[tuple[str, str, int]]:
        """Owner, id and bytes of the rows of a kind that were made before this time; of jobs and bulk runs, that ended
        before this time. Uploads that an unfinished job or bulk run uses are left out.

        Parameters
        ----------
        kind
            The kind of the rows, a key of KEPT.
        before
            The time, in seconds since 1970.
        owner
            The owner of the rows; empty: all owners except ``others``.
        others
            The owners whose rows are left out if ``owner`` is empty.
        """
        table = KEPT[kind]
        has_file = table in WITH_FILES
        at, size = (table.created_at, table.bytes) if has_file else (table.ended_at, literal(0))
        query = select(table.owner, table.id, size).where(at < before)
        query = query.where(table.owner == owner) if owner else query.where(table.owner.not_in(others))
        jobs = select(cast(JobRow.parameters, String)).where(JobRow.phase.not_in(ENDED))
        runs = select(BulkRow.id).where(BulkRow.phase.not_in(BULK_ENDED))
        items = select(BulkItemRow.source).where(BulkItemRow.bulk_id.in_(runs))
        with self._database.reading() as session:
            texts = chain.from_iterable(session.scalars(one) for one in (jobs, items) if kind in UPLOADED)
            used = {identity for text in texts for identity in _DIGEST.findall(text)}
            return [
                (of, identity, size) for of, identity, size in session.execute(query) if identity not in used
            ]


class NamedFiles(Queries):
    """The files of all owners to which the database refers.

    A row refers to a file if the file's hash appears in any text or JSON column. The search therefore works for all
    tables in the same way. The search may find hashes that are not hashes of files, for example the hash of a key. It
    misses no file.
    """

    def all(self, *, solutions_from: float = -math.inf) -> Iterator[str]:
        """Every hash in the database; a hash may occur more than once. Rows are read in batches.

        Parameters
        ----------
        solutions_from
            The time from which solutions are read, in seconds since 1970; solutions that were stored earlier are left
            out.
        """
        for table in Base.metadata.sorted_tables:
            if table.name not in _SKIPPED:
                yield from self._in(table, solutions_from)

    def among(self, digests: frozenset[str]) -> frozenset[str]:
        """The hashes in ``digests`` (a few) to which the row of an upload, a PSF, a product, a report or a solution
        refers.

        Jobs and bulk runs are not searched. Jobs and bulk runs refer to things by id, and every existing thing has a
        row of its own.
        """
        named: set[str] = set()
        with self._database.reading() as session:
            for table in (row.__table__ for row in WITH_FILES):
                texts = _texts(table)
                for digest in digests - named:
                    contains = or_(*(text.contains(digest) for text in texts))
                    if session.scalar(select(select(table).where(contains).exists())):
                        named.add(digest)
        return frozenset(named)

    def kept(self, table: Any) -> Iterator[FileRow]:
        """All rows of a table that refers to files. The rows are read in batches, so that no transaction stays open
        for long.
        """
        last: tuple[str, str] | None = None
        while True:
            query = select(table).order_by(table.owner, table.id).limit(BATCH)
            if last is not None:
                query = query.where(tuple_(table.owner, table.id) > last)
            rows = self._database.all(query)
            yield from rows
            if len(rows) < BATCH:
                return
            last = (rows[-1].owner, rows[-1].id)

    def _in(self, table: Table, solutions_from: float) -> Iterator[str]:
        texts = _texts(table)
        if not texts:
            return
        with self._database.engine.execution_options(read_only=True).connect() as connection:
            query = select(*texts)
            if table is SolutionRow.__table__ and math.isfinite(solutions_from):
                query = query.where(table.c.created_at >= solutions_from)
            rows = connection.execution_options(stream_results=True, yield_per=BATCH).execute(query)
            for text in chain.from_iterable(rows):
                yield from _DIGEST.findall(text or "")


def lock_owner(session: Session, owner: str) -> None:
    """Let other transactions that call this function for the owner wait until this transaction ends.

    On SQLite, a writing transaction already excludes all others.
    """
    session.execute(insert_into(session, OwnerRow).values(owner=owner).on_conflict_do_nothing())
    session.execute(select(OwnerRow.owner).where(OwnerRow.owner == owner).with_for_update())


def hold_to_quota(session: Session, row: FileRow, quota_mib: int) -> None:
    """Check the file of a row that this transaction has just added. Call ``lock_owner`` before the row is added.

    If the file does not fit, the owner's oldest kept solutions are removed until it fits. If several uploads fit one by
    one but not together, the last ones are refused.

    Parameters
    ----------
    quota_mib
        The limit if the owner has no individual limit, MiB; 0: unlimited.

    Raises
    ------
    OverQuota
        The file would not fit even without any kept solution.
    """
    now = _limited(session, row.owner, quota_mib)
    if now is None or now.limit_bytes is None:
        return
    removable_bytes = now.removable_bytes - (row.bytes if isinstance(row, SolutionRow) else 0)
    before = replace(now, used_bytes=now.used_bytes - row.bytes, removable_bytes=removable_bytes)
    if not before.allows(row.bytes):
        raise OverQuota(before)
    missing_bytes = now.used_bytes - now.limit_bytes
    if missing_bytes > 0:
        oldest = select(SolutionRow).where(SolutionRow.owner == row.owner).order_by(SolutionRow.created_at)
        for solution in session.scalars(oldest).all():
            if missing_bytes > 0:
                missing_bytes -= solution.bytes
                session.execute(_removal(solution))


def _removal(row: SolutionRow) -> Delete:
    """A statement that removes a solution, unless another transaction has removed or replaced it."""
    return delete(SolutionRow).where(
        SolutionRow.owner == row.owner,
        SolutionRow.id == row.id,
        SolutionRow.created_at == row.created_at,
    )


def _limit_mib(session: Session, owner: str, quota_mib: int) -> int:
    """The individual limit of an owner, or else ``quota_mib``. 0: unlimited."""
    own = session.scalar(select(OwnerRow.quota_mib).where(OwnerRow.owner == owner))
    return quota_mib if own is None else own


def _limited(session: Session, owner: str, quota_mib: int) -> Usage | None:
    """The usage of an owner who has a limit; None if there is no limit. Without a limit, no sum is read."""
    limit_mib = _limit_mib(session, owner, quota_mib)
    return _usage(session, owner, limit_mib) if limit_mib else None


def _usage(session: Session, owner: str, limit_mib: int) -> Usage:
    sums = (select(func.sum(row.bytes)).where(row.owner == owner).scalar_subquery() for row in WITH_FILES)
    row_of_sums = session.execute(select(*sums)).one()
    totals = {table: int(total or 0) for table, total in zip(WITH_FILES, row_of_sums, strict=True)}
    return Usage(
        owner,
        used_bytes=sum(totals.values()),
        limit_bytes=limit_mib * MIB if limit_mib else None,
        removable_bytes=totals[SolutionRow],
    )


def _texts(table: FromClause) -> list[ColumnElement[str]]:
    return [cast(one, String) for one in table.columns if isinstance(one.type, String | JSON)]
