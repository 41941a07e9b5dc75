"""The command that evaluates a PSF on a transit, as a user calls it."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner, Result
from service.cli.evaluate import COMMANDS, _built_diffraction

from psfcore.fits.fits_io import write_psf as write_whole_psf
from psfcore.simulate.scatter_truth import total_kernel
from psfcore.simulate.transit import INSTRUMENT, PLATE_SCALE_ARCSEC
from psfcore.simulate.transit_files import write
from tests.conftest import write_psf
from tests.psfcore.conftest import make_psf
from tests.psfcore.small_transits import DIFFRACTION, IMAGES, SCATTER, SIZE_PX, observed, sky

SCALE = PLATE_SCALE_ARCSEC


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(COMMANDS[0], [str(argument) for argument in arguments])


def refused(result: Result, *said: str) -> None:
    """In one line, without a traceback."""
    assert result.exit_code in (1, 2), result.output
    assert isinstance(result.exception, SystemExit)
    last = result.output.strip().splitlines()[-1]
    assert last.startswith("Error: ")
    for part in said:
        assert part in last


@pytest.fixture(scope="module")
def transit(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("transits") / "small"
    write(observed(sky()), folder)
    return folder


def write_total(path: Path, total: float = SCATTER.total, **changes: Any) -> Path:
    kernel = total_kernel(dataclasses.replace(SCATTER, total=total), DIFFRACTION, 2 * SIZE_PX)
    known: dict[str, Any] = {"name": "true", "plate_scale_arcsec": SCALE}
    write_whole_psf(path, make_psf(kernel, **(known | changes)))
    return path


@pytest.fixture(scope="module")
def true_psf(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_total(tmp_path_factory.mktemp("psfs") / "true.fits")


def changed(transit: Path, folder: Path, **content: Any) -> Path:
    """A copy with other content in its transit.json; None takes a key away."""
    copy = shutil.copytree(transit, folder)
    described = json.loads((copy / "transit.json").read_text()) | content
    (copy / "transit.json").write_text(json.dumps({k: v for k, v in described.items() if v is not None}))
    return copy


# --- a PSF that is named ----------------------------------------------------------------------------------


def test_a_psf_is_evaluated_and_told(transit: Path, true_psf: Path, tmp_path: Path) -> None:
    out, plot = tmp_path / "r.json", tmp_path / "r.png"
    result = run(transit, "--psf", true_psf, "--json", out, "--plot", plot)
    assert result.exit_code == 0, result.output
    said = json.loads(out.read_text())
    assert said["schema"] == "evaluation/1" and said["psf"]["name"] == "true"
    assert said["psf"]["held_out"] is False and len(said["psf"]["sha256"]) == 64
    assert len(said["frames"]) == IMAGES and len(said["inputs_sha256"]) == IMAGES + 2
    assert "dark_offsets" not in said
    assert abs(said["all"]["mean_pct"]) < 4 * said["all"]["mean_noise_pct"]
    lines = result.output.splitlines()
    assert lines[0] == "PSF true 1 (no test of it where it was fitted to these images); 12 images of small"
    whole = said["all"]
    assert f"all pointings: 12 images, mean {whole['mean_pct']:+.2f} %" in result.output
    assert sum(line.startswith("pointing ") and "images" in line for line in lines) == 3
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_too_much_scatter_is_told(transit: Path, tmp_path: Path) -> None:
    file = write_total(tmp_path / "more.fits", 1.3 * SCATTER.total)
    result = run(transit, "--psf", file, "--json", tmp_path / "r.json")
    assert result.exit_code == 0, result.output
    said = json.loads((tmp_path / "r.json").read_text())
    assert said["all"]["mean_pct"] > 12
    assert all(p["mean_pct"] > 8 for p in said["pointings"])


def test_a_psf_that_is_named_needs_no_known_diffraction(
    transit: Path, true_psf: Path, tmp_path: Path
) -> None:
    bare = changed(transit, tmp_path / "bare", known_psf=None)
    results = [run(folder, "--psf", true_psf) for folder in (bare, transit)]
    assert results[0].exit_code == 0, results[0].output
    assert results[0].output.splitlines()[1:] == results[1].output.splitlines()[1:]


def test_noise_figures_may_come_with_the_command(transit: Path, true_psf: Path, tmp_path: Path) -> None:
    bare = changed(transit, tmp_path / "bare", noise=None)
    refused(run(bare, "--psf", true_psf), "noise", "got none")
    result = run(bare, "--psf", true_psf, "--noise", "24", "4", "--json", tmp_path / "r.json")
    assert result.exit_code == 0, result.output
    run(transit, "--psf", true_psf, "--json", tmp_path / "s.json")
    loud, quiet = (json.loads((tmp_path / name).read_text())["all"] for name in ("r.json", "s.json"))
    assert loud["noise_pct"] == pytest.approx(2 * quiet["noise_pct"], rel=0.05)


# --- none: fitted, and held out ---------------------------------------------------------------------------


@pytest.mark.slow  # a fit and its folds; test_evaluation holds the folds themselves
def test_without_a_psf_images_are_held_out(transit: Path, tmp_path: Path) -> None:
    result = run(
        transit,
        "--json",
        tmp_path / "r.json",
        "--plot",
        tmp_path / "r.png",
        "--dark-offsets",
        "--psf",
        "none",
    )
    assert result.exit_code == 0, result.output
    said = json.loads((tmp_path / "r.json").read_text())
    about = said["psf"]
    assert about["held_out"] is True and len(about["folds"]) == 4
    held_out = [file for fold in about["folds"] for file in fold["held_out"]]
    assert held_out == [f["file"] for f in said["frames"]]
    assert all(fold["fitted_images"] < IMAGES - 3 for fold in about["folds"])
    assert len({fold["parameters"]["total"] for fold in about["folds"]}) == 4
    assert about["parameters"]["total"] == pytest.approx(SCATTER.total, abs=0.03)
    assert "each image with a PSF fitted without it" in result.output
    offsets = said["dark_offsets"]
    assert [o["offset_dn"] for o in offsets["offsets"]] == [-5, -3, 3, 5]
    totals = [o["parameters"]["total"] for o in offsets["offsets"]]
    assert totals == sorted(totals) and totals[1] < about["parameters"]["total"] < totals[2]
    assert "dark offsets of -5, -3, +3, +5 DN" in result.output
    assert (tmp_path / "r.png").stat().st_size > 100_000


# --- what cannot be ---------------------------------------------------------------------------------------


def test_another_plate_scale_is_refused(transit: Path, tmp_path: Path) -> None:
    for scale, fits_it in ((1.02 * SCALE, False), (1.005 * SCALE, True), (None, True)):
        file = write_total(tmp_path / f"{scale}.fits", plate_scale_arcsec=scale)
        result = run(transit, "--psf", file)
        if fits_it:
            assert result.exit_code == 0, result.output
        else:
            refused(result, "0.50184 arcsec/px as PSF true has it", "got 0.492 arcsec/px")


def test_what_is_no_psf_is_refused(transit: Path, tmp_path: Path) -> None:
    refused(run(transit, "--psf", tmp_path / "missing.fits"), "expected a PSF file, or none", "missing.fits")
    write_psf(tmp_path / "double.fits", scale=2.0)
    refused(run(transit, "--psf", tmp_path / "double.fits"), "got 2")
    (tmp_path / "text.fits").write_text("no FITS")
    refused(run(transit, "--psf", tmp_path / "text.fits"))


def test_what_is_no_transit_is_refused(true_psf: Path, transit: Path, tmp_path: Path) -> None:
    refused(run(tmp_path, "--psf", true_psf), "transit.json")
    refused(run(tmp_path / "nowhere", "--psf", true_psf), "nowhere")
    torn = shutil.copytree(transit, tmp_path / "torn")
    (torn / "003.fits").unlink()
    refused(run(torn, "--psf", true_psf), "003.fits")


def test_a_fit_needs_to_know_the_diffraction(transit: Path, tmp_path: Path) -> None:
    unknown = changed(transit, tmp_path / "unknown", known_psf=None, instrument="my-telescope")
    refused(run(unknown), "known_psf", INSTRUMENT, "got my-telescope")
    refused(run(unknown, "--psf", write_total(tmp_path / "p.fits"), "--dark-offsets"), "known_psf")


def test_the_diffraction_of_an_instrument_is_built(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []

    def build(instrument: Any, **options: Any) -> Any:
        asked.append((instrument.name, options["component"]))
        return make_psf(DIFFRACTION)

    monkeypatch.setattr("psfcore.build.build_psf", build)
    np.testing.assert_array_equal(_built_diffraction(INSTRUMENT, (SIZE_PX, SIZE_PX)), DIFFRACTION)
    assert asked == [(INSTRUMENT, "DIFFRACTION")]


def test_too_few_images_are_refused(transit: Path, tmp_path: Path) -> None:
    images = json.loads((transit / "transit.json").read_text())["images"]
    few = changed(transit, tmp_path / "few", images=images[3:8])
    refused(run(few), "at least 6 images", "got 5")


def test_discs_that_are_not_there_are_refused(transit: Path, true_psf: Path, tmp_path: Path) -> None:
    even = shutil.copytree(transit, tmp_path / "even")
    for file in even.glob("0*.fits"):
        with fits.open(file, mode="update") as hdus:
            hdus[0].data[:] = np.random.default_rng(1).poisson(500, hdus[0].data.shape)
    refused(run(even, "--psf", true_psf), "expected an image with an occulter in it; got none")


def test_output_that_cannot_be_written_is_said_first(transit: Path, tmp_path: Path) -> None:
    refused(run(transit, "--json", tmp_path / "no/such/r.json"), "there is no folder")
    refused(run(transit, "--plot", tmp_path / "no/such/r.png"), "there is no folder")


# --- shapes -----------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_shapes_are_compared_where_asked(transit: Path, tmp_path: Path) -> None:
    result = run(transit, "--shapes", "--json", tmp_path / "r.json")
    assert result.exit_code == 0, result.output
    shapes = json.loads((tmp_path / "r.json").read_text())["shapes"]
    assert [shape["name"] for shape in shapes["shapes"]] == [
        "softened-power-law",
        "stretched-along-x",
        "stretched",
        "free-shells",
    ]
    assert shapes["images"] == IMAGES
    assert (
        "held-out errors of shapes" in result.output and "less those of softened-power-law" in result.output
    )


def test_shapes_need_fits_of_their_own(transit: Path, true_psf: Path) -> None:
    refused(run(transit, "--psf", true_psf, "--shapes"), "--shapes", "expected --psf none")
