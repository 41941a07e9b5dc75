"""``heliopsf database``, and a service that is started on a database of another version."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner, Result
from sqlalchemy import create_engine, text

from service.cli.main import main
from tests.tables import RUN_REVISIONS
from tests.whole.stack import free_port
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.schema import Schema
from workers.settings import Settings


@pytest.fixture(autouse=True)
def data(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setattr(Schema, "upgrade", RUN_REVISIONS)
    for name in ("DATABASE_URL", "BROKER_URL"):
        monkeypatch.delenv(f"HELIOPSF_{name}", raising=False)
    monkeypatch.setenv("HELIOPSF_DATA_DIR", str(tmp_path / "data"))
    return tmp_path / "data"


def ask(*words: str) -> Result:
    return CliRunner().invoke(main, list(words))


def execute(statement: str) -> None:
    engine = create_engine(Settings().catalogue_url)
    with engine.begin() as connection:
        connection.execute(text(statement))
    engine.dispose()


def test_status_upgrade_status() -> None:
    before = ask("database", "status")
    assert before.exit_code == 1 and "the database is empty" in before.output
    done = ask("database", "upgrade")
    assert done.exit_code == 0 and "upgraded from no revision to" in done.output
    after = ask("database", "status")
    assert after.exit_code == 0 and "which this version needs" in after.output
    assert "upgraded" not in ask("database", "upgrade").output


def test_upgrade_makes_again_what_was_removed() -> None:
    ask("database", "upgrade")
    execute("DROP INDEX jobs_tallied")
    execute("DROP TABLE reports")
    assert ask("database", "upgrade").exit_code == 0
    catalogue = Catalogue(Settings().catalogue_url)
    faults = catalogue.schema.faults()
    catalogue.close()
    assert (faults.tables, faults.columns, faults.indexes) == ((), (), ())


def test_a_later_database_is_one_sentence_for_status_upgrade_and_serve() -> None:
    ask("database", "upgrade")
    execute("UPDATE alembic_version SET version_num = '9999'")
    status = ask("database", "status")
    assert status.exit_code == 1 and "9999" in status.output and "later version" in status.output
    for words in (("database", "upgrade"), ("serve", "--port", str(free_port()))):
        answer = ask(*words)
        assert answer.exit_code == 1 and isinstance(answer.exception, SystemExit), answer.output
        assert "at revision 9999, which this version does not know" in answer.output


def test_a_database_that_is_away_is_one_sentence_without_its_password(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("HELIOPSF_DATABASE_URL", f"postgresql://u:s3cret@127.0.0.1:{free_port()}/x")
    for words in (("database", "status"), ("database", "upgrade"), ("serve", "--port", str(free_port()))):
        answer = ask(*words)
        assert answer.exit_code == 1 and isinstance(answer.exception, SystemExit), answer.output
        assert "the connection is refused" in answer.output and "s3cret" not in answer.output


def test_a_url_that_cannot_be_used_is_one_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HELIOPSF_DATABASE_URL", "nonsense:s3cret")
    answer = ask("database", "status")
    assert answer.exit_code == 1 and "HELIOPSF_DATABASE_URL cannot be used" in answer.output
    assert "s3cret" not in answer.output
