"""Published PSFs: the list, the download from a server on this machine, servers that answer wrongly, and folders."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from astropy.io import fits

from psfcore.errors import DataError
from psfcore.fits.cards import Cards
from psfcore.fits.psfs import read_psf
from psfcore.instruments.published import PUBLISHED
from psfcore.published_psfs import LIMITS, get, kept_file, published_of
from tests.published_server import CHECKSUM, NAME, SIZE_PX, answer, published_fits, stand_in


def test_the_list_names_each_file_once_and_how_to_cite_it() -> None:
    telescopes = [one.telescope.split("/")[1] for one in PUBLISHED.values()]
    assert {name: telescopes.count(name) for name in telescopes} == {"AIA": 7, "XRT": 2, "EUVI": 8}
    assert len({one.file for one in PUBLISHED.values()}) == len(PUBLISHED) == 17
    for one in PUBLISHED.values():
        assert one.citation and one.place and (one.doi or "SolarSoft" in one.citation)
        asked = [*one.addresses, *filter(None, [one.checksum_address])]
        assert {"https://" + urlsplit(address).netloc for address in asked} <= set(one.origins)
        assert all(origin.startswith("https://") for origin in one.origins)
        assert bool(one.addresses) == bool(one.sha256 or one.checksum_address), "a download has a checksum"


@pytest.mark.parametrize(
    ("cards", "name"),
    [
        ({"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_3", "WAVELNTH": 171}, "aia_171_2025"),
        ({"TELESCOP": "SDO/AIA", "WAVELNTH": 304}, "aia_304_2025"),
        ({"OBSRVTRY": "STEREO_A", "DETECTOR": "EUVI", "WAVELNTH": 304}, "euvi_304_a_2012"),
        (
            {"TELESCOP": "STEREO", "INSTRUME": "SECCHI", "OBSRVTRY": "STEREO_B", "WAVELNTH": 171},
            "euvi_171_b_2012",
        ),
    ],
)
def test_an_image_has_the_published_psf_of_its_telescope(cards: Cards, name: str) -> None:
    assert published_of(cards).name == name


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
    assert f"published_sha256: {sha256}" in "".join(psf.provenance["history"])
    assert [path.name for path in tmp_path.iterdir()] == [f"{NAME}.fits"]


def test_a_broken_download_is_resumed_if_the_server_has_the_same_file(tmp_path: Path) -> None:
    content = published_fits(SIZE_PX)
    whole = len(content)
    for again, rest in ((content, False), (published_fits(SIZE_PX, total=0.5), True)):
        folder = tmp_path / str(rest)
        with stand_in("/psf") as server:
            server.files["/psf"] = server.published = content
            server.broken = 2  # both tries of the first download
            with pytest.raises(DataError, match="psf-not-downloaded"):
                get(folder, NAME)
            (part,) = folder.glob(f"{NAME}.*.part")
            kept = part.stat().st_size
            assert 0 < kept < whole and server.sent[0] == whole > server.sent[1]
            server.files["/psf"] = server.published = again
            psf = read_psf(get(folder, NAME), LIMITS)
        assert server.sent[2] == (whole if rest else whole - kept)
        assert f"published_sha256: {hashlib.sha256(again).hexdigest()}" in "".join(psf.provenance["history"])
        assert [path.name for path in folder.iterdir()] == [f"{NAME}.fits"]


def test_the_next_address_is_asked_if_one_fails_or_has_another_file(tmp_path: Path) -> None:
    with stand_in("/gone", "/other", "/psf") as server:
        server.files["/other"] = published_fits(total=0.5)
        get(tmp_path, NAME)
        assert server.asked == ["/gone", "/gone", "/other", "/psf"]
        server.files.clear()
        (tmp_path / f"{NAME}.fits").unlink()
        with pytest.raises(DataError, match=rf"psf-not-downloaded.*{server.address}/psf.*404.*--from"):
            get(tmp_path, NAME)


Fault = Callable[[BaseHTTPRequestHandler], None]


def other_bytes(request: BaseHTTPRequestHandler) -> None:
    answer(request, 200, published_fits(total=0.5))


def nothing_yet(request: BaseHTTPRequestHandler) -> None:
    answer(request, 202)


def announces_much(request: BaseHTTPRequestHandler) -> None:
    answer(request, 200, b"SIMPLE", Content_Length=1000 * SIZE_PX**2)


def sends_much(request: BaseHTTPRequestHandler) -> None:
    """Sends without a length until the client goes away."""
    answer(request, 200, Content_Length=None, Connection="close")
    for _ in range(100):
        request.wfile.write(bytes(8 * SIZE_PX**2))


def no_json(request: BaseHTTPRequestHandler) -> None:
    answer(request, 200, b"<html>sign in</html>")


def tells(algorithm: str, value: str) -> Fault:
    checksum = {"data": {"dataFile": {"checksum": {"type": algorithm, "value": value}}}}
    return lambda request: answer(request, 200, json.dumps(checksum).encode())


def to(address: str) -> Fault:
    return lambda request: answer(request, 302, Location=address)


@pytest.mark.parametrize(
    ("path", "fault", "reason"),
    [
        ("/psf", other_bytes, "expected the md5 [0-9a-f]{32}; got"),
        ("/psf", nothing_yet, "status 202"),
        ("/psf", announces_much, "more than twice as much"),
        ("/psf", sends_much, "more than twice as much"),
        ("/psf", to("/psf"), "at most 5 redirections"),
        (CHECKSUM, no_json, "expected the checksum of psf_aia_193.fits"),
        (CHECKSUM, tells("CRC", "00"), "expected the checksum of psf_aia_193.fits"),
        (CHECKSUM, tells("MD5", "/../../x"), "expected the checksum of psf_aia_193.fits"),
        (CHECKSUM, lambda request: request.send_error(503), "503"),
    ],
)
def test_what_a_server_sends_wrongly_is_not_kept(
    tmp_path: Path, path: str, fault: Fault, reason: str
) -> None:
    with stand_in("/psf") as server:
        server.faults[path] = fault
        with pytest.raises(DataError, match=f"psf-not-downloaded.*{reason}"):
            get(tmp_path, NAME)
        assert not (tmp_path / f"{NAME}.fits").exists()
        server.faults.clear()
        assert get(tmp_path, NAME).is_file()


@pytest.mark.parametrize("path", ["/psf", CHECKSUM])
def test_redirections_stay_at_the_servers_of_the_repository(tmp_path: Path, path: str) -> None:
    with stand_in("/elsewhere") as other, stand_in("/psf") as server:
        elsewhere = (other.address + "/elsewhere", "http://127.0.0.1/psf", "https://localhost/psf")
        for address in (*elsewhere, server.address.replace("//", "//user@") + path, "file:///etc/passwd"):
            server.faults[path] = to(address)
            with pytest.raises(
                DataError, match=f"psf-not-downloaded.*expected an address at {server.address}"
            ):
                get(tmp_path, NAME)
        assert other.asked == []
        told = tells("SHA-256", hashlib.sha256(published_fits()).hexdigest())
        server.faults = {"/psf": to("/file"), CHECKSUM: to(server.address + "/told"), "/told": told}
        server.files["/file"] = published_fits()
        assert get(tmp_path, NAME).is_file()


@pytest.mark.parametrize(
    "extent",
    ["bytes 0-9/10", "bytes 7-{last}/{size}", "bytes {first}-{last}/*", "items {first}-{last}/{size}", ""],
)
def test_a_rest_that_is_another_part_is_not_appended(tmp_path: Path, extent: str) -> None:
    content = published_fits(SIZE_PX)
    with stand_in("/psf") as server:
        server.files["/psf"] = server.published = content
        server.broken = 2
        with pytest.raises(DataError, match="psf-not-downloaded"):
            get(tmp_path, NAME)

        def wrong(request: BaseHTTPRequestHandler) -> None:
            first = int(request.headers["Range"][len("bytes=") : -1])
            told = extent.format(first=first, last=len(content) - 1, size=len(content))
            del server.faults["/psf"]
            answer(request, 206, content[first:], Content_Range=told)

        server.faults["/psf"] = wrong
        assert get(tmp_path, NAME).is_file()
        assert server.sent[-1] == len(content), "the whole file was asked for again"


def test_a_folder_stands_in_for_the_internet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
    with pytest.raises(DataError, match="not-fits"):
        get(tmp_path, name, source=folder)
    xrt = "xrt_560ev_2017"
    (folder / PUBLISHED[xrt].file).write_bytes(published_fits())
    with pytest.raises(DataError, match=f"published-psf-changed.*{PUBLISHED[xrt].sha256}"):
        get(tmp_path, xrt, source=folder)
    here = replace(PUBLISHED[xrt], sha256=hashlib.sha256(published_fits()).hexdigest())
    monkeypatch.setitem(PUBLISHED, xrt, here)
    assert get(tmp_path, xrt, source=folder).is_file()
    with pytest.raises(DataError, match=r"unknown-published-psf.*aia_193_2025"):
        get(tmp_path, "aia_193_2052")
