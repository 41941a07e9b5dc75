"""The catalogue: images, transits, PSFs, products and jobs, in SQLite or PostgreSQL through SQLAlchemy.

Each subject has a class in a separate file. The class ``Catalogue`` has an attribute for each of them, and the
operations that are common to all content-addressed rows.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from sqlalchemy import ColumnElement, Select, String, cast, create_engine, false, select
from sqlalchemy.exc import DatabaseError, IntegrityError
from sqlalchemy.orm import Session
from sqlalchemy.orm.attributes import flag_modified
from sqlalchemy.pool import NullPool

from psfcore.errors import DataError
from workers.catalogue.access import Keys, Sessions
from workers.catalogue.affected import AffectedProducts
from workers.catalogue.bulks import Bulks
from workers.catalogue.census import Census, KeptStageTimes
from workers.catalogue.changes import changes_of_bulks, changes_of_jobs
from workers.catalogue.contexts import Contexts, Series
from workers.catalogue.database import Database, begins_with, newest_first
from workers.catalogue.jobs import Jobs, Parts
from workers.catalogue.psfs import Psfs, existing_psf
from workers.catalogue.quotas import NamedFiles, Quotas, hold_to_quota, lock_owner
from workers.catalogue.schema import Schema
from workers.catalogue.tables import (
    BulkRow,
    ImageRow,
    JobRow,
    ProductRow,
    PsfContextRow,
    PsfPinRow,
    PsfRow,
    ReportRow,
    SolutionRow,
    TransitRow,
    WorkerRow,
)
from workers.catalogue.turns import Places, Turns
from workers.catalogue.uws_jobs import UwsJobs
from workers.contract.bulk import OPEN
from workers.contract.identities import canonical_hash
from workers.contract.jobs import ENDED, Phase
from workers.versions import PsfStatus

Row = TypeVar("Row", ImageRow, TransitRow, PsfRow, ProductRow, ReportRow, SolutionRow)
AnyResult = TypeVar("AnyResult", ProductRow, PsfRow, ReportRow)
AnyRow = TypeVar(
    "AnyRow", ImageRow, TransitRow, PsfRow, ProductRow, ReportRow, JobRow, PsfContextRow, BulkRow
)
ListedRow = ImageRow | TransitRow | PsfRow | ProductRow | ReportRow | JobRow | PsfContextRow | BulkRow
MOST_CANDIDATES = 6
QUICK_CHECK = "PRAGMA quick_check(1)"  # SQLite compares all pages of the file, and reports the first fault
_ATTEMPTS = 10
_IN_A_QUERY = 500  # databases limit the number of values in a query


class Catalogue:
    """Reads and writes all rows. Each method, of this class and of its attributes, is one transaction."""

    def __init__(self, url: str) -> None:
        self._database = Database(url)
        self.schema = Schema(self._database)
        self.jobs = Jobs(self._database)
        self.turns = Turns(self._database, self.jobs)
        self.places = Places(self._database)
        self.uws = UwsJobs(self._database, self.jobs)
        self.parts = Parts(self._database)
        self.bulks = Bulks(self._database)
        self.job_changes = changes_of_jobs(self._database)
        self.bulk_changes = changes_of_bulks(self._database)
        self.psfs = Psfs(self._database)
        self.contexts = Contexts(self._database)
        self.series = Series(self._database)
        self.affected = AffectedProducts(self._database)
        self.census = Census(self._database)
        self.stage_times = KeptStageTimes(self._database)
        self.keys = Keys(self._database)
        self.sessions = Sessions(self._database, self.keys)
        self.quotas = Quotas(self._database)
        self.named_files = NamedFiles(self._database)

    def upgrade(self) -> Path | None:
        """Upgrade the tables of the database to this version. Raises ``workers.catalogue.schema.SchemaError``.

        Returns the copy that was made before; see ``Schema.upgrade``.
        """
        return self.schema.upgrade()

    def close(self) -> None:
        """Close all connections."""
        self._database.engine.dispose()

    def clock(self) -> float:
        """The time of the database's clock, in seconds since 1970. Raises ``sqlalchemy.exc.SQLAlchemyError`` if the
        database does not answer.
        """
        return self._database.clock()

    def check_writable(self) -> None:
        """Raise ``sqlalchemy.exc.SQLAlchemyError`` if the database refuses changes. Changes nothing."""
        self._database.set(WorkerRow, [false()], version="")

    def check_pages(self) -> None:
        """Raise ``sqlalchemy.exc.DatabaseError`` if the file of an SQLite database is damaged.

        This reads the whole file. PostgreSQL checks the pages that it reads itself.
        """
        if not self._database.sqlite:
            return
        # A new connection, because the other connections keep pages in memory and do not read these pages again.
        fresh = create_engine(self._database.engine.url, poolclass=NullPool)
        with fresh.connect() as connection:
            (state,) = connection.exec_driver_sql(QUICK_CHECK).one()
        if state != "ok":
            raise DatabaseError(QUICK_CHECK, None, sqlite3.DatabaseError(f"malformed: {state}"))

    def add(self, row: Row, quota_mib: int | None = None) -> tuple[Row, bool]:
        """Insert a content-addressed row; returns the row with this identity, and whether it is new.

        If the file does not fit, the owner's oldest kept solutions are removed until it fits.

        Parameters
        ----------
        quota_mib
            The limit for owners who have no individual limit, MiB; None: no limit applies.

        Raises
        ------
        workers.catalogue.quotas.OverQuota
            The file would not fit even without any kept solution. Nothing is added or removed.
        """
        attempts = 0
        while True:
            try:
                with self._database.writing.begin() as session:
                    if quota_mib is not None:
                        lock_owner(session, row.owner)
                    session.add(row)
                    session.flush()
                    if quota_mib is not None:
                        hold_to_quota(session, row, quota_mib)
                return row, True
            except IntegrityError:
                existing = self.get(type(row), row.id, row.owner)
                if existing is not None:
                    return existing, False
                attempts += 1  # another request has just deleted the existing row
                if attempts == _ATTEMPTS:
                    raise

    def refile(self, row: AnyResult) -> AnyResult:
        """Let the existing row with this identity refer to the files of ``row``; returns the existing row.

        If there is no such row any more, ``row`` is added and returned.
        """
        with self._database.writing.begin() as session:
            there = session.get(type(row), (row.owner, row.id), with_for_update=True)
            if there is not None:
                there.file_sha256, there.bytes = row.file_sha256, row.bytes
                there.preview_sha256, there.details = row.preview_sha256, row.details
                return there
        return self.add(row)[0]  # it was deleted meanwhile

    def get(self, table: type[Row], identity: str, owner: str) -> Row | None:
        """The row with this identity, or None."""
        return self._database.row(table, (owner, identity))

    def rows(self, table: type[Row], identities: Collection[str], owner: str) -> dict[str, Row]:
        """The rows with these identities, by their id. An identity without a row is left out."""
        queries = (select(table).where(*these) for these in _in_batches(table, identities, owner))
        return {row.id: row for query in queries for row in self._database.all(query)}

    def delete_draft(self, psf_id: str, owner: str) -> PsfRow:
        """Delete a draft PSF that nothing uses; returns the deleted row.

        Its bytes no longer count for the owner, and a later identical request makes it again. Its files stay in the
        store. Raises ``DataError`` "no-such-psf", "not-a-draft" or "psf-in-use", and then deletes nothing.
        """
        with self._database.writing.begin() as session:
            row = existing_psf(session, psf_id, owner, lock=True)
            if row.status != PsfStatus.DRAFT:
                raise DataError(
                    "not-a-draft",
                    f"expected a draft; PSF {psf_id} is {row.status}, and such PSFs are never deleted: deprecate it "
                    "instead",
                )
            _check_unused(session, row)
            session.delete(row)
            _unshare_jobs(session, owner, psf_id)
            return row

    def ids_from(self, table: type[ListedRow], digits: str, owner: str) -> Sequence[str]:
        """The ids of an owner's rows that begin with these digits, at most MOST_CANDIDATES."""
        query = select(table.id).where(table.owner == owner, begins_with(table.id, digits))
        return self._database.all(query.order_by(table.id).limit(MOST_CANDIDATES))

    def ids_among(self, table: type[AnyRow], identities: Collection[str], owner: str) -> set[str]:
        """The ids in ``identities`` that the catalogue contains."""
        queries = (select(table.id).where(*these) for these in _in_batches(table, identities, owner))
        return {identity for query in queries for identity in self._database.all(query)}

    def delete(self, table: type[Row], identity: str, owner: str) -> Row | None:
        """Remove a row with a file from the catalogue; returns the row, or None if it was not there.

        Its bytes no longer count for the owner, and a later identical request makes it again. Its files stay until
        ``workers.files.garbage`` removes them, because other rows may refer to the same files.
        """
        with self._database.writing.begin() as session:
            row = session.get(table, (owner, identity), with_for_update=True)
            if row is not None:
                session.delete(row)
                _unshare_jobs(session, owner, identity)
            return row

    def page(
        self,
        table: type[AnyRow],
        *,
        owner: str,
        limit: int,
        after: tuple[float, str] | None = None,
        **equal: str | None,
    ) -> Sequence[AnyRow]:
        """A page of rows, newest first.

        Parameters
        ----------
        after
            (created_at, id) of the last row of the previous page; None for the first page.
        **equal
            Values of columns; only rows with these values are returned. A column whose value is None does not count.
        """
        query: Select[AnyRow] = select(table).where(table.owner == owner)
        for column, value in equal.items():
            if value is not None:
                query = query.where(getattr(table, column) == value)
        return self._database.all(newest_first(query, (table.created_at, table.id), limit, after))


