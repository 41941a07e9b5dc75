"""The database's revision: empty, older, newer and foreign databases, and processes that start at once."""

from __future__ import annotations

import logging
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
from workers.catalogue.migrations.versions.r0001_baseline import METADATA as BASELINE
from workers.catalogue.schema import Schema, SchemaError
from workers.catalogue.tables import Base, PsfRow
from workers.settings import Settings

OLD_PSF = {
    "owner": "local", "id": "b" * 64, "created_at": 1.0, "name": "hri", "version": "1.0.0+0", "instrument": "hri_euv",
    "status": "draft", "origin": "built", "file_sha256": "f" * 64, "bytes": 7, "details": {"shape": [4, 4]},
}  # fmt: skip


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


def make_as_before_revisions(catalogue: Catalogue) -> None:
    """The tables of the versions before revisions, with a PSF."""
    BASELINE.create_all(database(catalogue).engine)
    change(catalogue, insert(BASELINE.tables["psfs"]).values(OLD_PSF))


def differences(catalogue: Catalogue) -> list[object]:
    """Between the database and the tables that the code works with, as alembic sees them."""
    options = {"compare_type": True, "compare_server_default": True}
    with database(catalogue).engine.connect() as connection:
        context = MigrationContext.configure(connection, opts=options)
        return list(compare_metadata(context, Base.metadata))


def indexes(catalogue: Catalogue) -> set[str]:
    """The database's indexes in its own words, with the condition of those that have one."""
    statement = (
        "SELECT sql FROM sqlite_master WHERE type = 'index' AND sql IS NOT NULL"
        if database(catalogue).sqlite
        else "SELECT indexdef FROM pg_indexes WHERE schemaname = 'public' AND tablename <> 'alembic_version'"
    )
    return set(rows(catalogue, text(statement)))


def said(caplog: pytest.LogCaptureFixture) -> list[str]:
    """What the schema logged. Alembic logs too, if an earlier test of the process has let it."""
    return [record.message for record in caplog.records if record.name == "workers.catalogue.schema"]


def test_an_empty_database_gets_the_tables_that_the_code_works_with(
    catalogue: Catalogue, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "workers.catalogue.schema")
    assert catalogue.schema.status().state == "empty"
    catalogue.upgrade()
    status = catalogue.schema.status()
    assert status.state == "current" and differences(catalogue) == []
    assert said(caplog) == [f"database: created, revision {status.wanted}"]
    upgraded = indexes(catalogue)
    with database(catalogue).engine.begin() as connection:
        Base.metadata.drop_all(connection)
    catalogue.schema.create()  # as for the database of one process
    assert indexes(catalogue) == upgraded and differences(catalogue) == []


def test_an_older_database_is_upgraded_with_its_data(
    catalogue: Catalogue, caplog: pytest.LogCaptureFixture
) -> None:
    make_as_before_revisions(catalogue)
    change(
        catalogue, text("DROP TABLE workers"), text("DROP INDEX jobs_tallied")
    )  # as an even earlier version
    assert catalogue.schema.status().state == "unversioned"
    caplog.set_level(logging.INFO, "workers.catalogue.schema")
    catalogue.upgrade()
    catalogue.upgrade()
    status = catalogue.schema.status()
    assert status.state == "current" and differences(catalogue) == []
    assert said(caplog) == [f"database: upgraded from no revision to {status.wanted}"]
    psf = catalogue.get(PsfRow, "b" * 64, "local")
    assert psf is not None and psf.version == "1.0.0+0" and psf.details["shape"] == [4, 4]
    assert catalogue.owners.recount() == []
    change(catalogue, text("UPDATE alembic_version SET version_num = '0001'"))
    assert catalogue.schema.status().state == "older"


@sqlite_alone
def test_a_newer_or_foreign_database_is_refused_and_left_alone(catalogue: Catalogue) -> None:
    change(catalogue, text("CREATE TABLE images (id VARCHAR(64) PRIMARY KEY, pixels TEXT)"))
    with pytest.raises(SchemaError, match=r"without a revision.*images\.owner.*images\.summary"):
        catalogue.upgrade()
    assert inspect(database(catalogue).engine).get_table_names() == ["images"]
    change(catalogue, text("DROP TABLE images"))
    catalogue.upgrade()
    change(catalogue, text("UPDATE alembic_version SET version_num = '9999'"))
    with pytest.raises(SchemaError, match=r"at revision 9999.*knows revisions up to 0"):
        catalogue.upgrade()
    assert catalogue.schema.status().revision == "9999"


def test_an_upgrade_that_fails_leaves_nothing_behind(catalogue: Catalogue) -> None:
    """Revisions are one transaction: tables that an earlier one made go where a later one fails."""
    change(catalogue, text("CREATE TABLE keys (id INTEGER PRIMARY KEY)"))  # in the way
    with pytest.raises(DatabaseError, match="exists"):
        catalogue.upgrade()
    assert inspect(database(catalogue).engine).get_table_names() == ["keys"]


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
