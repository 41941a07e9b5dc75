"""A damaged SQLite database: the server is not ready, the doctor names it, and requests are answered clearly."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from service.cli.operator import doctor
from tests.service.conftest import refusal
from workers import checks
from workers.catalogue.catalogue import Catalogue
from workers.settings import Settings

PAGE_BYTES = 4096


def zero_a_page(file: Path) -> None:
    """Zero one page, as a bad disk does; the first pages, with the header and the list of tables, stay good."""
    content = bytearray(file.read_bytes())
    pages = len(content) // PAGE_BYTES
    place = PAGE_BYTES * (pages // 2)
    content[place : place + PAGE_BYTES] = bytes(PAGE_BYTES)
    file.write_bytes(content)


def halve(file: Path) -> None:
    content = file.read_bytes()
    file.write_bytes(content[: len(content) // 2])


@pytest.mark.parametrize("spoil", [zero_a_page, halve])
def test_a_damaged_database_is_told_of(
    api: TestClient, settings: Settings, spoil: Callable[[Path], None]
) -> None:
    file = settings.data_dir / "catalogue.sqlite"
    connection = sqlite3.connect(file)
    connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")  # all changes are in the file
    connection.close()
    database = {finding.what: finding for finding in doctor.examine(settings)}["database"]
    assert database.state == "ok"
    spoil(file)
    answer = api.get("/readyz")
    assert answer.status_code == 503 and "damaged" in answer.json()["parts"]["database"]
    database = {finding.what: finding for finding in doctor.examine(settings)}["database"]
    assert database.state == "broken" and "damaged" in database.found and "restore a copy" in database.advice


def test_a_request_to_a_damaged_database_is_answered_clearly(api: TestClient, settings: Settings) -> None:
    assert "damaged" not in api.get("/readyz").text
    api.app.state.heliopsf.catalogue.close()  # pages in memory are still good
    for file in settings.data_dir.glob("catalogue.sqlite*"):
        file.write_bytes(b"\0" * 8192)
    refusal(api.get("/v1/jobs"), 503, "database-damaged")


def test_the_check_takes_a_small_share_of_the_time(
    catalogue: Catalogue, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, made = [1000.0], []
    monkeypatch.setattr(checks.time, "monotonic", lambda: now[0])

    def check_pages() -> None:
        made.append(now[0])
        now[0] += 2.0  # the check of a large database

    monkeypatch.setattr(catalogue, "check_pages", check_pages)
    for _ in range(500):
        checks.database(catalogue)
        now[0] += 1.0
    assert len(made) == 3