def _in_batches(
    table: type[ListedRow | SolutionRow], identities: Collection[str], owner: str
) -> Iterator[list[ColumnElement[bool]]]:
    """The conditions that select an owner's rows with these ids, for one query after the other."""
    ids = list(identities)
    for at in range(0, len(ids), _IN_A_QUERY):
        yield [table.owner == owner, table.id.in_(ids[at : at + _IN_A_QUERY])]


def _unshare_jobs(session: Session, owner: str, result_id: str) -> None:
    """The result of these completed jobs is deleted, so give the jobs other keys.

    An identical request then gets a new job, instead of a job whose result is gone.
    """
    done = select(JobRow).where(
        JobRow.owner == owner, JobRow.phase == Phase.COMPLETED, JobRow.result_id == result_id
    )
    for job in session.scalars(done):
        job.request_key = canonical_hash({"request_key": job.request_key, "deleted": job.id})
        flag_modified(job, "changed_at")  # it is written as it is, because no event tells of this change


def _check_unused(session: Session, psf: PsfRow) -> None:
    """Raise ``DataError`` "psf-in-use" if a product, context, open bulk run, unfinished job or other PSF uses a PSF."""
    products = select(ProductRow.id).where(ProductRow.owner == psf.owner, ProductRow.psf_id == psf.id)
    pins = select(PsfPinRow.context_id).where(PsfPinRow.owner == psf.owner, PsfPinRow.psf_id == psf.id)
    runs = select(BulkRow.id).where(BulkRow.owner == psf.owner, BulkRow.psf_id == psf.id)
    jobs = select(JobRow.id).where(JobRow.owner == psf.owner, JobRow.phase.not_in(sorted(ENDED)))
    psfs = select(PsfRow.id).where(PsfRow.owner == psf.owner, PsfRow.id != psf.id)
    # The details of a fitted or corrected PSF name the PSFs from which it was made.
    in_details = cast(PsfRow.details, String).contains(psf.id)
    users: tuple[tuple[str, Select[str], str], ...] = (
        ("product", products, "delete that product first: `heliopsf product delete {id}`"),
        ("context", pins, "a context never changes, so its PSFs are kept"),
        (
            "bulk run",
            runs.where(BulkRow.phase.in_(sorted(OPEN))),
            "cancel that run first: `heliopsf bulk cancel {id}`",
        ),
        (
            "job",
            jobs.where(cast(JobRow.parameters, String).contains(psf.id)),
            "wait until the job has ended, or cancel it: `heliopsf job cancel {id}`",
        ),
        (
            "PSF",
            psfs.where(in_details),
            "that PSF was made from this one; delete it first: `heliopsf psf delete {id}`",
        ),
    )
    for kind, query, advice in users:
        user = session.scalars(query.limit(1)).first()
        if user is not None:
            shown = user[:12]  # every command accepts ids that are shortened in this way
            raise DataError(
                "psf-in-use",
                f"expected a PSF that nothing uses; {kind} {shown} uses PSF {psf.id}: {advice.format(id=shown)}",
            )
