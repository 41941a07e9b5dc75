"""``heliopsf psf published|get``, ``store psf get`` and a deconvolution that names a published PSF.
The command ``heliopsf cache``: lists and removes the built PSFs that are kept.
``heliopsf psf fit``: what it prints of a fit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from astropy.io import fits
from click.testing import CliRunner
from fastapi.testclient import TestClient

import heliopsf
from psfcore.errors import DataError
from psfcore.instruments.psf_statements import caveats
from psfcore.instruments.published import PUBLISHED
from service.cli.main import main
from service.client.http import Client
from tests.conftest import SMALL_INSTRUMENT, write_image, write_psf
from tests.published_server import NAME, published_fits, stand_in
from workers.settings import Settings

DOI = "10.3847/1538-4365/adbaed"


@pytest.fixture(autouse=True)
def image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An image of the PSF's channel. The published PSFs are kept in a folder of the test."""
    monkeypatch.setenv("HELIOPSF_CACHE_DIR", str(tmp_path / "cache"))
    cards = {"TELESCOP": "SDO/AIA", "INSTRUME": "AIA_2", "WAVELNTH": 193, "CUNIT1": "arcsec", "CDELT1": 0.6}
    write_image(tmp_path / "i.fits", **cards | {"CUNIT2": "arcsec", "CDELT2": 0.6, "PSFDOI": "10.1/earlier"})
    return tmp_path / "i.fits"


def local(*words: object, code: int = 0) -> str:
    """A command without the client of the application in this process."""
    done = CliRunner().invoke(main, [str(word) for word in words])
    assert done.exit_code == code, done.output
    return done.output


def test_get_deconvolve_and_header_with_the_doi(image: Path, tmp_path: Path) -> None:
    product = tmp_path / "o.fits"
    asked = ("deconvolve", image, "--psf", NAME, "--local", "--steps", 2, "-o", product)
    assert f"`heliopsf psf get {NAME}`" in local(*asked, code=1)
    with pytest.raises(DataError, match="psf-not-fetched"):
        heliopsf.deconvolve(image, NAME)
    with stand_in("/psf"):
        assert DOI in local("psf", "get", NAME)
    assert f"* {NAME} " in local("psf", "published") and f"  {'xrt_1kev_2017':<16}" in local(
        "psf", "published"
    )
    local(*asked)
    header = fits.getheader(product)
    assert (header["PSFNAME"], header["PSFVERS"], header["PSFDOI"]) == (NAME, "2025", DOI)
    assert PUBLISHED[NAME].citation in "".join(header["HISTORY"])
    same = heliopsf.deconvolve(fits.open(image), NAME, steps=2)
    assert same[0].header["PSFDOI"] == DOI and same[0].header["PSFID"] == header["PSFID"]
    other = heliopsf.deconvolve(
        fits.open(image), heliopsf.read_psf(tmp_path / "cache/published" / f"{NAME}.fits").kernel, steps=2
    )
    assert "PSFDOI" not in other[0].header, "that of an earlier product does not stay"
    write_image(tmp_path / "171.fits", TELESCOP="SDO/AIA", WAVELNTH=171)
    assert "193" in local("deconvolve", tmp_path / "171.fits", *asked[2:-1], tmp_path / "x.fits", code=1)
    assert f"did you mean '{NAME}'" in local(
        "deconvolve", image, "--psf", "aia_193_2052", "-o", product, code=2
    )


def test_published_means_the_published_psf_of_the_image(image: Path, tmp_path: Path) -> None:
    asked = ("deconvolve", image, "--psf", "published", "--local", "--steps", 2, "-o", tmp_path / "o.fits")
    assert f"`heliopsf psf get {NAME}`" in local(*asked, code=1), "it is not there yet"
    assert f"  {NAME} " in local("psf", "get"), "without a name: the list"
    with stand_in("/psf"):
        local("psf", "get", NAME)
    local(*asked)
    header = fits.getheader(tmp_path / "o.fits")
    assert header["PSFNAME"] == NAME
    same = heliopsf.deconvolve(fits.open(image), "published", steps=2)
    assert same[0].header["PSFID"] == header["PSFID"]
    write_image(tmp_path / "1600.fits", TELESCOP="SDO/AIA", WAVELNTH=1600)
    with pytest.raises(DataError, match="no-published-psf"):
        heliopsf.deconvolve(tmp_path / "1600.fits", "published")
    write_image(tmp_path / "xrt.fits", TELESCOP="HINODE", INSTRUME="XRT")
    with pytest.raises(DataError, match=r"no-published-psf.*xrt_560ev_2017, xrt_1kev_2017"):
        heliopsf.deconvolve(tmp_path / "xrt.fits", "published")


