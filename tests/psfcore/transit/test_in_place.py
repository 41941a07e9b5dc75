"""A transit read where it is: the same identity and the same refusals as its archive, and nothing written."""

from __future__ import annotations

from pathlib import Path

import pytest

from psfcore.errors import DataError
from psfcore.transit.archive import ArchiveLimits, list_archive, pack
from psfcore.transit.in_place import transit_in
from tests.transit_files import write_transit
from workers.files.store import sha256_of


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_transit(tmp_path / "transit")
    return tmp_path / "transit"


def test_it_is_identified_by_the_archive_that_is_not_written(folder: Path, tmp_path: Path) -> None:
    before = sorted(path.name for path in folder.iterdir())
    found = transit_in(folder)
    assert sorted(path.name for path in folder.iterdir()) == before
    pack(folder, tmp_path / "transit.tar")
    assert found.sha256 == sha256_of(tmp_path / "transit.tar")
    assert found.bytes == (tmp_path / "transit.tar").stat().st_size
    assert found.contents == list_archive(tmp_path / "transit.tar", ArchiveLimits())
    assert found.folder == folder.resolve()


def test_it_is_refused_as_its_archive_would_be(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError) as none:
        transit_in(tmp_path)
    assert none.value.code == "no-manifest"
    image = next(path for path in sorted(folder.iterdir()) if path.suffix == ".fits")
    image.write_text("not FITS at all")
    with pytest.raises(DataError, match=image.name) as other:
        transit_in(folder)
    assert other.value.code == "not-fits"
    image.unlink()
    with pytest.raises(DataError, match=image.name) as missing:
        transit_in(folder)
    assert missing.value.code == "missing-file"


def test_all_bad_files_are_named_in_one_error_and_nothing_is_written(folder: Path, tmp_path: Path) -> None:
    (folder / "001.fits").unlink()
    (folder / "003.fits").write_text("a letter")
    (folder / "diffraction.fits").unlink()
    for check in (transit_in, lambda folder: pack(folder, tmp_path / "t.tar")):
        with pytest.raises(DataError) as refused:
            check(folder)
        assert refused.value.code == "missing-file"
        for name in ("3 files cannot be used", "001.fits", "003.fits", "diffraction.fits"):
            assert name in refused.value.message
        assert "000.fits" not in refused.value.message
    assert not (tmp_path / "t.tar").exists()
