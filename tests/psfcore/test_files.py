"""Files as their names promise: gzip where the name ends in .gz, and the FITS files of a folder by their endings."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from psfcore.files import check_ending, fits_in, whole_file, whole_path, write_whole


def test_a_name_that_ends_in_gz_gets_gzip(tmp_path: Path) -> None:
    content = b"SIMPLE  = " * 1000
    first, second = tmp_path / "a.fits.gz", tmp_path / "B.FITS.GZ"
    for path in (first, second):
        with whole_path(path) as partial:
            partial.write_bytes(content)
    assert gzip.decompress(first.read_bytes()) == content
    assert second.read_bytes() == first.read_bytes(), "the name and the time are not in the file"
    with whole_file(second) as file:
        file.write(first.read_bytes())
    assert second.read_bytes() == first.read_bytes(), "it was in gzip before"
    write_whole(tmp_path / "a.json", "{}")
    assert (tmp_path / "a.json").read_text() == "{}"
    (tmp_path / "link.gz").symlink_to(tmp_path / "target")
    write_whole(tmp_path / "link.gz", "content")
    assert (tmp_path / "link.gz").is_symlink()
    assert gzip.decompress((tmp_path / "target").read_bytes()) == b"content"
    assert len(list(tmp_path.iterdir())) == 5, "no temporary file is left"


def test_a_compression_that_is_not_written_is_refused() -> None:
    for name in ("a.fits.fz", "A.FZ", "a.fits.bz2", "a.fits.Z"):
        with pytest.raises(OSError, match=r"end the name in \.fits or \.fits\.gz"):
            check_ending(Path(name))
    for name in ("a.fits", "a.fits.gz", "a", "fz"):
        check_ending(Path(name))


def test_the_fits_files_of_a_folder(tmp_path: Path) -> None:
    taken = ["B.FITS", "a.fits", "c.fits.gz", "d.fts", "e.fit", "f.fits.fz", "g.fz", "h.fts.gz", "i.fit.gz"]
    for name in (*taken, "._a.fits", ".hidden.fz", ".DS_Store", "a.gz", "fits", "a.fits.part", "a.txt"):
        (tmp_path / name).touch()
    assert [path.name for path in fits_in(tmp_path)] == taken
