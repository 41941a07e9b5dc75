"""The database's revision: what it is at, what this version wants, and the way from one to the other.

Revisions are in ``workers/migrations/versions`` and run by alembic, which is loaded where it is asked. Any number of
processes may start at once: the first one to hold the database's lock upgrades it in one transaction, the others wait
and find it done.
"""

from __future__ import annotations

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
LOCK = 0x68656C696F  # of PostgreSQL's advisory locks the one that upgrades take: "helio"
# Alembic keeps the environment that runs in a variable of its module: one upgrade at a time in this process.
_ONE_AT_A_TIME = threading.Lock()

State = Literal["empty", "unversioned", "older", "current", "newer"]


class SchemaError(Exception):
    """The database is not one that this version can bring to its own tables; the message says why."""


@dataclass(frozen=True)
class SchemaStatus:
    """The revision that a database is at, and the one that this version works with."""

    revision: str | None  # none: the database says none
    wanted: str
    state: State


@dataclass(frozen=True)
class SchemaFaults:
    """What the database lacks of what this version works with."""

    tables: tuple[str, ...]
    columns: tuple[str, ...]
    indexes: tuple[str, ...]
    empty: bool  # there is none of our tables


class Schema:
    """Looks at the database's tables, and brings them to this version's."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def upgrade(self) -> None:
        """Bring the database, new, older or made before there were revisions, to this version's.

        Raises ``SchemaError`` where it is of a later version, or holds tables that were never ours.
        """
        from alembic import command

        if self.status().state == "current":
            return
        with _ONE_AT_A_TIME, self._database.engine.begin() as connection:
            if not self._database.sqlite:  # SQLite's write lock is held by now
                connection.execute(text("SELECT pg_advisory_xact_lock(:lock)"), {"lock": LOCK})
            status = _status(connection)
            if status.state == "newer":
                raise SchemaError(_too_new(status))
            if status.state == "unversioned":
                _check_baseline(connection)
            config = _config()
            config.attributes["connection"] = connection
            command.upgrade(config, "head")

    def check(self) -> None:
        """Raise ``SchemaError``, saying what to do, where the database is not at this version's revision."""
        status = self.status()
        if status.state == "newer":
            raise SchemaError(_too_new(status))
        if status.state != "current":
            found = {"empty": "empty", "unversioned": "at no revision"}.get(
                status.state, f"at revision {status.revision}"
            )
            raise SchemaError(
                f"the database is {found}; heliopsf {software_version()} works with revision {status.wanted}: "
                "bring it there with `heliopsf database upgrade`, or by starting a server of this version"
            )

    def mend(self) -> None:
        """Make again the tables and indexes that somebody removed from a database at this version's revision."""
        with self._database.engine.begin() as connection:
            make_missing(Base.metadata, connection)

    def status(self) -> SchemaStatus:
        """The database's revision; nothing is made."""
        with self._database.engine.execution_options(read_only=True).connect() as connection:
            return _status(connection)

    def faults(self) -> SchemaFaults:
        """What the database lacks; nothing is made."""
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
    """The revision that this version works with, and all that it knows."""
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
        f"the database is at revision {status.revision}, which is not known here: heliopsf "
        f"{software_version()} knows revisions up to {status.wanted}; use the version that made it"
    )


def _check_baseline(connection: Connection) -> None:
    """Tables without a revision are adopted where they have the columns that the first revision gives them.

    Tables and indexes that are not there are made by it: versions before it made them at each start.
    """
    from workers.catalogue.migrations.versions.r0001_baseline import METADATA as BASELINE

    lacking = _faults(BASELINE, connection).columns
    if lacking:
        raise SchemaError(
            "the database has tables without a revision: expected those of heliopsf 0.1, got tables without "
            f"{', '.join(lacking)}; give this version an empty database"
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
