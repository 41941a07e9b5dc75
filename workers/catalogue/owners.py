"""What each owner has kept, in bytes, and how much that may be.

Counted are files that a row of the owner's names as its own: uploads, PSFs, products, reports; not their pictures. The
count is changed in the transaction that adds the row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from sqlalchemy import func, select, update
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.orm import Session

from workers.catalogue.database import Database
from workers.catalogue.tables import ImageRow, OwnerRow, ProductRow, PsfRow, ReportRow, TransitRow

COUNTED = (ImageRow, TransitRow, PsfRow, ProductRow, ReportRow)
MIB = 2**20
NOT_KEPT = "what this makes could not be kept"  # for Usage.no_room, of work


@dataclass(frozen=True)
class Usage:
    """What an owner has kept; no limit is none."""

    owner: str
    used_bytes: int
    limit_bytes: int | None

    def allows(self, more_bytes: int = 0) -> bool:
        """Whether so much more may be kept."""
        return self.limit_bytes is None or self.used_bytes + more_bytes <= self.limit_bytes

    @property
    def full(self) -> bool:
        """True where nothing more may be kept."""
        return not self.allows(1)

    def no_room(self, why: str) -> str:
        """What is told where there is no room. why: half a sentence on what it is needed for."""
        assert self.limit_bytes is not None
        return (
            f"expected room for it: {self.used_bytes / MIB:.1f} of {self.limit_bytes / MIB:.1f} MiB are used, and "
            f"{why} (the operator sets quotas)"
        )


class OverQuota(Exception):
    """More bytes than were left. usage: before them."""

    def __init__(self, usage: Usage) -> None:
        super().__init__(usage.owner)
        self.usage = usage


class Owners:
    """The table of owners; each method is one transaction."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def usage(self, owner: str, quota_mib: int) -> Usage:
        """What an owner has kept. quota_mib: the limit of those who have none of their own; 0 is none."""
        with self._database.reading() as session:
            return _usage(session, owner, quota_mib)

    def all(self, quota_mib: int) -> list[Usage]:
        """All owners who have kept anything or have a limit of their own."""
        with self._database.reading() as session:
            names = session.scalars(select(OwnerRow.owner).order_by(OwnerRow.owner)).all()
        return [self.usage(name, quota_mib) for name in names]

    def set_quota(self, owner: str, quota_mib: int | None) -> None:
        """Give an owner a limit of its own; 0 is no limit, none is the limit of all."""
        with self._database.writing.begin() as session:
            add_bytes(session, owner, 0)
            session.execute(update(OwnerRow).where(OwnerRow.owner == owner).values(quota_mib=quota_mib))

    def recount(self) -> Sequence[str]:
        """Count what is there anew; the owners whose count was wrong."""
        wrong = []
        with self._database.writing.begin() as session:
            # Who adds a row meanwhile waits with its bytes until this is done.
            rows = session.scalars(select(OwnerRow).with_for_update()).all()
            truth: dict[str, int] = {}
            for table in COUNTED:
                sums = select(table.owner, func.sum(table.bytes)).group_by(table.owner)
                for owner, total in session.execute(sums):
                    truth[owner] = truth.get(owner, 0) + int(total)
            for row in rows:
                right = truth.pop(row.owner, 0)
                if row.bytes != right:
                    wrong.append(row.owner)
                    row.bytes = right
            for owner, total in truth.items():
                # It came while this waited, and may have been counted already.
                add_bytes(session, owner, 0)
                session.execute(update(OwnerRow).where(OwnerRow.owner == owner).values(bytes=total))
                wrong.append(owner)
        return sorted(wrong)


def add_bytes(session: Session, owner: str, count: int) -> None:
    """Count bytes that an owner has kept, in the transaction that adds what they are of."""
    insert = sqlite.insert if session.get_bind().dialect.name == "sqlite" else postgresql.insert
    row = insert(OwnerRow).values(owner=owner, bytes=count)
    session.execute(
        row.on_conflict_do_update(index_elements=["owner"], set_={"bytes": OwnerRow.bytes + count})
    )


def hold_to_quota(session: Session, owner: str, count: int, quota_mib: int) -> None:
    """Raise OverQuota where bytes that are counted already are more than were left.

    Others of the owner's wait with their bytes until this transaction ends: of uploads that each fit, and together do
    not, the last are refused.
    """
    counted = _usage(session, owner, quota_mib)
    before = replace(counted, used_bytes=counted.used_bytes - count)
    if not before.allows(count):
        raise OverQuota(before)


def _usage(session: Session, owner: str, quota_mib: int) -> Usage:
    row = session.get(OwnerRow, owner)
    own = None if row is None else row.quota_mib
    limit_mib = quota_mib if own is None else own
    return Usage(owner, 0 if row is None else row.bytes, limit_mib * MIB if limit_mib else None)
