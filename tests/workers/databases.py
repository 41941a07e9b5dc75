"""The database behind a catalogue: tests on both kinds of databases, and rows that a test reads or writes itself."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from sqlalchemy import Executable, create_engine, text

from workers.catalogue.catalogue import Catalogue
from workers.catalogue.database import Database

# A test with this mark runs on both; others run on SQLite. It is for claims, leases, locks, clocks and plans of
# queries.
BOTH = pytest.mark.parametrize("catalogue", ["sqlite", "postgresql"], indirect=True)


def database(catalogue: Catalogue) -> Database:
    """The database of a catalogue."""
    return catalogue._database


def change(catalogue: Catalogue, *statements: Executable) -> None:
    """Execute statements in one transaction."""
    with database(catalogue).engine.begin() as connection:
        for statement in statements:
            connection.execute(statement)


def rows(catalogue: Catalogue, query: Any) -> list[Any]:
    """The first column of each row that a query finds."""
    with database(catalogue).reading() as session:
        return list(session.scalars(query))


def add(catalogue: Catalogue, *new: Any) -> None:
    """Insert rows as they are, without counting their bytes."""
    with database(catalogue).writing.begin() as session:
        session.add_all(new)


@contextmanager
def reading_only(catalogue: Catalogue) -> Iterator[None]:
    """PostgreSQL accepts no changes, as a standby does. Connections that the catalogue has open are closed."""
    url = database(catalogue).engine.url
    admin = create_engine(url.set(database="postgres"), isolation_level="AUTOCOMMIT")

    def change(statement: str) -> None:
        with admin.connect() as connection:
            connection.execute(text(f"ALTER DATABASE {url.database} {statement}"))
        catalogue.close()

    change("SET default_transaction_read_only = on")
    try:
        yield
    finally:
        change("RESET default_transaction_read_only")
        admin.dispose()
