"""``heliopsf gap blind``: a set made, sealed, diagnosed and scored by one command."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner, Result

from psfcore.errors import DataError
from service.cli.main import main

SMALL = ["--size", "128", "--images", "9", "--synthetic", "--processes", "1"]


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["gap", "blind", *[str(argument) for argument in arguments]])


def test_a_set_is_made_and_sealed_and_another_is_not_mixed_in(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    image = tmp_path / "sun.fits"
    rng = np.random.default_rng(2)
    header = fits.Header({"BUNIT": "DN", "XPOSURE": 2.0})
    fits.PrimaryHDU((400 + 80 * rng.random((300, 300))).astype("f4"), header).writeto(image)
    made = run("--cases", 1, "--clean-only", "--make-only", "--scenes", image, "-o", folder, *SMALL)
    assert made.exit_code == 0, made.output
    assert "1 of 1 cases made and sealed" in made.output
    assert len((folder / "seals.jsonl").read_text().splitlines()) == 1
    assert len(list((folder / "cases" / "0000" / "transit").glob("0*.fits"))) == 9
    other = run("--cases", 1, "--seed", 9, "--clean-only", "--make-only", "-o", folder, *SMALL)
    assert other.exit_code == 1
    assert "contains a set that was made" in other.output
    drawn = run("--cases", 1, "--clean-only", "--make-only", "-o", folder, *SMALL)
    assert drawn.exit_code == 1, "scenes of that image are not mixed with drawn ones"
    assert "other-set" not in drawn.output and "contains a set that was made" in drawn.output
    again = run("--cases", 1, "--clean-only", "--make-only", "--scenes", image, "-o", folder, *SMALL)
    assert again.exit_code == 0 and "made case" not in again.output


def test_bad_input_is_said_in_a_line(subtests: pytest.Subtests, tmp_path: Path) -> None:
    for arguments, said in (
        (["--only", "gremlins"], "expected one of anisotropic_scatter"),
        (["--size", "32"], "--size"),
        (["--cases", "0"], "--cases"),
        (["--simulator", "missing.py"], "expected a readable Python file"),
        (["--simulator", "mine.py", "--only", "ghost"], "expected --simulator without --only"),
        (["--clean-only", "--only", "ghost"], "expected one of --clean-only and --only"),
    ):
        with subtests.test(str((arguments, said))):
            answer = run("-o", tmp_path / "set", "--make-only", "--processes", "1", *arguments)
            assert answer.exit_code != 0
            assert said in answer.output
            assert "Traceback" not in answer.output
            assert not (tmp_path / "set" / "cases").exists()


def test_where_no_case_can_be_made_that_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def cannot(case: object, *folders: object) -> None:
        raise DataError("bad-scene", "expected a scene with light for pointing 2; got none")

    monkeypatch.setattr("psfcore.blind.case_set.make", cannot)
    answer = run("--cases", 2, "--clean-only", "-o", tmp_path / "set", *SMALL)
    assert answer.exit_code == 1
    assert "could not make case 0001" in answer.output
    assert (
        "none of the 2 cases could be made; the first failed with: bad-scene: expected a scene"
        in answer.output
    )
    assert "Traceback" not in answer.output


def test_the_cases_of_a_simulator_are_made_and_sealed(tmp_path: Path) -> None:
    source = tmp_path / "mine.py"
    source.write_text(
        "from tests.transit_files import write_transit\n\n"
        "def make_case(*, seed, number, size_px, images, transit, expected):\n"
        "    write_transit(transit, images=images)\n"
        "    return {'effects': [{'name': 'ghost', 'strength': seed + size_px}]}\n"
    )
    size = ["--size", "128", "--images", "9", "--seed", "7"]
    made = run("--simulator", source, "--cases", 1, "--make-only", "-o", tmp_path / "set", *size)
    assert made.exit_code == 0, made.output
    assert "1 of 1 cases made and sealed" in made.output
    kept = json.loads((tmp_path / "set" / "truth" / "0000.json").read_text())
    assert kept["truth"]["effects"] == [{"name": "ghost", "strength": 135}]


@pytest.mark.slow
def test_six_cases_from_seal_to_score(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    arguments = ["--cases", 6, "--size", 160, "--images", 12, "--synthetic", "--processes", 2, "-o", folder]
    answer = run(*arguments)
    assert answer.exit_code == 0, answer.output
    score = json.loads((folder / "score.json").read_text())
    assert score["schema"] == "gap-blind/1"
    assert (score["judged"], score["failures"]) == (6, {})
    assert {case["case"] for case in score["cases"]} == set(range(6))
    assert (folder / "score.png").is_file()  # tests of psfcore.blind draw it
    assert not list(folder.rglob("transit")), "transits go once there are reports"
    assert not list(folder.rglob("expected"))
    effects = [
        path for path in folder.rglob("truth/*.json") if json.loads(path.read_text())["truth"]["effects"]
    ]
    assert len(list(folder.rglob("ideal.json"))) == len(effects) > 0
    assert "false alarms on clean data" in answer.output
    reports = {path: path.stat().st_mtime_ns for path in folder.rglob("report.json")}
    assert run(*arguments).exit_code == 0
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("report.json")} == reports
