"""The database behind a catalogue: tests on both kinds of databases, and rows that a test reads or writes itself."""

from __future__ import annotations

from typing import Any

import pytest
from sqlalchemy import Executable

from workers.catalogue.catalogue import Catalogue
from workers.catalogue.database import Database

# A test with this mark runs on both; others run on SQLite. It is for claims, leases, locks, clocks and plans of queries.
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
