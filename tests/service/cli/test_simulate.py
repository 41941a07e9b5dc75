"""The commands that simulate transits, as a user calls them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from astropy.io import fits
from click.testing import CliRunner, Result

from service.cli.main import main
from tests.conftest import write_image, write_psf

SMALL = ("--size", "64", "--images", "3")


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["simulate", *[str(argument) for argument in arguments]])


@pytest.fixture(scope="module")
def diffraction(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("psf") / "known.fits"
    write_psf(path)
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, diffraction: Path) -> Path:
    folder = tmp_path_factory.mktemp("transits") / "one"
    result = run("transit", "-o", folder, *SMALL, "--diffraction", diffraction, "--stretch", "0.1")
    assert result.exit_code == 0, result.output
    assert "3 images of 64 x 64 px, 3 pointings, exposures of 1.8 and 5 s" in result.output
    return folder


def test_a_folder_is_written_with_its_truth(made: Path) -> None:
    described = json.loads((made / "transit.json").read_text())
    assert [entry["fov"] for entry in described["images"]] == [1, 2, 3]
    for entry in described["images"]:
        assert fits.getdata(made / entry["file"]).shape == (64, 64)
    truth = json.loads((made / "truth.json").read_text())
    assert truth["psf"]["b"] == 6.15 and truth["psf"]["stretch"] == 0.1
    assert fits.getdata(made / "diffraction.fits").shape == (64, 64)


def test_the_diffraction_psf_of_a_folder_is_not_deconvolved(
    made: Path, diffraction: Path, tmp_path: Path
) -> None:
    how = ("--psf", diffraction, "--other-channel", "--steps", 1, "--local")
    done = CliRunner().invoke(
        main, [str(word) for word in ("deconvolve", made, "-o", tmp_path / "out", *how)]
    )
    assert f"failed: {made}/diffraction.fits: expected an image; the header (PSFSUM)" in done.output
    assert "4 images: 3 deconvolved, 0 existed already, 1 failed" in done.output


def test_the_bound_is_said_and_written(made: Path, tmp_path: Path) -> None:
    result = run("bound", made, "--json", tmp_path / "bound.json")
    assert result.exit_code == 0, result.output
    content = json.loads((tmp_path / "bound.json").read_text())
    assert f"total {content['sigma']['total']:.3g}" in result.output
    assert len(content["places"]) == content["images"] == 3
    assert all(at["total_sigma"] > 0 for at in content["curve"])


def test_what_is_asked_for_is_simulated(tmp_path: Path, diffraction: Path) -> None:
    options = ["--saturation", "200", "--dark-offset", "5", "--beyond", "on", "--dipole", "0.2"]
    options += ["--stretch-angle", "30", "--seed", "7", "--total", "0.3", "--b", "5", "--c", "2.4"]
    result = run("transit", "-o", tmp_path / "t", *SMALL, "--diffraction", diffraction, *options)
    assert result.exit_code == 0, result.output
    truth = json.loads((tmp_path / "t/truth.json").read_text())
    law = {"b": 5.0, "c": 2.4, "total": 0.3, "stretch": 0.0, "angle_deg": 30.0, "dipole": 0.2}
    assert {name: truth["psf"][name] for name in law} == law
    assert truth["seed"] == 7
    assert fits.getdata(tmp_path / "t/001.fits").max() == 200
    assert fits.getdata(tmp_path / "t/scenes/fov1.fits").shape == (128, 128)


def test_a_folder_in_use_is_left_alone(made: Path, diffraction: Path, tmp_path: Path) -> None:
    used = shutil.copytree(made, tmp_path / "used")
    before = (used / "truth.json").read_bytes()
    again = ("transit", "-o", used, *SMALL, "--diffraction", diffraction, "--seed", "2")
    refused = run(*again)
    assert refused.exit_code == 1 and "not empty" in refused.output
    nowhere = run("transit", "-o", tmp_path / "no/such/folder", *SMALL)
    assert nowhere.exit_code == 1 and "there is no folder" in nowhere.output
    assert (used / "truth.json").read_bytes() == before
    forced = run(*again, "--overwrite")
    assert forced.exit_code == 0, forced.output
    assert (used / "truth.json").read_bytes() != before


def test_what_cannot_be_is_refused_in_a_line(tmp_path: Path) -> None:
    for options, said in (
        (["--c", "-1"], "c > 0"),
        (["--size", "32"], "64<=x"),
        (["--images", "0"], "1<=x"),
        (["--diffraction-size", "97"], "even size"),
        (["--instrument", "no-such"], "no-such"),
        (["--diffraction", "missing.fits"], "missing.fits"),
    ):
        result = run("transit", "-o", tmp_path / "t", *SMALL, *options)
        assert result.exit_code in (1, 2)
        assert said in result.output
        assert "Traceback" not in result.output and isinstance(result.exception, SystemExit)
        assert not (tmp_path / "t").exists()


def test_files_that_do_not_fit_are_refused(tmp_path: Path, diffraction: Path) -> None:
    write_psf(tmp_path / "half.fits", scale=0.5)
    result = run("transit", "-o", tmp_path / "t", *SMALL, "--diffraction", tmp_path / "half.fits")
    assert result.exit_code == 1 and "sum to 1" in result.output
    write_image(tmp_path / "sun.fits", shape=(64, 64))
    two = ("--scene", tmp_path / "sun.fits", "--scene", tmp_path / "sun.fits")
    result = run("transit", "-o", tmp_path / "t", *SMALL, "--diffraction", diffraction, *two)
    assert result.exit_code == 1 and "expected one scene image, or 3" in result.output
