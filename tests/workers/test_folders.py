"""The cache of built PSFs and the default data folder: where they are, and how large the cache may become."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner

from psfcore.errors import DataError
from service.cli.main import main
from workers import data_folder
from workers.cache_folder import psf_cache
from workers.settings import Settings


def test_the_variable_names_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HELIOPSF_CACHE_DIR", str(tmp_path / "here"))
    cache = psf_cache()
    assert cache.folder == tmp_path / "here" / "psfs" and cache.max_bytes == 2**31
    assert not cache.folder.exists(), "looking must not make the folder"


def test_without_it_the_cache_folder_of_the_user_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("HELIOPSF_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("HELIOPSF_CACHE_MIB", "3")
    if sys.platform == "linux":
        assert psf_cache().folder == tmp_path / "heliopsf" / "psfs"
    assert psf_cache().max_bytes == 3 * 2**20


def test_a_size_that_is_no_number_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    for text in ("-1", "many", "1.5", "٣"):
        monkeypatch.setenv("HELIOPSF_CACHE_MIB", text)
        with pytest.raises(DataError, match="HELIOPSF_CACHE_MIB: expected a whole number"):
            psf_cache()


def test_the_module_loads_nothing_else_of_the_workers() -> None:
    code = "import sys, workers.cache_folder; print('\\n'.join(sys.modules))"
    loaded = set(
        subprocess.run(
            [sys.executable, "-c", code], check=True, capture_output=True, text=True
        ).stdout.split()
    )
    assert {name for name in loaded if name.startswith("workers.")} == {"workers.cache_folder"}
    assert loaded & {"pydantic", "sqlalchemy", "numpy", "celery"} == set()


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user without settings, in a working folder of their own."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "home" / "my data"))
    monkeypatch.delenv("HELIOPSF_DATA_DIR", raising=False)
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "home"


def earlier(folder: Path) -> Path:
    """A data folder as earlier versions made it, with something in it."""
    (folder / "heliopsf-data" / "blobs").mkdir(parents=True)
    return folder / "heliopsf-data"


def test_the_catalogue_does_not_depend_on_the_working_folder(
    home: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    first = Settings().data_dir
    monkeypatch.chdir(tmp_path)
    assert first == Settings().data_dir == home / "my data" / "heliopsf"
    assert data_folder.told() is None


def test_data_of_an_earlier_version_go_on_being_used(home: Path, tmp_path: Path) -> None:
    old = earlier(tmp_path / "work")
    assert Settings().data_dir == old
    told = data_folder.told()
    assert told is not None and str(old) in told
    subprocess.run(told.rpartition("run: ")[2], shell=True, check=True)
    assert (home / "my data" / "heliopsf" / "blobs").is_dir() and not old.exists()
    assert Settings().data_dir == home / "my data" / "heliopsf" and data_folder.told() is None


def test_the_command_to_move_fills_an_empty_folder_and_spares_a_full_one(home: Path, tmp_path: Path) -> None:
    old, new = earlier(tmp_path / "work"), home / "my data" / "heliopsf"
    new.mkdir(parents=True)
    told = data_folder.told()
    assert told is not None and "rmdir" in told
    (new / "catalogue.sqlite").touch()
    told = data_folder.told()
    assert told is not None and "mv " not in told and str(new) in told and str(old) in told


def test_a_folder_that_is_empty_or_of_another_user_is_not_used(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "work" / "heliopsf-data").mkdir()
    assert data_folder.earlier_data_dir() is None
    (tmp_path / "work" / "heliopsf-data").rmdir()
    earlier(tmp_path / "work")
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    assert data_folder.earlier_data_dir() is None
    assert Settings().data_dir == home / "my data" / "heliopsf"


def test_commands_tell_it_unless_a_folder_was_named(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = earlier(tmp_path / "work")
    told = CliRunner().invoke(main, ["database", "status"])
    assert "earlier versions kept data there" in told.stderr and (old / "catalogue.sqlite").exists()
    named = CliRunner().invoke(main, ["database", "status", "--data", str(tmp_path / "named")])
    assert "earlier" not in named.output
    monkeypatch.setenv("HELIOPSF_DATA_DIR", str(old))
    assert "earlier" not in CliRunner().invoke(main, ["database", "status"]).output
