"""Which files the database names, whoever's they are.

A file is named where its hash stands in any text or JSON of any table, so that nothing has to be known of what tables
there are. That may be too much, as of a key's hash; it is never too little.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from sqlalchemy import JSON, String, Table, cast, select

from workers.catalogue.bulk_tables import BulkItemRow
from workers.catalogue.database import Database
from workers.catalogue.tables import Base

BATCH = 1000
_DIGEST = re.compile(r"[0-9a-f]{64}")
# Very many lines on what rows of images and products name already.
_PASSED_OVER = frozenset({BulkItemRow.__tablename__})


class NamedFiles:
    """Hashes of files, as rows have them."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def all(self) -> Iterator[str]:
        """Every hash that is named, some of them more than once; read a batch at a time."""
        for table in Base.metadata.sorted_tables:
            if table.name not in _PASSED_OVER:
                yield from self._in(table)

    def _in(self, table: Table) -> Iterator[str]:
        texts = [cast(one, String) for one in table.columns if isinstance(one.type, String | JSON)]
        if not texts:
            return
        with self._database.engine.execution_options(read_only=True).connect() as connection:
            rows = connection.execution_options(stream_results=True, yield_per=BATCH).execute(select(*texts))
            for row in rows:
                for text in row:
                    if text:
                        yield from _DIGEST.findall(text)
