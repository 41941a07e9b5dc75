"""The database's revision: empty, older, newer and foreign databases, and processes that start at once."""

from __future__ import annotations

import errno
import logging
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from sqlalchemy import insert, inspect, text
from sqlalchemy.exc import DatabaseError

from tests.tables import RUN_REVISIONS
from tests.whole.stack import Missing, postgres_database
from tests.workers.databases import change, database, rows
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.schema import REVISIONS, Schema, SchemaError
from workers.catalogue.tables import Base, JobRow, WorkerRow
from workers.settings import Settings

LATER = """
import sqlalchemy as sa
from alembic import op
revision, down_revision = "0022", "0021"
def upgrade():
    op.add_column("workers", sa.Column("host", sa.String, server_default="-here"))
"""


@pytest.fixture(scope="module")
def postgres_url() -> Iterator[str]:
    """An empty database, which the one test that fills it leaves empty."""
    try:
        with postgres_database() as url:
            yield Settings(database_url=url).catalogue_url
    except Missing as missing:
        pytest.skip(str(missing))


@pytest.fixture(params=["sqlite", "postgresql"])
def catalogue(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Catalogue]:
    """On an empty database, whose upgrades run the revisions."""
    monkeypatch.setattr(Schema, "upgrade", RUN_REVISIONS)
    postgresql = request.param == "postgresql"
    url = request.getfixturevalue("postgres_url") if postgresql else f"sqlite:///{tmp_path / 'c.sqlite'}"
    catalogue = Catalogue(url)
    yield catalogue
    if postgresql:
        # A transaction that a test left open would let this wait for ever.
        again = ("SET LOCAL lock_timeout = '10s'", "DROP SCHEMA public CASCADE", "CREATE SCHEMA public")
        change(catalogue, *map(text, again))
    catalogue.close()


sqlite_alone = pytest.mark.parametrize("catalogue", ["sqlite"], indirect=True)


def differences(catalogue: Catalogue) -> list[object]:
    """Between the database and the tables that the code works with, as alembic sees them."""
    options = {"compare_type": True, "compare_server_default": True}
    with database(catalogue).engine.connect() as connection:
        context = MigrationContext.configure(connection, opts=options)
        return list(compare_metadata(context, Base.metadata))


def said(caplog: pytest.LogCaptureFixture) -> list[str]:
    """What the schema logged. Alembic logs too, if an earlier test of the process has let it."""
    return [record.message for record in caplog.records if record.name == "workers.catalogue.schema"]


def test_an_empty_database_gets_its_tables(catalogue: Catalogue, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "workers.catalogue.schema")
    with pytest.raises(SchemaError, match="it is empty: upgrade it with `heliopsf database upgrade`"):
        catalogue.schema.check()
    assert catalogue.schema.status().state == "empty", "it stays so"
    catalogue.upgrade()
    catalogue.schema.check()
    status = catalogue.schema.status()
    assert status.state == "current" and differences(catalogue) == []
    assert said(caplog) == [f"database: created, revision {status.wanted}"]


def later_schema(catalogue: Catalogue, folder: Path) -> Schema:
    """The schema of a later version, which has one more revision."""
    shutil.copytree(REVISIONS, folder / "later")
    (folder / "later" / "versions" / "r0022_later.py").write_text(LATER)
    return Schema(database(catalogue), folder / "later")


