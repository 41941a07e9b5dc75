"""Compare the revision of the database with the revision that this version of heliopsf needs, and upgrade the database.

A revision is a numbered state of the tables. The revisions are in ``workers/catalogue/migrations/versions``. Alembic
runs them; it is imported only when needed. A new database gets the present tables at once, without running revisions.

Any number of processes may start at the same moment. The first process that gets the lock of the database makes or
upgrades the tables in one transaction. The others wait, and then find that it is upgraded.
"""

from __future__ import annotations

import logging
import os
import sqlite3
import threading
import time
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from sqlalchemy import Connection, inspect, text

from workers.catalogue.database import Database
from workers.catalogue.tables import Base
from workers.settings import software_version

if TYPE_CHECKING:
    from alembic.config import Config

REVISIONS = Path(__file__).parent / "migrations"
LOCK = 0x68656C696F  # PostgreSQL's advisory lock for upgrades: "helio"
# Alembic stores the running upgrade in a module variable, so this process can run only one upgrade at a time.
_ONE_AT_A_TIME = threading.Lock()

log = logging.getLogger(__name__)
# unversioned: tables without a revision. obsolete: a revision before the first one that this version knows.
State = Literal["empty", "unversioned", "obsolete", "older", "current", "newer"]


class SchemaError(Exception):
    """This version cannot use or upgrade the database; the message gives the reason."""


@dataclass(frozen=True)
class SchemaStatus:
    """The revision of a database, and the revision that this version needs."""

    revision: str | None  # None: the database has no revision
    wanted: str
    state: State

    @property
    def refusal(self) -> str | None:
        """Why this version can neither use nor upgrade the database, and what to do; None if it can."""
        match self.state:
            case "newer":
                return (
                    f"the database is at revision {self.revision}, which this version does not know: heliopsf "
                    f"{software_version()} knows revisions up to {self.wanted}; use the version that made the database"
                )
            case "obsolete":
                return (
                    f"the database is at revision {self.revision} of a development version, which heliopsf "
                    f"{software_version()} cannot upgrade: upgrade it first with the last version that can (see "
                    "Upgrading in docs/operating.md), or use an empty database"
                )
            case "unversioned":
                return (
                    "expected an empty database or one of heliopsf; this one has tables with names of heliopsf's "
                    "tables, but without a revision: use an empty database"
                )
        return None


@dataclass(frozen=True)
class SchemaFaults:
    """The tables, columns and indexes of this version that are missing in the database."""

    tables: tuple[str, ...]
    columns: tuple[str, ...]
    indexes: tuple[str, ...]
    empty: bool  # the database has none of the tables


