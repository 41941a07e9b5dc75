"""The catalogue: images, transits, PSFs, products and jobs, in SQLite or PostgreSQL through SQLAlchemy.

Each subject has a class in a separate file. The class ``Catalogue`` has an attribute for each of them, and the operations
that are common to all content-addressed rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

from sqlalchemy import Select, select, tuple_
from sqlalchemy.exc import IntegrityError

from workers.catalogue.affected import AffectedProducts
from workers.catalogue.bulk_tables import BulkRow
from workers.catalogue.bulks import Bulks
from workers.catalogue.census import Census
from workers.catalogue.contexts import Contexts
from workers.catalogue.database import Database
from workers.catalogue.jobs import Jobs
from workers.catalogue.keys import Keys
from workers.catalogue.named_files import NamedFiles
from workers.catalogue.owners import Owners, add_bytes, counted_bytes, hold_to_quota
from workers.catalogue.parts import Parts
from workers.catalogue.psfs import Psfs
from workers.catalogue.schema import Schema
from workers.catalogue.stage_times import KeptStageTimes
from workers.catalogue.tables import (
    ImageRow,
    JobRow,
    ProductRow,
    PsfContextRow,
    PsfRow,
    ReportRow,
    SolutionRow,
    TransitRow,
)
from workers.catalogue.uws_jobs import UwsJobs

Row = TypeVar("Row", ImageRow, TransitRow, PsfRow, ProductRow, ReportRow, SolutionRow)
AnyRow = TypeVar(
    "AnyRow", ImageRow, TransitRow, PsfRow, ProductRow, ReportRow, JobRow, PsfContextRow, BulkRow
)


class Catalogue:
    """Reads and writes all rows. Each method, of this class and of its attributes, is one transaction."""

    def __init__(self, url: str) -> None:
        self._database = Database(url)
        self._engine = self._database.engine
        self.schema = Schema(self._database)
        self.jobs = Jobs(self._database)
        self.uws = UwsJobs(self._database, self.jobs)
        self.parts = Parts(self._database)
        self.bulks = Bulks(self._database)
        self.psfs = Psfs(self._database)
        self.contexts = Contexts(self._database)
        self.affected = AffectedProducts(self._database)
        self.census = Census(self._database)
        self.stage_times = KeptStageTimes(self._database)
        self.keys = Keys(self._database)
        self.owners = Owners(self._database)
        self.named_files = NamedFiles(self._database)

    def upgrade(self) -> None:
        """Upgrade the tables of the database to this version. Raises ``workers.catalogue.schema.SchemaError``."""
        self.schema.upgrade()

    def close(self) -> None:
        """Close all connections."""
        self._database.engine.dispose()

    def ping(self) -> None:
        """Raise ``sqlalchemy.exc.SQLAlchemyError`` if the database does not answer."""
        with self._database.reading() as session:
            session.execute(select(1))

    def add(self, row: Row, quota_mib: int | None = None) -> tuple[Row, bool]:
        """Insert a content-addressed row; returns the row with this identity, and whether it is new.

        quota_mib: the limit for owners without one of their own; None: no limit applies. Raises
        ``workers.catalogue.owners.OverQuota`` and adds nothing if the row exceeds the limit even without the owner's
        kept solutions. If it exceeds the limit with them, the oldest solutions are removed.
        """
        try:
            with self._database.writing.begin() as session:
                session.add(row)
                session.flush()
                count = counted_bytes(row)
                add_bytes(session, row.owner, count)
                if quota_mib is not None:
                    removable = isinstance(row, SolutionRow)
                    hold_to_quota(session, row.owner, count, quota_mib, removable=removable)
            return row, True
        except IntegrityError:
            existing = self.get(type(row), row.id, row.owner)
            if existing is None:
                raise
            return existing, False

    def get(self, table: type[Row], identity: str, owner: str) -> Row | None:
        """The row with this identity, or None."""
        with self._database.reading() as session:
            return session.get(table, (owner, identity))

    def page(
        self,
        table: type[AnyRow],
        *,
        owner: str,
        limit: int,
        after: tuple[float, str] | None = None,
        **equal: str | None,
    ) -> Sequence[AnyRow]:
        """A page of rows, newest first. after: (created_at, id) of the last row of the previous page.

        equal: values of columns; only rows with these values are returned.
        """
        query: Select[AnyRow] = select(table).where(table.owner == owner)
        for column, value in equal.items():
            if value is not None:
                query = query.where(getattr(table, column) == value)
        if after is not None:
            query = query.where(tuple_(table.created_at, table.id) < after)
        query = query.order_by(table.created_at.desc(), table.id.desc()).limit(limit)
        with self._database.reading() as session:
            return session.scalars(query).all()
