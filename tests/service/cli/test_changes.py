"""The command `effects`: a folder of images in, a table and a sheet out, whatever some of the files are."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner, Result

import service.cli.changes
from psfcore.psf import Psf
from service.cli.changes import COMMANDS
from tests.conftest import write_image, write_psf


def run(*arguments: object) -> Result:
    return CliRunner().invoke(COMMANDS[0], [str(argument) for argument in arguments])


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
    result = run(folder, folder / "0.fits", tmp_path / "gone.fits", "--psf", folder / "psf.dat", "-o", out)
    assert result.exit_code == 0, result.output
    content = json.loads((out / "effects.json").read_text())
    assert content["schema"] == "effects/1" and content["method"] == {
        "name": "richardson-lucy",
        "steps": None,
    }
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
    options = ("--psf", folder / "psf.dat", "-o", tmp_path, "--method", "linear", "--steps", 3)
    assert run(folder / "0.fits", *options).exit_code == 0
    content = json.loads((tmp_path / "effects.json").read_text())
    assert content["images"][0]["steps_done"] == 3 and content["method"] == {"name": "linear", "steps": 3}


def test_auto_takes_the_psf_of_the_images_instrument(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def build(instrument: object, **_: object) -> Psf:
        asked.append(instrument.name)  # type: ignore[attr-defined]
        kernel = fits.getdata(folder / "psf.dat").astype(float)
        return Psf(kernel, "stand-in", "1", "hri_euv", "draft")

    monkeypatch.setattr("psfcore.build.build_psf", build)
    for n in range(2):
        write_image(tmp_path / f"hri{n}.fits", seed=n, DETECTOR="HRI_EUV", TELESCOP="SOLO/EUI/HRI_EUV")
    result = run(tmp_path / "hri0.fits", tmp_path / "hri1.fits", folder / "0.fits", "-o", tmp_path / "out")
    assert result.exit_code == 0, result.output
    content = json.loads((tmp_path / "out" / "effects.json").read_text())
    assert asked == ["hri_euv"], "built once for both"
    assert {row["psf"] for row in content["images"]} == {"stand-in 1"}
    assert [failure["code"] for failure in content["failures"]] == ["no-psf-for-instrument"]


def test_where_nothing_can_be_done_it_says_so(folder: Path, tmp_path: Path) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    psf = ("--psf", folder / "psf.dat", "-o", tmp_path / "out")
    none = run(folder / "junk.fits", *psf)
    assert none.exit_code == 1 and "none of the images" in none.output
    assert json.loads((tmp_path / "out" / "effects.json").read_text())["failures"][0]["code"] == "not-fits"
    for arguments in (
        (empty, *psf),
        (folder / "0.fits", "--psf", "nowhere.fits", "-o", tmp_path / "o"),
        (folder / "0.fits", "--psf", folder / "junk.fits", "-o", tmp_path / "o"),
        (folder / "0.fits", *psf, "--steps", 0),
    ):
        refused = run(*arguments)
        assert refused.exit_code != 0 and "Traceback" not in refused.output
    assert service.cli.changes.METHODS[0] == "richardson-lucy"
