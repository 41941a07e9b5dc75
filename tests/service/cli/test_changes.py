"""The command `changes`: a folder of images in, a table and a sheet out; and it agrees with `deconvolve`."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner, Result
from fastapi.testclient import TestClient

from service.cli.main import main
from service.client.http import Client
from tests.conftest import write_image, write_psf


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three images, one of them with pits; one of NaN, one that is no FITS file, and a text beside them."""
    folder = tmp_path_factory.mktemp("images")
    for seed in range(3):
        write_image(folder / f"{seed}.fits", seed=seed, **{"DATE-OBS": f"2024-03-1{seed}T00:00:00"})
    pixels = fits.getdata(folder / "1.fits")
    pixels[20:80:5, 70:120:7] = -200
    fits.writeto(folder / "1.fits", pixels, fits.getheader(folder / "1.fits"), overwrite=True)
    fits.PrimaryHDU(np.full((64, 64), np.nan, "f4")).writeto(folder / "nan.fits")
    (folder / "junk.fits").write_text("hello\n" * 100)
    (folder / "notes.txt").write_text("not an image")
    write_psf(folder / "psf.dat")
    return folder


def test_a_folder_is_ranked_tabulated_and_drawn(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    named = (folder, folder / "0.fits", tmp_path / "gone.fits")
    result = run("changes", *named, "--psf", folder / "psf.dat", "-o", out, "--local")
    assert result.exit_code == 0, result.output
    content = json.loads((out / "changes.json").read_text())
    assert content["method"] == {"name": "richardson-lucy", "steps": None}
    files = [Path(row["file"]).name for row in content["images"]]
    assert sorted(files) == ["0.fits", "1.fits", "2.fits"] and files[0] == "1.fits"
    assert content["images"][0]["score"] > 1 > content["images"][1]["score"]
    assert content["images"][0]["taken"] == "2024-03-11T00:00:00"
    assert {Path(f["name"]).name: f["code"] for f in content["failures"]} == {
        "nan.fits": "all-nan",
        "junk.fits": "not-fits",
        "gone.fits": "unreadable-file",
    }
    assert content["summary"]["images"] == 3 and content["summary"]["failures"] == 3
    image = str(folder / "2.fits")
    assert content["inputs_sha256"][image] == hashlib.sha256(Path(image).read_bytes()).hexdigest()
    assert (out / "contact-sheet.png").read_bytes().startswith(b"\x89PNG")
    assert "3 images, 1 to look at, 3 not deconvolved" in result.output
    assert result.output.index("1.fits") < result.output.index("0.fits")


def test_method_and_steps_are_those_asked_for(folder: Path, tmp_path: Path) -> None:
    options = ("--psf", folder / "psf.dat", "-o", tmp_path, "--method", "linear", "--steps", 3, "--local")
    assert run("changes", folder / "0.fits", *options).exit_code == 0
    content = json.loads((tmp_path / "changes.json").read_text())
    assert content["images"][0]["steps_done"] == 3 and content["method"] == {"name": "linear", "steps": 3}


def test_where_nothing_can_be_done_it_says_so(folder: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    psf = ("--psf", folder / "psf.dat", "-o", tmp_path / "out", "--local")
    none = run("changes", folder / "junk.fits", *psf)
    assert none.exit_code == 1 and "no image could be deconvolved" in none.output
    assert json.loads((tmp_path / "out" / "changes.json").read_text())["failures"][0]["code"] == "not-fits"
    for arguments in (
        (empty, *psf),
        (folder / "0.fits", "--psf", "nowhere.fits", "-o", tmp_path / "o", "--local"),
        (folder / "0.fits", "--psf", folder / "junk.fits", "-o", tmp_path / "o", "--local"),
        (folder / "0.fits", *psf, "--steps", 0),
    ):
        refused = run("changes", *arguments)
        assert refused.exit_code != 0 and "Traceback" not in refused.output


@pytest.fixture
def client(api: TestClient, run_jobs: Callable[[], None], monkeypatch: pytest.MonkeyPatch) -> Client:
    """A client of the application in this process, which the commands use; its jobs run at once."""

    class AtOnce(Client):
        def submit(self, kind: str, *, queue: str | None = None, **parameters: Any) -> dict[str, Any]:
            job = super().submit(kind, queue=queue, **parameters)
            run_jobs()
            return job

        def close(self) -> None:
            """The transport is the application's: it goes on."""

    client = AtOnce("http://testserver", transport=api._transport)
    monkeypatch.setattr("service.cli.connection.remote", lambda server: client)
    return client


def test_it_agrees_with_deconvolve_on_a_certified_psf_and_in_a_context(
    client: Client, tmp_path: Path
) -> None:
    """Both take the PSF that the service chooses for the image, and tell the same changes."""
    image = tmp_path / "hri.fits"
    hri = {"DETECTOR": "HRI_EUV", "TELESCOP": "SOLO/EUI/HRI_EUV", "WAVELNTH": 174}
    write_image(image, **hri, **{"DATE-OBS": "2024-03-01T00:00:00"})
    ids = []
    for size in (32, 48):
        write_psf(tmp_path / f"{size}.fits", size=size)
        series = {"instrument": "hri_euv", "channel": "174", "kind": "total"}
        ids.append(client.upload_psf(tmp_path / f"{size}.fits", name=f"p{size}", **series)["id"])
    client.certify_psf(ids[0], "1.0.0")
    client.create_context("first")
    client.certify_psf(ids[1], "1.1.0", supersedes=[ids[0]])
    for n, (chosen, context) in enumerate(((ids[1], ()), (ids[0], ("--context", "first")))):
        one = run("deconvolve", image, "-o", tmp_path / "d.fits", "--steps", 4, "--overwrite", *context)
        many = run("changes", image, "-o", tmp_path / f"out{n}", "--steps", 4, *context)
        assert one.exit_code == many.exit_code == 0, one.output + many.output
        product = client.product(fits.getheader(tmp_path / "d.fits")["PRODID"])
        content = json.loads((tmp_path / f"out{n}" / "changes.json").read_text())
        assert product["psf_id"] == chosen
        made = content["products"][str(image)]
        assert (made["id"], made["psf_id"]) == (product["id"], chosen)
        row = content["images"][0]
        assert row["psf"] == f"{'p32 1.0.0' if context else 'p48 1.1.0'}"
        assert row["score"] == product["details"]["changes"]["artefacts"]["score"]
        assert row["flux_change_pct"] == product["details"]["changes"]["flux_change_pct"]
        assert product["details"]["changes"] in row.values(), "the figures are the product's own"