class Schema:
    """Inspects the tables of the database and upgrades them."""

    def __init__(self, database: Database, revisions: Path = REVISIONS) -> None:
        """The folder ``revisions`` has an ``env.py`` and a folder ``versions``, as Alembic expects them."""
        self._database = database
        self._revisions = revisions

    def upgrade(self) -> Path | None:
        """Make the tables of an empty database, or upgrade a database that has an older revision.

        Before an upgrade, a database in a file of SQLite is copied, because older versions cannot read the new tables.
        Returns the copy; None if there was nothing to copy. Raises ``SchemaError`` if the database belongs to a later
        version or to a development version that cannot be upgraded, if its tables are not those of heliopsf, or if it
        cannot be copied.
        """
        from alembic import command

        if self.status().state == "current":
            return None
        copy = None
        unhurried = self._database.engine.execution_options(unhurried=True)
        with _ONE_AT_A_TIME, unhurried.begin() as connection:
            if not self._database.sqlite:  # on SQLite the transaction already holds the write lock
                connection.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": LOCK})
            status = self._status(connection)
            if status.refusal:
                raise SchemaError(status.refusal)
            config = _config(self._revisions)
            config.attributes["connection"] = connection
            if status.state == "empty":
                Base.metadata.create_all(connection)
                command.stamp(config, "head")
            else:
                if status.state == "older" and self._database.file is not None:
                    copy = _copy(self._database.file, f"revision-{status.revision}")
                command.upgrade(config, "head")  # does nothing if another process has upgraded the database
        if status.state == "empty":
            log.info("database: created, revision %s", status.wanted)
        elif status.state == "older":
            before = "" if copy is None else f"; the database as it was: {copy}"
            log.info("database: upgraded from %s to %s%s", status.revision, status.wanted, before)
        return copy

    def check(self) -> None:
        """Raise ``SchemaError`` if the database is not at the revision of this version. The message says what to do."""
        status = self.status()
        if status.refusal:
            raise SchemaError(status.refusal)
        if status.state != "current":
            there = "empty" if status.state == "empty" else f"at revision {status.revision}"
            raise SchemaError(
                f"expected a database at revision {status.wanted}, which heliopsf {software_version()} needs; it is "
                f"{there}: upgrade it with `heliopsf database upgrade`, or start a server of this version"
            )

    def mend(self) -> None:
        """Create the missing tables and indexes of a database that is at the revision of this version."""
        with self._database.engine.execution_options(unhurried=True).begin() as connection:
            Base.metadata.create_all(connection)
            for table in Base.metadata.sorted_tables:
                for index in table.indexes:
                    index.create(connection, checkfirst=True)

    def status(self) -> SchemaStatus:
        """The revision of the database. Does not change the database."""
        with self._database.engine.execution_options(read_only=True).connect() as connection:
            return self._status(connection)

    def faults(self) -> SchemaFaults:
        """The missing tables, columns and indexes. Does not change the database."""
        with self._database.engine.execution_options(read_only=True).connect() as connection:
            return _faults(connection)

    def _status(self, connection: Connection) -> SchemaStatus:
        from alembic.runtime.migration import MigrationContext

        *earlier, wanted = _numbers(self._revisions)
        revision = MigrationContext.configure(connection).get_current_revision()
        state: State
        if revision is None:
            state = "empty" if _faults(connection).empty else "unversioned"
        elif revision == wanted:
            state = "current"
        elif revision in earlier:
            state = "older"
        else:
            state = "newer" if revision > wanted else "obsolete"
        return SchemaStatus(revision, wanted, state)


def _copy(file: Path, what: str) -> Path:
    """Copy a database of SQLite to a new file beside it, as it was before the transaction that holds the write lock.

    Raises ``SchemaError``; there is then no copy.
    """
    copy = file.with_name(f"{file.stem}.{what}.{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}{file.suffix}")
    partial = copy.with_name(f"{copy.name}.partial")
    partial.unlink(missing_ok=True)
    source = sqlite3.connect(file)
    try:
        partial.touch(mode=0o600)
        source.execute("VACUUM INTO ?", (str(partial),))
        with partial.open("rb") as written:
            os.fsync(written.fileno())
        partial.replace(copy)
    except (sqlite3.Error, OSError) as error:
        partial.unlink(missing_ok=True)
        raise SchemaError(
            f"expected to copy the database to {copy} before its upgrade; got: {error}: make room there, or let this "
            "user write there; the database is as it was"
        ) from error
    finally:
        source.close()
    return copy


def _config(revisions: Path) -> Config:
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(revisions).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    return config


@cache
def _numbers(revisions: Path) -> tuple[str, ...]:
    """The numbers of all revisions in a folder; this version needs the last one."""
    from alembic.script import ScriptDirectory

    return tuple(
        sorted(one.revision for one in ScriptDirectory.from_config(_config(revisions)).walk_revisions())
    )


def _faults(connection: Connection) -> SchemaFaults:
    inspector = inspect(connection)
    there = set(inspector.get_table_names())
    tables, columns, indexes = [], [], []
    for table in Base.metadata.sorted_tables:
        if table.name not in there:
            tables.append(table.name)
            continue
        has = {column["name"] for column in inspector.get_columns(table.name)}
        columns += [f"{table.name}.{column.name}" for column in table.columns if column.name not in has]
        known = {index["name"] for index in inspector.get_indexes(table.name)}
        indexes += [str(index.name) for index in table.indexes if index.name not in known]
    empty = len(tables) == len(Base.metadata.tables)
    return SchemaFaults(tuple(tables), tuple(columns), tuple(sorted(indexes)), empty)
