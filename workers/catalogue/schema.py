"""Compare the revision of the database with the revision that this version of heliopsf needs, and upgrade the database.

A revision is a numbered state of the tables. The revisions are in ``workers/catalogue/migrations/versions``. Alembic runs
them; it is imported only when needed. Any number of processes may start at the same moment. The first process that gets
the lock of the database upgrades the database in one transaction. The others wait, and then find that it is upgraded.
"""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sqlalchemy import Connection, MetaData, inspect, text

from workers.catalogue.database import Database, make_missing
from workers.catalogue.tables import Base
from workers.settings import software_version

if TYPE_CHECKING:
    from alembic.config import Config

REVISIONS = Path(__file__).parent / "migrations"
LOCK = 0x68656C696F  # PostgreSQL's advisory lock for upgrades: "helio"
# Alembic stores the running upgrade in a module variable, so this process can run only one upgrade at a time.
_ONE_AT_A_TIME = threading.Lock()

log = logging.getLogger(__name__)
State = Literal["empty", "unversioned", "older", "current", "newer"]


class SchemaError(Exception):
    """This version cannot use or upgrade the database; the message gives the reason."""


@dataclass(frozen=True)
class SchemaStatus:
    """The revision of a database, and the revision that this version needs."""

    revision: str | None  # None: the database has no revision
    wanted: str
    state: State


@dataclass(frozen=True)
class SchemaFaults:
    """The tables, columns and indexes of this version that are missing in the database."""

    tables: tuple[str, ...]
    columns: tuple[str, ...]
    indexes: tuple[str, ...]
    empty: bool  # the database has none of the tables


class Schema:
    """Inspects the tables of the database and upgrades them."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def upgrade(self) -> None:
        """Upgrade a database that is empty, has an older revision, or was made before revisions existed.

        Raises ``SchemaError`` if the database belongs to a later version, or if its tables are not those of heliopsf.
        """
        from alembic import command

        if self.status().state == "current":
            return
        with _ONE_AT_A_TIME, self._database.engine.begin() as connection:
            if not self._database.sqlite:  # on SQLite the transaction already holds the write lock
                connection.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": LOCK})
            status = _status(connection)
            if status.state == "newer":
                raise SchemaError(_too_new(status))
            if status.state == "unversioned":
                _check_baseline(connection)
            config = _config()
            config.attributes["connection"] = connection
            command.upgrade(config, "head")
        if status.state == "empty":
            log.info("database: created, revision %s", status.wanted)
        else:
            log.info("database: upgraded from %s to %s", status.revision or "no revision", status.wanted)

    def create(self) -> None:
        """Create all tables of an empty database that only this process uses.

        This is quicker than ``upgrade``. The database gets no revision, so no other version can upgrade it.
        """
        with self._database.engine.begin() as connection:
            make_missing(Base.metadata, connection)

    def check(self) -> None:
        """Raise ``SchemaError`` if the database is not at the revision of this version. The message says what to do."""
        status = self.status()
        if status.state == "newer":
            raise SchemaError(_too_new(status))
        if status.state != "current":
            found = {"empty": "empty", "unversioned": "without a revision"}.get(
                status.state, f"at revision {status.revision}"
            )
            raise SchemaError(
                f"expected a database at revision {status.wanted}, which heliopsf {software_version()} needs; it is {found}: "
                "upgrade it with `heliopsf database upgrade`, or start a server of this version"
            )

    def mend(self) -> None:
        """Create the missing tables and indexes of a database that is at the revision of this version."""
        with self._database.engine.begin() as connection:
            make_missing(Base.metadata, connection)

    def status(self) -> SchemaStatus:
        """The revision of the database. Does not change the database."""
        with self._database.engine.execution_options(read_only=True).connect() as connection:
            return _status(connection)

    def faults(self) -> SchemaFaults:
        """The missing tables, columns and indexes. Does not change the database."""
        with self._database.engine.execution_options(read_only=True).connect() as connection:
            return _faults(Base.metadata, connection)


def _config() -> Config:
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(REVISIONS).replace("%", "%%"))
    config.set_main_option("path_separator", "os")
    return config


@lru_cache(maxsize=1)
def _revisions() -> tuple[str, frozenset[str]]:
    """The revision that this version needs, and all revisions that it knows."""
    from alembic.script import ScriptDirectory

    script = ScriptDirectory.from_config(_config())
    wanted = script.get_current_head()
    assert wanted is not None
    return wanted, frozenset(one.revision for one in script.walk_revisions())


def _status(connection: Connection) -> SchemaStatus:
    from alembic.runtime.migration import MigrationContext

    wanted, known = _revisions()
    revision = MigrationContext.configure(connection).get_current_revision()
    state: State
    if revision is None:
        from workers.catalogue.migrations.versions.r0001_baseline import METADATA as BASELINE

        state = "empty" if _faults(BASELINE, connection).empty else "unversioned"
    elif revision not in known:
        state = "newer"
    else:
        state = "current" if revision == wanted else "older"
    return SchemaStatus(revision, wanted, state)


def _too_new(status: SchemaStatus) -> str:
    return (
        f"the database is at revision {status.revision}, which this version does not know: heliopsf "
        f"{software_version()} knows revisions up to {status.wanted}; use the version that made the database"
    )


def _check_baseline(connection: Connection) -> None:
    """Check a database that has tables but no revision: the tables must have all columns of the first revision.

    Raises ``SchemaError``. Missing tables and indexes are allowed, because the first revision creates them.
    """
    from workers.catalogue.migrations.versions.r0001_baseline import METADATA as BASELINE

    lacking = _faults(BASELINE, connection).columns
    if lacking:
        raise SchemaError(
            "expected an empty database or one of heliopsf; this one has tables without a revision and without the columns "
            f"{', '.join(lacking)}: give this version an empty database"
        )


def _faults(metadata: MetaData, connection: Connection) -> SchemaFaults:
    found: Any = inspect(connection)
    there = set(found.get_table_names())
    tables, columns, indexes = [], [], []
    for table in metadata.sorted_tables:
        if table.name not in there:
            tables.append(table.name)
            continue
        has = {column["name"] for column in found.get_columns(table.name)}
        columns += [f"{table.name}.{column.name}" for column in table.columns if column.name not in has]
        known = {index["name"] for index in found.get_indexes(table.name)}
        indexes += [str(index.name) for index in table.indexes if index.name not in known]
    ours = len(metadata.sorted_tables)
    return SchemaFaults(tuple(tables), tuple(columns), tuple(sorted(indexes)), len(tables) == ours)
