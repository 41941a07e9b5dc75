"""The cache of built PSFs: what is kept is found again, checked, private, and bounded."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from psfcore import psf_cache as cache_module
from psfcore.errors import DataError
from psfcore.psf_cache import PsfCache

ONE, OTHER, THIRD = "1" * 64, "2" * 64, "3" * 64


@pytest.fixture
def cache(tmp_path: Path) -> PsfCache:
    return PsfCache(tmp_path / "below" / "psfs", 1000)


def keep(
    cache: PsfCache, identity: str, content: bytes, part: str = "fits", used_at: int | None = None
) -> None:
    kept = cache.keep(identity, part, lambda path: path.write_bytes(content))
    assert kept is not None and kept.read_bytes() == content
    if used_at is not None:
        os.utime(kept, (used_at, used_at))


def test_a_kept_file_is_found_with_its_hash(cache: PsfCache) -> None:
    assert cache.find(ONE, "fits") is None
    keep(cache, ONE, b"weights")
    keep(cache, ONE, b"{}", part="row.json")
    found = cache.find(ONE, "fits")
    assert found is not None and found.read_bytes() == b"weights"
    assert hashlib.sha256(b"weights").hexdigest() in found.name
    assert cache.find(OTHER, "fits") is None and cache.find(ONE, "preview.png") is None
    (psf,) = cache.psfs()
    assert psf.identity == ONE and psf.bytes == 9 and len(psf.files) == 2


def test_a_damaged_file_is_removed_and_not_used(cache: PsfCache) -> None:
    keep(cache, ONE, b"weights")
    (file,) = cache.folder.iterdir()
    file.write_bytes(b"Weights")
    assert cache.find(ONE, "fits") is None
    assert list(cache.folder.iterdir()) == []


def test_folder_and_files_are_those_of_one_user_alone(
    cache: PsfCache, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache.folder.mkdir(parents=True)
    cache.folder.chmod(0o755)
    umask = os.umask(0)
    try:
        keep(cache, ONE, b"weights")
    finally:
        os.umask(umask)
    (file,) = cache.folder.iterdir()
    assert cache.folder.stat().st_mode & 0o777 == 0o700
    assert file.stat().st_mode & 0o777 == 0o600
    keep(cache, ONE, b"weights")
    monkeypatch.setattr(cache_module.os, "geteuid", lambda: cache.folder.stat().st_uid + 1)
    assert cache.find(ONE, "fits") is None and cache.psfs() == [] and cache.clear() == 0
    with pytest.raises(DataError, match="cache-of-another-user"):
        keep(cache, OTHER, b"weights")


def test_the_psf_that_was_not_used_for_the_longest_time_makes_room(cache: PsfCache) -> None:
    keep(cache, ONE, bytes(400), used_at=100)
    keep(cache, OTHER, bytes(401), used_at=200)
    cache.find(ONE, "fits")  # now ONE was used last
    keep(cache, THIRD, bytes(402))
    assert {psf.identity for psf in cache.psfs()} == {ONE, THIRD}


def test_the_last_psf_stays_and_a_file_that_is_too_large_is_not_kept(cache: PsfCache) -> None:
    keep(cache, ONE, bytes(600))
    keep(cache, ONE, bytes(500), part="tables.json")
    assert [psf.identity for psf in cache.psfs()] == [ONE]
    assert cache.keep(OTHER, "fits", lambda path: path.write_bytes(bytes(1001))) is None
    assert PsfCache(cache.folder, 0).keep(OTHER, "fits", lambda path: None) is None
    assert {path.name[:64] for path in cache.folder.iterdir()} == {ONE}


def test_failed_writes_and_killed_processes_leave_nothing(cache: PsfCache) -> None:
    def half(path: Path) -> None:
        path.write_bytes(b"half")
        raise InterruptedError

    with pytest.raises(InterruptedError):
        cache.keep(ONE, "fits", half)
    assert list(cache.folder.iterdir()) == []
    for name, changed_at in ((".old.part", 0), (".new.part", None)):
        (cache.folder / name).write_bytes(b"half")
        if changed_at is not None:
            os.utime(cache.folder / name, (changed_at, changed_at))
    keep(cache, ONE, b"weights")
    assert not (cache.folder / ".old.part").exists() and (cache.folder / ".new.part").exists()


def test_clear_removes_the_psfs_and_leaves_other_files(cache: PsfCache) -> None:
    keep(cache, ONE, b"weights")
    keep(cache, OTHER, b"weights")
    (cache.folder / "notes.txt").write_text("mine")
    assert cache.clear() == 14
    assert [path.name for path in cache.folder.iterdir()] == ["notes.txt"]
