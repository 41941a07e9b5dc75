"""The data folder is closed to other users; output folders follow the operator's umask."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from workers.files import modes


def mode(path: Path) -> int:
    return path.stat().st_mode & 0o777


@pytest.fixture
def private(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A process whose operator has the umask 027, and that keeps its files private."""
    monkeypatch.setattr(modes, "_operators_umask", None)
    before = os.umask(0o027)
    modes.keep_private()
    modes.keep_private()  # the second call forgets nothing
    yield
    os.umask(before)


@pytest.mark.usefixtures("private")
def test_new_files_are_private_and_outputs_are_not(tmp_path: Path) -> None:
    (tmp_path / "kept").write_text("x")
    assert mode(tmp_path / "kept") == 0o600
    modes.open_folder(tmp_path / "a" / "b")
    assert mode(tmp_path / "a") == mode(tmp_path / "a" / "b") == 0o750
    with (tmp_path / "a" / "output").open("wb") as file:
        modes.open_file(file)
    assert mode(tmp_path / "a" / "output") == 0o640


@pytest.mark.usefixtures("private")
def test_an_output_folder_that_exists_keeps_its_mode(tmp_path: Path) -> None:
    (tmp_path / "there").mkdir()
    (tmp_path / "there").chmod(0o770)
    modes.open_folder(tmp_path / "there")
    assert mode(tmp_path / "there") == 0o770


def test_a_process_that_is_not_private_changes_no_mode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(modes, "_operators_umask", None)
    before = os.umask(0o022)
    try:
        modes.open_folder(tmp_path / "a")
        with (tmp_path / "a" / "output").open("wb") as file:
            modes.open_file(file)
    finally:
        os.umask(before)
    assert (mode(tmp_path / "a"), mode(tmp_path / "a" / "output")) == (0o755, 0o644)


def test_the_data_folder_is_closed_if_it_was_open(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    modes.private_folder(tmp_path / "new" / "data")
    assert mode(tmp_path / "new" / "data") == 0o700 and not caplog.records
    (tmp_path / "old").mkdir()
    (tmp_path / "old").chmod(0o755)
    for _ in range(2):
        modes.private_folder(tmp_path / "old")
    assert mode(tmp_path / "old") == 0o700
    assert len(caplog.records) == 1 and "closed the data folder" in caplog.text


def test_the_data_folder_of_another_user_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    tmp_path.chmod(0o755)
    monkeypatch.setattr(os, "geteuid", lambda: tmp_path.stat().st_uid + 1)
    modes.private_folder(tmp_path)
    assert mode(tmp_path) == 0o755 and "chmod 700" in caplog.text
