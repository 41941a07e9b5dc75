"""The database connection: an engine for many small writers, and two kinds of transactions."""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar, TypeVarTuple

from sqlalchemy import (
    ColumnElement,
    Connection,
    Delete,
    Double,
    Engine,
    Row,
    Select,
    Update,
    and_,
    create_engine,
    event,
    func,
    select,
    tuple_,
    update,
)
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.engine import CursorResult
from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from sqlalchemy.ext.compiler import compiles
from sqlalchemy.orm import DeclarativeBase, InstrumentedAttribute, Session, sessionmaker

from psfcore.errors import DataError

PATIENCE_S = 30.0  # longest time to wait for other writers of SQLite
READ_ONLY = "25006"  # sqlstate of a change in a database that only reads, such as a standby
# Classes of sqlstates: a lost connection, a transaction that must be run again, no resources, the operator's
# intervention (a shutdown, a start, a limit on time), and errors of the system below PostgreSQL.
_AWAY = frozenset({"08", "40", "53", "57", "58"})
Table = TypeVar("Table")
Value = TypeVar("Value")
Columns = TypeVarTuple("Columns")
# The columns created_at and id of a table, by which its rows are sorted.
Dates = tuple[InstrumentedAttribute[float], InstrumentedAttribute[str]]


class Now(ColumnElement[float]):
    """The time of the database's clock, in seconds since 1970. All machines share this clock.

    The value is the time at which the SQL statement began. On SQLite it is rounded to milliseconds.
    """

    inherit_cache = True
    type = Double()


@compiles(Now)
def _now(*_: object, **__: object) -> str:
    # PostgreSQL can use an index with this clock, because it is constant within a statement.
    return "CAST(extract(epoch FROM statement_timestamp()) AS double precision)"


@compiles(Now, "sqlite")
def _now_of_sqlite(*_: object, **__: object) -> str:
    return "((julianday('now') - 2440587.5) * 86400.0)"


class Database:
    """An engine and its sessions. ``writing`` takes SQLite's write lock at the start; ``reading`` takes no lock.

    Attributes
    ----------
    now
        The time of the database's clock, as an SQL expression.
    """

    now = Now()

    def __init__(self, url: str) -> None:
        self.engine = open_engine(url)
        self.writing: sessionmaker[Session] = sessionmaker(self.engine, expire_on_commit=False)
        self.reading: sessionmaker[Session] = sessionmaker(
            self.engine.execution_options(read_only=True), expire_on_commit=False
        )

    @property
    def sqlite(self) -> bool:
        """Whether the database is SQLite."""
        return self.engine.dialect.name == "sqlite"

    @property
    def file(self) -> Path | None:
        """The file of an SQLite database; None if the database has no file."""
        name = self.engine.url.database
        return Path(name) if self.sqlite and name and name != ":memory:" else None

    def clock(self) -> float:
        """The time of the database's clock, in seconds since 1970."""
        with self.reading() as session:
            return session.scalars(select(self.now)).one()

    def count(self, table: type[DeclarativeBase], *conditions: ColumnElement[bool]) -> int:
        """The number of rows that meet all conditions."""
        return self.first(select(func.count()).select_from(table).where(*conditions)) or 0

    def all(self, query: Select[Value]) -> Sequence[Value]:
        """All rows, or values of the only column, that a query selects."""
        with self.reading() as session:
            return session.scalars(query).all()

    def first(self, query: Select[Value]) -> Value | None:
        """The first row, or value of the only column, that a query selects; None if there is none."""
        with self.reading() as session:
            return session.scalars(query.limit(1)).first()

    def lines(self, query: Select[*Columns]) -> Sequence[Row[*Columns]]:
        """The values of all columns that a query selects, row by row."""
        with self.reading() as session:
            return session.execute(query).all()

    def any(self, query: Select[Value]) -> bool:
        """Whether a query selects a row."""
        return self.first(query) is not None

    def row(self, table: type[Table], key: str | tuple[str, str]) -> Table | None:
        """The row with this primary key, or None."""
        with self.reading() as session:
            return session.get(table, key)

    def change(self, statement: Update | Delete) -> int:
        """Run one UPDATE or DELETE in a separate transaction; returns the number of changed rows."""
        with self.writing.begin() as session:
            return execute(session, statement)

    def set(
        self, table: type[DeclarativeBase], conditions: Sequence[ColumnElement[bool]], **values: object
    ) -> bool:
        """Set columns of the rows that meet all conditions, by one UPDATE; returns whether it changed a row."""
        return self.change(update(table).where(*conditions).values(**values)) > 0


