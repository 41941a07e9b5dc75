"""Published PSFs: the list, the download from a server on this machine, the hash of the first time, and folders."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest
from astropy.io import fits

from psfcore.errors import DataError
from psfcore.fits.psfs import read_psf
from psfcore.published_psfs import LIMITS, PUBLISHED, get, kept_file
from tests.published_server import NAME, published_fits, stand_in


def test_the_list_names_each_file_once_and_how_to_cite_it() -> None:
    telescopes = [one.telescope.split("/")[1] for one in PUBLISHED.values()]
    assert {name: telescopes.count(name) for name in telescopes} == {"AIA": 7, "XRT": 2, "EUVI": 8}
    assert len({one.file for one in PUBLISHED.values()}) == len(PUBLISHED) == 17
    for one in PUBLISHED.values():
        assert one.citation and one.place and (one.doi or "SolarSoft" in one.citation)
        assert all(address.startswith("https://") for address in one.addresses)


def test_a_download_is_kept_as_a_psf_that_says_what_it_is(tmp_path: Path) -> None:
    with stand_in("/psf") as server:
        server.broken = 1
        kept = get(tmp_path, NAME)
        assert server.asked == ["/psf", "/psf"], "the first answer ended too early"
        assert get(tmp_path, NAME) == kept == kept_file(tmp_path, NAME) and len(server.asked) == 2
    psf = read_psf(kept, LIMITS)
    with fits.open(kept) as hdus:
        header, stored = hdus[0].header, hdus[0].data
        assert (header["PSFDOI"], header["WAVELNTH"]) == ("10.3847/1538-4365/adbaed", 193)
        assert "10.7910/DVN/DYT4ZL" in header["PSFREF"] and stored.dtype.itemsize == 4
    assert (psf.name, psf.version, psf.instrument, psf.plate_scale_arcsec) == (NAME, "2025", "aia_193", 0.6)
    assert psf.provenance["doi"] == "10.3847/1538-4365/adbaed"
    sha256 = hashlib.sha256(published_fits()).hexdigest()
    assert json.loads((tmp_path / f"{NAME}.json").read_bytes())["sha256"] == sha256
    assert f"published_sha256: {sha256}" in "".join(psf.provenance["history"])
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{NAME}.fits", f"{NAME}.json"]


def test_a_broken_download_is_resumed_if_the_server_has_the_same_file(tmp_path: Path) -> None:
    whole = len(published_fits(200))
    for again, rest in ((published_fits(200), False), (published_fits(200, total=0.5), True)):
        folder = tmp_path / str(rest)
        with stand_in("/psf") as server:
            server.files["/psf"] = published_fits(200)
            server.broken = 2  # both tries of the first download
            with pytest.raises(DataError, match="psf-not-downloaded"):
                get(folder, NAME)
            kept = (folder / f"{NAME}.part").stat().st_size
            assert 0 < kept < whole and server.sent[0] == whole > server.sent[1]
            server.files["/psf"] = again
            get(folder, NAME)
        assert server.sent[2] == (whole if rest else whole - kept)
        record = json.loads((folder / f"{NAME}.json").read_bytes())
        assert record["sha256"] == hashlib.sha256(again).hexdigest()
        assert sorted(path.name for path in folder.iterdir()) == [f"{NAME}.fits", f"{NAME}.json"]


def test_another_file_than_the_first_time_is_refused(tmp_path: Path) -> None:
    with stand_in("/gone", "/psf") as server:
        kept = get(tmp_path, NAME)
        assert server.asked == ["/gone", "/gone", "/psf"], "the second address is asked if the first fails"
        first = kept.read_bytes()
        kept.unlink()
        server.files["/psf"] = published_fits(98)
        with pytest.raises(DataError, match="published-psf-changed"):
            get(tmp_path, NAME)
        assert not kept.exists()
        server.files["/psf"] = published_fits()
        assert get(tmp_path, NAME).read_bytes() == first
        server.files.clear()
        kept.unlink()
        with pytest.raises(DataError, match=rf"psf-not-downloaded.*{server.address}/psf.*404.*--from"):
            get(tmp_path, NAME)


def test_a_folder_stands_in_for_the_internet(tmp_path: Path) -> None:
    name, folder = "euvi_171_b_2012", tmp_path / "usb"
    with pytest.raises(DataError, match=f"psf-not-fetched.*heliopsf psf get {name}"):
        kept_file(tmp_path, name)
    with pytest.raises(DataError, match=r"no-address.*euvdeconpak.*--from"):
        get(tmp_path, name)
    folder.mkdir()
    with pytest.raises(DataError, match=r"no-such-file.*psf_171_B_2048\.fts"):
        get(tmp_path, name, source=folder)
    (folder / PUBLISHED[name].file).write_bytes(published_fits(total=3.0))
    psf = read_psf(get(tmp_path, name, source=folder), LIMITS)
    assert psf.total == pytest.approx(1, abs=1e-6)
    assert "divided_by: the sum of the published weights, 3" in "".join(psf.provenance["history"])
    assert psf.cards == {"OBSRVTRY": "STEREO_B", "DETECTOR": "EUVI"}
    (folder / PUBLISHED[name].file).write_bytes(b"<html>not found</html>")
    (tmp_path / f"{name}.json").unlink()
    with pytest.raises(DataError, match="not-fits"):
        get(tmp_path, name, source=folder)
    with pytest.raises(DataError, match=r"unknown-published-psf.*aia_193_2025"):
        get(tmp_path, "aia_193_2052")
