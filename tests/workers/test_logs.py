"""Which messages are written: those that clients can cause once in a while, requests only if wanted."""

from __future__ import annotations

import io
import json
import logging
import sys
from pathlib import Path

import pytest

from service.http import observation
from workers import logs
from workers.settings import Settings


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [100.0]
    monkeypatch.setattr("workers.logs.time.monotonic", lambda: now[0])
    return now


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


# Whether standard error is a terminal, the setting of the format, --verbose, and whether requests are shown.
SHOWN = (
    (True, None, False, False),
    (True, None, True, True),
    (True, "text", False, True),
    (True, "json", False, True),
    (False, None, False, True),
)


def test_requests_are_shown_on_a_terminal_only_if_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    for terminal, log_format, verbose, shown in SHOWN:
        with monkeypatch.context() as patched:
            text = written(patched, Terminal(terminal=terminal), log_format, verbose)
        requests = [f"GET /{status}" in text for status in (200, 404, 500)]
        assert requests == [shown, shown, True], (terminal, log_format, verbose)
        assert "job 1: submitted" in text and "Running upgrade" not in text


def written(
    monkeypatch: pytest.MonkeyPatch, stream: io.StringIO, log_format: str | None, verbose: bool
) -> str:
    """What some messages write to this stream."""
    root = logging.getLogger()
    monkeypatch.setattr(root, "handlers", [])  # the test runner's own come back afterwards
    monkeypatch.setattr("sys.__stderr__", stream)
    level = root.level
    try:
        logs.configure(Settings.model_validate({"log_format": log_format}), verbose=verbose)
        for status in (200, 404, 500):
            fields = {"fields": {"status": status}}
            logging.getLogger(observation.__name__).info("GET /%d", status, extra=fields)
        logging.getLogger("service.api.jobs").info("job 1: submitted")
        logging.getLogger("alembic.runtime.migration").info("Running upgrade")
    finally:
        root.setLevel(level)
        logging.captureWarnings(False)
    return stream.getvalue()


def test_what_celery_tries_again_is_a_warning_and_json(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Terminal(terminal=False)
    written(monkeypatch, stream, None, False)
    library = logging.getLogger("multiprocessing")
    monkeypatch.setattr(library, "propagate", False)  # as Celery's library leaves it
    for name in ("multiprocessing", "service.http.problems"):
        logging.getLogger(name).error("%s", name)
    monkeypatch.setattr(library, "handlers", [])
    levels = {line["message"]: line["level"] for line in map(json.loads, stream.getvalue().splitlines())}
    assert levels["multiprocessing"] == "WARNING"


def test_a_log_file_is_rotated_by_the_processes_that_share_it(tmp_path: Path) -> None:
    path, lines = tmp_path / "heliopsf.log", 40
    shared = [logs.RotatedFile(path, maxBytes=50, backupCount=50) for _ in range(2)]
    for number in range(lines):
        shared[number % 2].emit(record(f"line {number}"))
    files = [path, *(tmp_path / f"heliopsf.log.{number}" for number in range(1, 51))]
    there = [file.read_text().split("\n")[:-1] for file in files if file.exists()]
    assert len(there) > 2
    assert [line for file in reversed(there) for line in file] == [
        f"line {number}" for number in range(lines)
    ]
    one = logs.RotatedFile(path, maxBytes=1, backupCount=1)
    for number in range(3):
        one.emit(record(f"last {number}"))
    assert (tmp_path / "heliopsf.log.1").read_text() == "last 1\n" and path.read_text() == "last 2\n"
    for handler in (*shared, one):
        handler.close()


@pytest.mark.parametrize("form", [logs.JsonFormatter(), logs.TextFormatter()], ids=["json", "text"])
def test_the_secret_of_a_key_is_in_no_line(form: logging.Formatter) -> None:
    key = "hpsf_0123456789abcdef_Abc-_" + "d" * 38
    one = record("GET /v1/images/%s 404", key)
    try:
        raise ValueError(key)
    except ValueError:
        one.exc_info = sys.exc_info()
    one.fields = {"sent": key}  # type: ignore[attr-defined]
    line = form.format(one)
    assert "Abc" not in line and line.count("hpsf_0123456789abcdef_***") >= 3