def test_an_operator_adds_a_psf_for_all_and_its_citation_is_in_the_lineage(
    image: Path,
    tmp_path: Path,
    api: TestClient,
    settings: Settings,
    command: Callable[..., str],
    client: Client,
) -> None:
    (tmp_path / "usb").mkdir()
    (tmp_path / "usb" / PUBLISHED[NAME].file).write_bytes(published_fits())
    api.app.state.heliopsf.catalogue.keys.make("ann", {"read"})
    get = ("store", "psf", "get", NAME, "--from", tmp_path / "usb", "--data", settings.data_dir)
    told = command(*get)
    assert "not compared with a checksum" in told
    assert "ann: added" in told and "local: added" in told and "local: was there" in command(*get)
    (row,) = client.psfs(name=NAME)
    assert [row[key] for key in ("instrument", "channel", "kind", "status")] == [
        "aia_193",
        "193",
        "total",
        "draft",
    ]
    (tmp_path / "cache" / "published" / f"{NAME}.fits").unlink()  # the service has it
    command("deconvolve", image, "--psf", NAME, "--steps", 2, "-o", tmp_path / "o.fits")
    header = fits.getheader(tmp_path / "o.fits")
    assert (header["PSFID"], header["PSFDOI"]) == (row["id"], DOI)
    parents = client.get(f"/v1/products/{header['PRODID']}/lineage")["parents"]
    (made,) = [one["made"] for one in parents if one["type"] == "psf"]
    assert (made["doi"], made["citation"]) == (DOI, PUBLISHED[NAME].citation)
    assert "1.0.0: certified" in command("psf", "certify", row["id"], "--version", "1.0.0")


# --- the built PSFs that are kept -----------------------------------------------------------------------


def run(*words: str) -> str:
    done = CliRunner().invoke(main, list(words))
    assert done.exit_code == 0, done.output
    return done.output


def test_the_cache_is_listed_and_cleared(tmp_path: Path) -> None:
    assert run("cache", "list").startswith("0 PSFs, 0.0 of 2048 MiB")
    (tmp_path / "small.toml").write_text(SMALL_INSTRUMENT)
    built = run(
        "psf",
        "build",
        "--instrument",
        str(tmp_path / "small.toml"),
        "--size",
        "64",
        "-o",
        str(tmp_path / "a.fits"),
        "--local",
    )
    assert " 20 px" in built and " 50 px" not in built, "the PSF reaches 45 px"
    listed = run("cache", "list").splitlines()
    assert len(listed) == 2 and listed[0].endswith("your instrument file, 64 px")
    assert listed[1].startswith("1 PSFs")
    assert run("cache", "clear").startswith("removed 1 PSFs")
    assert run("cache", "list").startswith("0 PSFs")


def test_a_built_psf_is_described_as_its_file_is(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(SMALL_INSTRUMENT)
    file = str(tmp_path / "a.fits")
    built = run(
        "psf", "build", "--instrument", str(tmp_path / "small.toml"), "--size", "64", "-o", file, "--local"
    )
    psf = heliopsf.read_psf(file)
    said = caveats(psf.name, psf.instrument, psf.provenance)
    assert said and all(one in built and one in run("psf", "show", file) for one in said)
    write_psf(tmp_path / "b.fits")
    assert "plate scale unknown\n" in run("psf", "show", str(tmp_path / "b.fits"))


def test_a_wrong_size_is_told_in_one_line() -> None:
    done = CliRunner(env={"HELIOPSF_CACHE_MIB": "much"}).invoke(main, ["cache", "list"])
    assert done.exit_code == 1
    assert done.output.startswith("Error: HELIOPSF_CACHE_MIB: expected a whole number")


# --- a fit -----------------------------------------------------------------------------------------------