def test_an_older_database_is_upgraded_with_its_data(
    catalogue: Catalogue, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    catalogue.upgrade()
    worker = {"name": "w", "started_at": 1.0, "heartbeat_at": 2.0, "version": "0.1.0"}
    change(catalogue, insert(WorkerRow).values(worker))
    later = later_schema(catalogue, tmp_path)
    assert later.status().state == "older"
    with pytest.raises(SchemaError, match=r"at revision 0022.*it is at revision 0021.*database upgrade"):
        later.check()
    caplog.set_level(logging.INFO, "workers.catalogue.schema")
    caplog.clear()
    copy = later.upgrade()
    assert later.upgrade() is None
    assert later.status().state == "current" and catalogue.schema.status().state == "newer"
    [line] = said(caplog)
    assert line.startswith("database: upgraded from 0021 to 0022")
    if database(catalogue).sqlite:
        assert copy is not None and line.endswith(str(copy)) and copy.stat().st_mode & 0o777 == 0o600
        old = Catalogue(f"sqlite:///{copy}")
        assert old.schema.status().state == "current", "this version, which is the older one, reads it"
        assert rows(old, text("SELECT name FROM workers")) == ["w"]
        old.close()
    else:
        assert copy is None
    assert rows(catalogue, text("SELECT name || host FROM workers")) == ["w-here"]


def test_the_rows_of_revision_0020_get_the_time_of_their_last_change(catalogue: Catalogue) -> None:
    catalogue.upgrade()
    row = {"owner": "o", "kind": "psf-build", "parameters": {}, "phase": "COMPLETED", "created_at": 1.0}
    jobs = [row | {"id": str(end), "request_key": str(end), "ended_at": end} for end in (None, 2.0)]
    change(catalogue, *(insert(JobRow).values(**one) for one in jobs))
    for table in ("jobs", "bulks"):
        before = (
            f"DROP INDEX {table}_changed",
            f"ALTER TABLE {table} DROP COLUMN changed_at",
            f"CREATE INDEX {table}_ended ON {table} (owner, ended_at, id)",
        )
        change(catalogue, *map(text, before))
    change(catalogue, text("UPDATE alembic_version SET version_num = '0020'"))
    catalogue.upgrade()
    assert catalogue.schema.status().state == "current" and differences(catalogue) == []
    assert rows(catalogue, text("SELECT changed_at FROM jobs ORDER BY changed_at")) == [1.0, 2.0]


@sqlite_alone
def test_a_database_that_cannot_be_copied_is_not_upgraded(catalogue: Catalogue, tmp_path: Path) -> None:
    catalogue.upgrade()
    later = later_schema(catalogue, tmp_path)
    before = {file.name for file in tmp_path.iterdir()}

    def no_room(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.MonkeyPatch.context() as full:
        full.setattr("workers.catalogue.schema.os.fsync", no_room)
        with pytest.raises(SchemaError, match=r"to copy the database to .*No space left.*make room there"):
            later.upgrade()
    assert later.status().state == "older" and {file.name for file in tmp_path.iterdir()} == before


@sqlite_alone
def test_a_database_that_cannot_be_upgraded_is_refused_and_left_alone(catalogue: Catalogue) -> None:
    change(catalogue, text("CREATE TABLE images (id VARCHAR(64) PRIMARY KEY, pixels TEXT)"))
    assert catalogue.schema.status().state == "unversioned"
    for use in (catalogue.upgrade, catalogue.schema.check):
        with pytest.raises(SchemaError, match=r"without a revision: use an empty database"):
            use()
    assert inspect(database(catalogue).engine).get_table_names() == ["images"]
    change(catalogue, text("DROP TABLE images"))
    catalogue.upgrade()
    for revision, state, words in (
        ("9999", "newer", "at revision 9999.*knows revisions up to 0.*use the version that made"),
        ("0018", "obsolete", "at revision 0018 of a development version.*upgrade it first"),
    ):
        change(catalogue, text(f"UPDATE alembic_version SET version_num = '{revision}'"))
        assert catalogue.schema.status().state == state
        for use in (catalogue.upgrade, catalogue.schema.check):
            with pytest.raises(SchemaError, match=words):
                use()
        assert catalogue.schema.status().revision == revision


def test_an_upgrade_that_fails_leaves_nothing_behind(catalogue: Catalogue) -> None:
    """An upgrade is one transaction: tables that it made go if a later statement fails."""
    change(catalogue, text("CREATE TABLE jobs_tallied (id INTEGER PRIMARY KEY)"))  # the name of an index
    with pytest.raises(DatabaseError, match="already"):
        catalogue.upgrade()
    assert inspect(database(catalogue).engine).get_table_names() == ["jobs_tallied"]


@sqlite_alone
def test_a_database_gets_back_the_indexes_that_it_lacks(catalogue: Catalogue) -> None:
    catalogue.upgrade()
    change(catalogue, text("DROP INDEX jobs_tallied"))
    assert catalogue.schema.faults().indexes == ("jobs_tallied",)
    catalogue.schema.mend()
    names = {index["name"] for index in inspect(database(catalogue).engine).get_indexes("jobs")}
    assert "jobs_tallied" in names and catalogue.schema.faults().indexes == ()


STARTS = """
import sys
from workers.catalogue.catalogue import Catalogue
catalogue = Catalogue(sys.argv[1])
print("ready", flush=True)
sys.stdin.readline()
catalogue.upgrade()
print(catalogue.schema.status().state, catalogue.schema.faults().tables)
"""


def test_processes_that_start_at_once_make_one_upgrade(catalogue: Catalogue) -> None:
    url = database(catalogue).engine.url.render_as_string(hide_password=False)
    command = [sys.executable, "-c", STARTS, url]
    pipe = subprocess.PIPE
    processes = [subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) for _ in range(2)]
    for process in processes:
        assert process.stdout is not None and process.stdout.readline() == "ready\n"
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    outputs = [process.communicate(timeout=60)[0].strip() for process in processes]
    assert outputs == ["current ()"] * 2 and differences(catalogue) == []
    assert rows(catalogue, text("SELECT count(*) FROM alembic_version")) == [1]
