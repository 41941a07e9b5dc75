"""The cache of built PSFs and the default data folder: where they are, and how large the cache may become."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from psfcore.errors import DataError
from workers.machine import psf_cache
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
    code = "import sys, workers.machine; print('\\n'.join(sys.modules))"
    loaded = set(
        subprocess.run(
            [sys.executable, "-c", code], check=True, capture_output=True, text=True
        ).stdout.split()
    )
    assert {name for name in loaded if name.startswith("workers.")} == {"workers.machine"}
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


def test_the_catalogue_does_not_depend_on_the_working_folder(
    home: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    first = Settings().data_dir
    monkeypatch.chdir(tmp_path)
    assert first == Settings().data_dir == home / "my data" / "heliopsf"
