"""Every command that writes files: it refuses to replace an input, and replaces other files only if told."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest
from astropy.io import fits
from click.testing import CliRunner, Result

from service.cli import local, options
from service.cli.main import main
from tests.conftest import write_image, write_psf
from tests.service.cli.test_main import ALL
from tests.transit_files import write_transit

# These commands go on in the folder of an earlier run, which they recognise by its files.
RESUMES = {("demo",), ("gap", "blind")}


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    """No command may start to work."""

    def begun(**_given: Any) -> Any:
        raise AssertionError("the work began")

    monkeypatch.setattr(local, "local", begun)


@pytest.fixture
def files(tmp_path: Path) -> Path:
    write_image(tmp_path / "image.fits")
    write_psf(tmp_path / "psf.fits")
    write_transit(tmp_path / "transit")
    return tmp_path


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


DECONVOLVE = ("deconvolve", "image.fits", "--psf", "psf.fits", "--local")
REPLACING = [
    (*DECONVOLVE, "-o", "image.fits"),
    (*DECONVOLVE, "-o", "psf.fits"),
    (*DECONVOLVE, "-o", "new.fits", "--plot", "image.fits"),
    (*DECONVOLVE, "-o", "new.fits", "--changes", "image.fits"),
    ("psf", "fit", "transit", "--local", "-o", "transit/transit.json"),
    ("psf", "crossval", "transit", "--json", "transit/transit.json"),
    ("report", "transit", "--local", "--json", "transit/transit.json"),
    ("gap", "diagnose", "transit", "--local", "-o", "transit/transit.json"),
    ("psf", "show", "psf.fits", "--plot", "psf.fits"),
    ("psf", "query", "psf.fits", "--json", "psf.fits"),
    ("psf", "cutout", "psf.fits", "--size", "9", "-o", "psf.fits"),
    ("psf", "rebin", "psf.fits", "--factor", "2", "-o", "psf.fits"),
    ("psf", "best", "--image", "image.fits", "--json", "image.fits"),
    ("arms", "image.fits", "--plot", "image.fits"),
    ("flare", "image.fits", "--background", "image.fits", "--psf", "psf.fits", "--json", "psf.fits"),
    ("changes", "changes/changes.json", "--psf", "psf.fits", "-o", "changes", "--local"),
]  # fmt: skip


@pytest.mark.usefixtures("idle")
def test_an_input_is_never_replaced(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(files)
    (files / "changes").mkdir()
    shutil.copy(files / "image.fits", files / "changes" / "changes.json")
    before = contents(files)
    for command in REPLACING:
        refused = run(*command, "--overwrite")
        assert refused.exit_code == 1, refused.output
        assert "is the same file as the input" in refused.output, refused.output
        assert contents(files) == before


WRITES = [
    ("psf", "query", "psf.fits", "--json"),
    ("psf", "cutout", "psf.fits", "--size", "9", "-o"),
    ("psf", "rebin", "psf.fits", "--factor", "2", "-o"),
    ("psf", "show", "psf.fits", "--plot"),
    (*DECONVOLVE, "--steps", "1", "-o"),
]


def test_an_existing_output_is_replaced_only_if_told(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for command in WRITES:
        monkeypatch.chdir(files)
        Path("old").write_text("old")
        refused = run(*command, "old")
        assert refused.exit_code == 1 and "old: the file exists" in refused.output, refused.output
        assert Path("old").read_text() == "old"
        replaced = run(*command, "old", "--overwrite")
        assert replaced.exit_code == 0, replaced.output
        assert not Path("old").read_bytes().startswith(b"old")
        assert not [path for path in files.iterdir() if path.name.endswith(".part")]


def outputs(command: click.Command) -> Iterator[str]:
    for parameter in command.params:
        if isinstance(parameter.type, options.OutputFile):
            yield str(parameter.name)
        elif isinstance(parameter.type, options.OutputFolder) and parameter.name == "output":
            yield "output"


def test_every_command_that_writes_files_has_the_option() -> None:
    writing = {path: list(outputs(command)) for path, command in ALL}
    writing = {path: names for path, names in writing.items() if names and path not in RESUMES}
    assert len(writing) > 15
    for path, command in ALL:
        has = any(parameter.name == "overwrite" for parameter in command.params)
        assert has == (path in writing), path


def test_a_simulation_is_not_written_over_its_scene(tmp_path: Path) -> None:
    write_image(tmp_path / "000.fits", shape=(128, 128))
    before = fits.getdata(tmp_path / "000.fits")
    refused = run(
        "simulate", "transit", "-o", tmp_path, "--scene", tmp_path / "000.fits", "--size", "64", "--overwrite"
    )
    assert refused.exit_code == 1 and "it holds the input" in refused.output, refused.output
    assert (fits.getdata(tmp_path / "000.fits") == before).all()


def test_a_blind_set_takes_no_folder_with_other_files(tmp_path: Path) -> None:
    case = tmp_path / "cases" / "0001"
    case.mkdir(parents=True)
    (case / "thesis.txt").write_text("mine")
    refused = run("gap", "blind", "--cases", "1", "--make-only", "--synthetic", "-o", tmp_path)
    assert refused.exit_code == 1 and "contains other files" in refused.output, refused.output
    assert (case / "thesis.txt").read_text() == "mine"
