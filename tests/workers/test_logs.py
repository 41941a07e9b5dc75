"""Messages that clients can cause are written once in a while."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import pytest

from workers import logs


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
