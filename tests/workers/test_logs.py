"""Which messages are written: those that clients can cause once in a while, requests only if wanted, upgrades in one line."""

from __future__ import annotations

import io
import logging
from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import text

from service.http import observation
from tests.tables import RUN_REVISIONS
from workers import logs
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.schema import Schema
from workers.settings import Settings


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[float]]:
    now = [100.0]
    monkeypatch.setattr("workers.logs.time.monotonic", lambda: now[0])
    yield now


def record(message: str, *values: object, level: int = logging.WARNING) -> logging.LogRecord:
    return logging.LogRecord("x", level, "x.py", 1, message, values, None)


def test_one_message_of_a_kind_in_a_minute(clock: list[float]) -> None:
    seldom = logs.Seldom()
    assert [seldom.filter(record("%d open", n)) for n in range(5)] == [True, False, False, False, False]
    assert seldom.filter(record("another")), "another kind"
    clock[0] += 59.9
    assert not seldom.filter(record("%d open", 5))
    clock[0] += 0.2
    again = record("%d open", 6)
    assert seldom.filter(again)
    assert again.getMessage() == "6 open (5 more such messages were left out)"
    clock[0] += 61
    after = record("%d open", 7)
    assert seldom.filter(after) and after.getMessage() == "7 open"


def test_only_the_messages_that_are_meant(clock: list[float]) -> None:
    seldom = logs.Seldom(lambda one: one.levelno < logging.ERROR)
    assert [seldom.filter(record("failed", level=logging.ERROR)) for _ in range(3)] == 3 * [True]
    assert [seldom.filter(record("failed")) for _ in range(3)] == [True, False, False]


class Terminal(io.StringIO):
    """A stream that says whether it is a terminal."""

    def __init__(self, *, terminal: bool) -> None:
        super().__init__()
        self.isatty = lambda: terminal  # type: ignore[method-assign]


@pytest.mark.parametrize(
    ("terminal", "asked", "verbose", "shown"),
    [
        (True, None, False, False),
        (True, None, True, True),
        (True, "text", False, True),
        (True, "json", False, True),
        (False, None, False, True),
    ],
)
def test_requests_are_shown_on_a_terminal_only_if_wanted(
    monkeypatch: pytest.MonkeyPatch, terminal: bool, asked: str | None, verbose: bool, shown: bool
) -> None:
    root, stream = logging.getLogger(), Terminal(terminal=terminal)
    monkeypatch.setattr(root, "handlers", [])  # the test runner's own come back afterwards
    monkeypatch.setattr("sys.__stderr__", stream)
    level = root.level
    try:
        logs.configure(Settings.model_validate({"log_format": asked}), verbose=verbose)
        for status in (200, 404, 500):
            fields = {"fields": {"status": status}}
            logging.getLogger(observation.__name__).info("GET /%d", status, extra=fields)
        logging.getLogger("service.api.jobs").info("job 1: submitted")
        logging.getLogger("alembic.runtime.migration").info("Running upgrade")
    finally:
        root.setLevel(level)
        logging.captureWarnings(False)
    said = stream.getvalue()
    assert [f"GET /{status}" in said for status in (200, 404, 500)] == [shown, shown, True]
    assert "job 1: submitted" in said and "Running upgrade" not in said


def test_an_upgrade_of_the_database_is_one_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Schema, "upgrade", RUN_REVISIONS)  # other tests get a copy of ready tables
    caplog.set_level(logging.INFO, "workers.catalogue.schema")
    catalogue = Catalogue(f"sqlite:///{tmp_path / 'c.sqlite'}")
    catalogue.upgrade()
    wanted = catalogue.schema.status().wanted
    assert caplog.messages == [f"database: created, revision {wanted}"]
    with catalogue._engine.begin() as connection:
        # The tables of revision 0016; revision 0017 changes only counts.
        connection.execute(text("DROP TABLE series_changes"))
        connection.execute(text("ALTER TABLE psf_pins DROP COLUMN interpolated"))
        connection.execute(text("ALTER TABLE bulks DROP COLUMN listed_to"))
        connection.execute(text("UPDATE alembic_version SET version_num = '0016'"))
    caplog.clear()
    catalogue.upgrade()
    catalogue.upgrade()
    catalogue.close()
    assert caplog.messages == [f"database: upgraded from 0016 to {wanted}"]
