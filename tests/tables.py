"""A database with the tables of this version, made once and copied.

This saves time: the database revisions have their own tests.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from workers.catalogue.catalogue import Catalogue
from workers.catalogue.schema import Schema

RUN_REVISIONS = Schema.upgrade


@contextmanager
def copied_tables(folder: Path) -> Iterator[None]:
    """While this context is active, a new SQLite database of this process starts as a copy of one in ``folder``."""
    made, one_at_a_time = folder / "made.sqlite", threading.Lock()

    def upgrade(schema: Schema) -> Path | None:
        database = schema._database.engine.url.database
        if schema._database.sqlite and database not in (None, ":memory:"):
            with one_at_a_time:
                if not made.exists():
                    first = Catalogue(f"sqlite:///{made}")
                    RUN_REVISIONS(first.schema)
                    first.close()  # this merges the write-ahead log into the file, so the file is complete
                target = Path(str(database))
                if not target.exists() and target.parent.is_dir():
                    partial = target.with_suffix(".partial")
                    partial.write_bytes(made.read_bytes())
                    os.replace(partial, target)
        return RUN_REVISIONS(schema)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Schema, "upgrade", upgrade)
        yield