class Queries:
    """Queries on the tables of one subject. Each method of a subclass is one transaction."""

    def __init__(self, database: Database) -> None:
        self._database = database


def execute(session: Session, statement: Update | Delete) -> int:
    """Run one UPDATE or DELETE in a transaction; returns the number of changed rows."""
    result = session.execute(statement.execution_options(synchronize_session=False))
    assert isinstance(result, CursorResult)
    return result.rowcount


def sqlstate_of(error: BaseException) -> str | None:
    """The code by which PostgreSQL names the cause of an error; None if there is no code."""
    return getattr(getattr(error, "orig", None), "sqlstate", None)


def is_away(error: BaseException) -> bool:
    """Whether an error says that the database could not do its work now, so that the same call may succeed later.

    The error then tells nothing about the rows. PostgreSQL names the cause in the sqlstate. Without one, nobody
    answered, or the database is SQLite.
    """
    if isinstance(error, PoolTimeoutError):
        return True
    if not isinstance(error, DBAPIError):
        return False
    sqlstate = sqlstate_of(error)
    if sqlstate is None:
        return isinstance(error, OperationalError | InterfaceError)
    return sqlstate == READ_ONLY or sqlstate[:2] in _AWAY


def newest_first(
    query: Select[*Columns], dates: Dates, limit: int, after: tuple[float, str] | None = None
) -> Select[*Columns]:
    """A page of a query for rows of a table, newest first.

    Parameters
    ----------
    dates
        The columns created_at and id of the table.
    after
        (created_at, id) of the last row of the previous page; None for the first page.
    """
    if after is not None:
        query = query.where(tuple_(*dates) < after)
    return query.order_by(*(column.desc() for column in dates)).limit(limit)


def insert_into(session: Session, table: type[DeclarativeBase]) -> postgresql.Insert | sqlite.Insert:
    """An INSERT with the method ``on_conflict_do_nothing``, which each database has in its own dialect."""
    insert = sqlite.insert if session.get_bind().dialect.name == "sqlite" else postgresql.insert
    return insert(table)


def begins_with(column: InstrumentedAttribute[str], digits: str) -> ColumnElement[bool]:
    """The condition that an id begins with these hexadecimal digits. The condition is written so that the database
    can use an index.
    """
    return and_(column >= digits, column < digits + "g")


def several_ids_fit(digits: str, candidates: Sequence[str]) -> DataError:
    """The error about the first digits of an id with which several ids begin."""
    return DataError(
        "several-ids-fit",
        f"expected the first digits of one id; got {digits}, with which these ids begin: {', '.join(candidates)}: "
        "write more digits",
    )


def open_engine(url: str) -> Engine:
    """Make an engine, with the settings that the database needs for many small concurrent writers."""
    if url.startswith("postgresql"):
        from workers.catalogue.postgres import open_postgres  # SQLite needs no psycopg

        return open_postgres(url, json_serializer=strict_json)
    if not url.startswith("sqlite"):
        return create_engine(url, pool_pre_ping=True, json_serializer=strict_json)
    engine = create_engine(url, connect_args={"timeout": PATIENCE_S}, json_serializer=strict_json)

    @event.listens_for(engine, "connect")
    def _pragmas(connection: sqlite3.Connection, _record: object) -> None:
        # The driver would send BEGIN too late for a compare-and-set; see _begin.
        connection.isolation_level = None
        _write_ahead(connection)
        connection.execute("PRAGMA synchronous=FULL")
        connection.execute("PRAGMA foreign_keys=ON")

    @event.listens_for(engine, "begin")
    def _begin(connection: Connection) -> None:
        # IMMEDIATE waits for the write lock at the start. Without it, a transaction that reads first and writes later
        # would fail with "database is locked" instead of waiting. Readers need no lock.
        reads = connection.get_execution_options().get("read_only", False)
        connection.exec_driver_sql("BEGIN" if reads else "BEGIN IMMEDIATE")

    return engine


def _write_ahead(connection: sqlite3.Connection) -> None:
    """Switch SQLite to a write-ahead log.

    If several processes create a database at the same moment, only one succeeds at once; the others must try again.
    """
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            connection.execute("PRAGMA journal_mode=WAL")
            return
        # The timeout of the connection does not apply to this statement.
        except sqlite3.OperationalError as error:
            if "locked" not in str(error) or time.monotonic() > deadline:
                raise
            time.sleep(0.02)


def strict_json(value: object) -> str:
    """Write JSON. Raises ValueError for NaN and infinity: PostgreSQL refuses them, and clients cannot read them."""
    return json.dumps(value, allow_nan=False)
