"""The command `flare`, as a user calls it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner, Result

from service.cli.main import main
from tests.simulated_flare import CENTRE, SATURATION, flare_psf, write_flare

NOISE = ("--noise", 6, 2)
SATURATED = ("--saturation", SATURATION)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return write_flare(tmp_path_factory.mktemp("flare"))


def run(files: dict[str, Path], *options: object, **other: Path) -> Result:
    used = files | other
    fixed = (used["flare"], "--background", used["before"], "--psf", used["psf"])
    return CliRunner().invoke(main, ["flare", *[str(argument) for argument in (*fixed, *options)]])


def test_a_psf_is_judged_along_an_arm(files: dict[str, Path], tmp_path: Path) -> None:
    out, plot = tmp_path / "flare.json", tmp_path / "flare.png"
    result = run(files, *NOISE, *SATURATED, "--arm", 0, "--json", out, "--plot", plot)
    assert result.exit_code == 0, result.output
    found = json.loads(out.read_text())
    assert tuple(found["centre_xy"]) == CENTRE and found["arm_deg"] == 0
    assert found["total"]["chi2_per_distance"] < 1.5 and found["chi2_factor"] > 7
    assert len(found["observed"]) == len(found["distance_px"]) == len(found["total"]["simulated"])
    assert f"{found['rms_factor']:.1f} times the rms error" in result.output
    assert "note:" not in result.output
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_the_arm_nearest_to_x_is_measured(files: dict[str, Path], tmp_path: Path) -> None:
    result = run(files, *SATURATED, "--json", tmp_path / "f.json")
    assert result.exit_code == 0, result.output
    found = json.loads((tmp_path / "f.json").read_text())
    assert abs(found["arm_deg"]) < 0.1
    assert found["sigma"] is None and found["total"]["chi2_per_distance"] is None
    assert found["rms_factor"] > 1.5


def test_what_is_no_flare_is_said(files: dict[str, Path], tmp_path: Path) -> None:
    with fits.open(files["flare"]) as hdus:
        y, x = np.indices(hdus[0].data.shape)
        pixels = hdus[0].data + 1.2e4 * np.exp(-((x - 60) ** 2 + (y - 60) ** 2) / 600)
        fits.PrimaryHDU(pixels.astype("f4"), hdus[0].header).writeto(tmp_path / "busy.fits")
    options = (*NOISE, *SATURATED, "--arm", 0, "--centre", *CENTRE)
    busy = run(files, *options, flare=tmp_path / "busy.fits")
    assert busy.exit_code == 0 and "says little about the PSF" in busy.output
    fits.PrimaryHDU(flare_psf().kernel.astype("f4")).writeto(tmp_path / "plain.fits")
    plain = run(files, *options, psf=tmp_path / "plain.fits")
    assert plain.exit_code == 0 and "so diffraction alone is not compared" in plain.output


def test_what_cannot_be_judged_is_one_line(files: dict[str, Path], tmp_path: Path) -> None:
    noisy = tmp_path / "noisy.fits"
    with fits.open(files["before"]) as hdus:
        noise = np.random.default_rng(1).normal(0, 30, hdus[0].data.shape)
        fits.PrimaryHDU((hdus[0].data + noise).astype("f4"), hdus[0].header).writeto(noisy)
    for result, wanted in (
        (run(files, *SATURATED, "--arm", 0, "--centre", 5000, 5), "expected a centre"),
        (run(files, *NOISE, flare=noisy), "give the direction with --arm"),
    ):
        assert result.exit_code == 1 and result.output.startswith("Error: "), result.output
        assert wanted in result.output, result.output
