"""Find the files of all owners to which the database refers.

A row refers to a file if the file's hash appears in any text or JSON column. The search therefore works for all
tables in the same way. The search may find hashes that are not hashes of files, for example the hash of a key. It
misses no file.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from typing import TypeVar

from sqlalchemy import JSON, String, Table, cast, literal, or_, select, tuple_

from workers.catalogue.bulk_tables import BulkItemRow
from workers.catalogue.database import Database
from workers.catalogue.owners import WITH_FILES
from workers.catalogue.tables import (
    Base,
    ImageRow,
    ProductRow,
    PsfRow,
    ReportRow,
    SolutionRow,
    TransitRow,
)

BATCH = 1000
Kept = ImageRow | TransitRow | PsfRow | ProductRow | ReportRow | SolutionRow
Row = TypeVar("Row", ImageRow, TransitRow, PsfRow, ProductRow, ReportRow, SolutionRow)
_DIGEST = re.compile(r"[0-9a-f]{64}")
# This table is very long. The tables of images and products also refer to all of its files.
_SKIPPED = frozenset({BulkItemRow.__tablename__})


class NamedFiles:
    """Finds the hashes of files in all rows."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def all(self, *, solutions_from: float = -math.inf) -> Iterator[str]:
        """Every hash in the database; a hash may occur more than once. Rows are read in batches.

        solutions_from: solutions that were stored before this time are left out.
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
                texts = [cast(one, String) for one in table.columns if isinstance(one.type, String | JSON)]
                for digest in digests - named:
                    contains = or_(*(text.contains(digest) for text in texts))
                    if session.execute(
                        select(literal(1)).select_from(table).where(contains).limit(1)
                    ).first():
                        named.add(digest)
        return frozenset(named)

    def kept(self, table: type[Row]) -> Iterator[Row]:
        """All rows of a table that refers to files. The rows are read in batches, so that no transaction stays open
        for long.
        """
        last: tuple[str, str] | None = None
        while True:
            query = select(table).order_by(table.owner, table.id).limit(BATCH)
            if last is not None:
                query = query.where(tuple_(table.owner, table.id) > last)
            with self._database.reading() as session:
                rows = session.scalars(query).all()
            yield from rows
            if len(rows) < BATCH:
                return
            last = (rows[-1].owner, rows[-1].id)

    def _in(self, table: Table, solutions_from: float) -> Iterator[str]:
        texts = [cast(one, String) for one in table.columns if isinstance(one.type, String | JSON)]
        if not texts:
            return
        with self._database.engine.execution_options(read_only=True).connect() as connection:
            query = select(*texts)
            if table is SolutionRow.__table__ and math.isfinite(solutions_from):
                query = query.where(table.c.created_at >= solutions_from)
            rows = connection.execution_options(stream_results=True, yield_per=BATCH).execute(query)
            for row in rows:
                for text in row:
                    if text:
                        yield from _DIGEST.findall(text)
