"""A worker looks at the database before it takes a job: one of another revision it does not serve."""

from __future__ import annotations

import logging
import os
import subprocess
import sys

import pytest
from sqlalchemy import text
from sqlalchemy.exc import OperationalError

from tests.workers.databases import change
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.schema import Schema
from workers.run import worker
from workers.settings import Settings


def test_workers_of_one_host_name_and_process_id_have_different_names() -> None:
    """As in containers: each has its own process ids, and may have the host name of another."""
    code = (
        "import os, socket\n"
        "os.getpid = lambda: 1\n"
        "socket.gethostname = lambda: 'worker'\n"
        "from workers.run.runner import worker_name\n"
        "print(worker_name() == worker_name(), worker_name())"
    )
    command = [sys.executable, "-c", code]
    names = {subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(2)}
    assert len(names) == 2 and all(name.startswith("True worker:1:") for name in names)


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
        pytest.param(
            [sys.executable, "-m", "celery", "-A", "workers.run.worker", "worker"], marks=pytest.mark.slow
        ),
    ],
    ids=["heliopsf worker", "celery"],
)
def test_a_worker_on_a_later_database_ends_with_a_line_and_status_1(
    settings: Settings, command: list[str]
) -> None:
    settings.data_dir.mkdir()
    catalogue = Catalogue(settings.catalogue_url)
    catalogue.upgrade()
    change(catalogue, text("UPDATE alembic_version SET version_num = '9999'"))
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
