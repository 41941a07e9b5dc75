"""The cache of built PSFs: what is kept is found again, checked, private, and bounded."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from psfcore import psf_cache as cache_module
from psfcore.errors import DataError
from psfcore.fits.psfs import write_psf
from psfcore.psf_cache import FITS, PROVENANCE, PsfCache
from tests.psfcore.conftest import gaussian, make_psf

ONE, OTHER, THIRD = "1" * 64, "2" * 64, "3" * 64


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A PSF file with a component."""
    write_psf(tmp_path / "psf.fits", make_psf(gaussian(8, 1.0), components={"SCATTER": gaussian(8, 2.0)}))
    return tmp_path / "psf.fits"


@pytest.fixture
def cache(tmp_path: Path, file: Path) -> PsfCache:
    """A cache for two files and a half."""
    return PsfCache(tmp_path / "below" / "psfs", file.stat().st_size * 5 // 2)


def keep(cache: PsfCache, identity: str, file: Path, used_at: int | None = None) -> None:
    cache.keep(identity, FITS, file)
    kept = cache.folder / f"{identity}.fits"
    assert kept.read_bytes() == file.read_bytes()
    if used_at is not None:
        os.utime(kept, (used_at, used_at))


def test_a_kept_file_is_found_with_what_is_known_of_it(cache: PsfCache, file: Path, tmp_path: Path) -> None:
    assert cache.find(ONE) is None
    keep(cache, ONE, file)
    found = cache.find(ONE)
    assert found is not None and found.read_bytes() == file.read_bytes()
    assert cache.find(OTHER) is None and cache.provenance(ONE) == {}
    about = tmp_path / "about.json"
    about.write_text(json.dumps({"psf_id": ONE}))
    cache.keep(ONE, PROVENANCE, about)
    assert cache.provenance(ONE) == {"psf_id": ONE}
    (psf,) = cache.psfs()
    sizes = file.stat().st_size + about.stat().st_size
    assert (psf.identity, psf.bytes, len(psf.files)) == (ONE, sizes, 2)
    (cache.folder / f"{ONE}.json").write_text("{")
    assert cache.provenance(ONE) == {}


def test_a_damaged_file_is_removed_and_not_used(cache: PsfCache, file: Path) -> None:
    content = file.read_bytes()
    flipped = [
        content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :] for at in range(5, len(content), 997)
    ]
    for damaged in (*flipped, content[:-2880], content[:-1], content + b"x", b"", bytes(len(content))):
        keep(cache, ONE, file)
        (cache.folder / f"{ONE}.fits").write_bytes(damaged)
        assert cache.find(ONE) is None
        assert list(cache.folder.iterdir()) == []


def test_folder_and_files_are_those_of_one_user_alone(
    cache: PsfCache, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache.folder.mkdir(parents=True)
    cache.folder.chmod(0o755)
    umask = os.umask(0)
    try:
        keep(cache, ONE, file)
    finally:
        os.umask(umask)
    (kept,) = cache.folder.iterdir()
    assert cache.folder.stat().st_mode & 0o777 == 0o700
    assert kept.stat().st_mode & 0o777 == 0o600
    keep(cache, ONE, file)
    monkeypatch.setattr(cache_module.os, "geteuid", lambda: cache.folder.stat().st_uid + 1)
    assert cache.find(ONE) is None and cache.psfs() == [] and cache.clear() == 0
    with pytest.raises(DataError, match="cache-of-another-user"):
        keep(cache, OTHER, file)


def test_the_psf_that_was_not_used_for_the_longest_time_makes_room(cache: PsfCache, file: Path) -> None:
    keep(cache, ONE, file, used_at=100)
    keep(cache, OTHER, file, used_at=200)
    cache.find(ONE)  # now ONE was used last
    keep(cache, THIRD, file)
    assert {psf.identity for psf in cache.psfs()} == {ONE, THIRD}


def test_the_last_psf_stays_and_a_file_that_is_too_large_is_not_kept(cache: PsfCache, file: Path) -> None:
    for part in (FITS, "total.fits", "other.fits"):
        cache.keep(ONE, part, file)
    assert [psf.identity for psf in cache.psfs()] == [ONE]
    PsfCache(cache.folder, file.stat().st_size - 1).keep(OTHER, FITS, file)
    PsfCache(cache.folder, 0).keep(OTHER, FITS, file)
    assert {path.name[:64] for path in cache.folder.iterdir()} == {ONE}


def test_failed_writes_and_killed_processes_leave_nothing(
    cache: PsfCache, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def half(_: Path, unfinished: Path) -> None:
        unfinished.write_bytes(b"half")
        raise InterruptedError

    with monkeypatch.context() as patched, pytest.raises(InterruptedError):
        patched.setattr(cache_module.shutil, "copyfile", half)
        cache.keep(ONE, FITS, file)
    assert list(cache.folder.iterdir()) == []
    for name, changed_at in ((".old.part", 0), (".new.part", None)):
        (cache.folder / name).write_bytes(b"half")
        if changed_at is not None:
            os.utime(cache.folder / name, (changed_at, changed_at))
    keep(cache, ONE, file)
    assert not (cache.folder / ".old.part").exists() and (cache.folder / ".new.part").exists()


def test_clear_removes_the_psfs_and_leaves_other_files(cache: PsfCache, file: Path) -> None:
    keep(cache, ONE, file)
    keep(cache, OTHER, file)
    for name in ("notes.txt", ".new.part"):
        (cache.folder / name).write_text("mine")
    assert cache.clear() == 2 * file.stat().st_size
    assert [path.name for path in cache.folder.iterdir()] == ["notes.txt"]
