"""A damaged SQLite database: the server is not ready, the doctor names it, and requests are answered clearly."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from service.cli.operator import doctor
from workers import checks
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


@pytest.fixture
def file(settings: Settings, api: TestClient) -> Path:
    """The file of the database of a running server, with all changes in it."""
    found = settings.data_dir / "catalogue.sqlite"
    connection = sqlite3.connect(found)
    connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    connection.close()
    return found


@pytest.mark.parametrize("spoil", [zero_a_page, halve])
def test_a_damaged_database_is_told_of(
    api: TestClient, settings: Settings, file: Path, spoil: Callable[[Path], None]
) -> None:
    spoil(file)
    answer = api.get("/readyz")
    assert answer.status_code == 503 and "damaged" in answer.json()["parts"]["database"]
    found = {finding.what: finding for finding in doctor.examine(settings)}["database"]
    assert found.state == "broken" and "damaged" in found.found and "restore a copy" in found.advice


def test_a_good_database_is_good(api: TestClient, settings: Settings, file: Path) -> None:
    assert "damaged" not in api.get("/readyz").text
    found = {finding.what: finding for finding in doctor.examine(settings)}["database"]
    assert found.state == "ok"


def test_a_request_to_a_damaged_database_is_answered_clearly(api: TestClient, file: Path) -> None:
    api.app.state.heliopsf.catalogue._engine.dispose()  # type: ignore[attr-defined]  # pages in memory are still good
    file.write_bytes(b"\0" * file.stat().st_size)
    answer = api.get("/v1/jobs")
    assert (answer.status_code, answer.json()["type"]) == (503, "urn:heliopsf:database-damaged")


def test_the_check_takes_a_small_share_of_the_time(api: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    catalogue = api.app.state.heliopsf.catalogue  # type: ignore[attr-defined]
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
