"""A worker looks at the database before it takes a job: one of another revision it does not serve."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest
from sqlalchemy import text
from sqlalchemy.exc import OperationalError

from workers.catalogue.catalogue import Catalogue
from workers.catalogue.schema import Schema, SchemaError
from workers.run import worker
from workers.settings import Settings


def put_at(catalogue: Catalogue, revision: str | None) -> None:
    with catalogue._engine.begin() as connection:
        if revision is None:
            connection.execute(text("DELETE FROM alembic_version"))
        else:
            connection.execute(text("UPDATE alembic_version SET version_num = :one"), {"one": revision})


def put_back(catalogue: Catalogue) -> None:
    """Other tests use the same PostgreSQL database."""
    with catalogue._engine.begin() as connection:
        connection.execute(text("DELETE FROM alembic_version"))
        connection.execute(
            text("INSERT INTO alembic_version VALUES (:one)"), {"one": catalogue.schema.status().wanted}
        )


@pytest.mark.parametrize(
    ("revision", "said"),
    [
        ("9999", ("at revision 9999", "does not know", "use the version that made the database")),
        ("0003", ("at revision 0003", "expected a database at revision", "`heliopsf database upgrade`")),
        (None, ("without a revision", "`heliopsf database upgrade`")),
    ],
)
def test_what_is_wrong_with_a_revision_and_what_to_do(
    catalogue: Catalogue, revision: str | None, said: tuple[str, ...]
) -> None:
    catalogue.schema.check()
    put_at(catalogue, revision)
    with pytest.raises(SchemaError) as refused:
        catalogue.schema.check()
    put_back(catalogue)
    for words in said:
        assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_an_empty_database_is_said_to_be_empty_and_stays_so(tmp_path: Path) -> None:
    catalogue = Catalogue(f"sqlite:///{tmp_path / 'c.sqlite'}")
    with pytest.raises(SchemaError, match="is empty"):
        catalogue.schema.check()
    assert catalogue.schema.status().state == "empty"
    catalogue.close()


def test_a_database_that_is_away_is_waited_for(
    settings: Settings, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked: list[int] = []

    def away_twice(_: Schema) -> None:
        asked.append(1)
        if len(asked) < 3:
            raise OperationalError("SELECT", None, Exception("connection refused by s3cret"))

    monkeypatch.setattr(Schema, "check", away_twice)
    monkeypatch.setattr(worker, "settings", settings)
    monkeypatch.setattr(worker, "WAIT_S", 0.01)
    settings.data_dir.mkdir()
    with caplog.at_level(logging.WARNING, "workers.run.worker"):
        worker.check_tables()
    assert len(asked) == 3 and caplog.text.count("waiting for the database: the connection is refused") == 2
    assert "s3cret" not in caplog.text


@pytest.mark.parametrize(
    "command",
    [
        [sys.executable, "-m", "service.cli", "worker"],
        [sys.executable, "-m", "celery", "-A", "workers.run.worker", "worker"],
    ],
    ids=["heliopsf worker", "celery"],
)
def test_a_worker_on_a_later_database_ends_with_a_line_and_status_1(
    settings: Settings, command: list[str]
) -> None:
    settings.data_dir.mkdir()
    catalogue = Catalogue(settings.catalogue_url)
    catalogue.upgrade()
    put_at(catalogue, "9999")
    catalogue.close()
    kept = {name: value for name, value in os.environ.items() if not name.startswith("HELIOPSF_")}
    ended = subprocess.run(
        command,
        env=kept | {"HELIOPSF_DATA_DIR": str(settings.data_dir), "HELIOPSF_BROKER_URL": "filesystem://"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert ended.returncode == 1, ended.stderr
    last = ended.stderr.strip().splitlines()[-1]
    assert last.startswith("Error: the database is at revision 9999"), ended.stderr
    assert "Traceback" not in ended.stderr
