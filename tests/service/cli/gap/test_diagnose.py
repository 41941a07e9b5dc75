"""A diagnosis over HTTP and on the command line: page with its policy, an effect of one's own, and what cannot be."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner, Result
from fastapi.testclient import TestClient

from psfcore.gap.diagnose import Diagnosis, diagnose
from psfcore.transit.archive import pack
from service.cli.main import main
from service.cli.transits import _lines
from tests.gap_files import EDGE_GLOW, GLOW_DN_S, answer_at_once, quick_diagnosis, small_reach, write_gap
from tests.html_page import check_stands_alone, read_page
from tests.service.conftest import upload
from workers.tasks import gap as gap_task


@pytest.fixture(scope="module", autouse=True)
def _small_reach() -> Iterator[None]:
    with small_reach():
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A transit with light at its right edge."""
    return write_gap(tmp_path_factory.mktemp("simulated") / "transit", light_dn_s=GLOW_DN_S)


def run(*arguments: object) -> Result:
    return CliRunner().invoke(main, ["gap", *(str(one) for one in arguments)])


@dataclass(frozen=True)
class Diagnosed:
    """A command, the folder of the files that it wrote, and the diagnosis that its job made."""

    done: Result
    out: Path
    found: Diagnosis


@pytest.fixture(scope="module")
def diagnosed(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Diagnosed:
    """Nothing is patched but the library's length; the light that the file describes is in the images."""
    out, made = tmp_path_factory.mktemp("diagnosed"), []
    (out / "mine.py").write_text(EDGE_GLOW)

    def kept(*given: Any, **how: Any) -> Diagnosis:
        made.append(diagnose(*given, **how))
        return made[0]

    with quick_diagnosis(), patch.object(gap_task, "diagnose", kept):
        done = run(
            folder, "--local", "--effects", out / "mine.py", "--json", out / "g.json", "-o", out / "g.html",
            "--plot", out / "g.png", "--corrected", out / "psf.fits",
        )  # fmt: skip
    assert done.exit_code == 0, done.output
    return Diagnosed(done, out, made[0])


def test_an_effect_of_one_s_own_is_found_with_its_size(diagnosed: Diagnosed) -> None:
    done, out = diagnosed.done, diagnosed.out
    report = json.loads((out / "g.json").read_text())
    assert report["verdict"] == "attributed" and report["answer"] == ["edge_glow"]
    height = report["effects"][0]["parameters"]["height"]
    assert height["value"] == pytest.approx(GLOW_DN_S, abs=4 * height["sigma"])
    assert height["unit"] == "DN/s" and height["sigma"] < GLOW_DN_S / 5
    said = done.stdout.splitlines()  # a slow machine reports progress on stderr
    assert said[:2] == [report["sentence"], "verdict: attributed (edge_glow)"]
    assert any(line.startswith("  not testable: ") and "saturation_fill" in line for line in said)
    files = ", ".join(str(out / name) for name in ("g.html", "g.json", "g.png", "psf.fits"))
    assert said[-1] == f"written: {files}", "the corrected PSF was asked for: nothing is left to do"
    html = (out / "g.html").read_text("utf-8")
    check_stands_alone(html)
    assert "A lamp beside the detector lights its right edge." in html
    # Its code's hash is among what made the report.
    (digest,) = report["provenance"]["added_effects"].values()
    assert digest in [tag.text for tag in read_page(html) if tag.name == "dd"]
    assert (out / "g.png").read_bytes().startswith(b"\x89PNG")
    header = fits.getheader(out / "psf.fits")
    assert header["PSFNAME"] == "hri_euv-gap-corrected"
    assert "edge_glow" in "".join(header["HISTORY"]).replace("\n", "")


def test_a_request_cannot_choose_whose_code_is_run(api: TestClient, folder: Path, tmp_path: Path) -> None:
    pack(folder, tmp_path / "transit.tar")
    transit_id = upload(api, tmp_path / "transit.tar", "/v1/transits")
    wrong: tuple[dict[str, Any], ...] = (
        {"added_effects": ["os"]}, {"effects": "mine.py"}, {"coverage": 0.99}, {"correct": "perhaps"},
    )  # fmt: skip
    for one in wrong:
        request = {"kind": "gap-diagnose", "parameters": {"transit_id": transit_id, **one}}
        assert api.post("/v1/jobs", json=request).status_code == 422, one


def test_a_psf_that_was_not_fitted_is_no_start(folder: Path, tmp_path: Path) -> None:
    kernel = np.zeros((33, 33), "f4")
    kernel[16, 16] = 1.0
    fits.PrimaryHDU(kernel).writeto(tmp_path / "point.fits")
    done = run(folder, "--local", "--psf", tmp_path / "point.fits")
    assert done.exit_code == 1 and "expected a PSF that was fitted to a transit" in done.output


def test_a_corrected_psf_that_there_is_not_is_said_after_all_else(
    folder: Path, diagnosed: Diagnosed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    judgement = replace(diagnosed.found.judgement, verdict="none", answer=())
    asked = answer_at_once(monkeypatch, replace(diagnosed.found, judgement=judgement, corrected=()))
    psf, numbers = tmp_path / "psf.fits", tmp_path / "g.json"
    done = run(folder, "--local", "--corrected", psf, "--json", numbers, "--coverage", 0.8)
    assert [how["coverage"] for how in asked] == [0.8]
    assert done.exit_code == 1 and not psf.exists()
    assert done.output.splitlines()[1] == "verdict: none"
    assert "was not written: the diagnosis found no effect for a corrected PSF (verdict none)" in done.output
    assert json.loads(numbers.read_text())["verdict"] == "none"


def test_the_next_step_is_a_command_that_works_here(
    folder: Path, diagnosed: Diagnosed, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer_at_once(monkeypatch, replace(diagnosed.found, corrected=()))
    said = run(folder, "--local").output.splitlines()
    assert said[-1].startswith(f"next: `heliopsf gap {folder} --local --corrected ")


def test_what_is_wrong_is_said_in_a_line_and_nothing_is_written(
    subtests: pytest.Subtests, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for arguments, said in (
        (["--json", "no/such/folder/g.json", "--local"], "there is no folder"),
        (["--corrected", "no/such/folder/p.fits", "--local"], "there is no folder"),
        (["--psf", "missing.fits", "--local"], "expected a PSF id (8 or more hexadecimal digits) or a file"),
        (["--psf", "0" * 64, "--local"], "expected the id of one of your PSFs"),
        (["--effects", "mine.py"], "--effects: expected --local with it"),
        (["--effects", "mine.py", "--local"], "effects of mine.py: expected a readable Python file"),
        (["--effects", "no_such_module_anywhere", "--local"], "No module named 'no_such_module_anywhere'"),
        (["--effects", "json", "--local"], "effects of json: expected EFFECTS to be a tuple of Effect"),
        (["--noise", "-1", "2", "--local"], "greater than or equal to 0"),
        (["--seed", "-1", "--local"], "not in the range"),
        (["--coverage", "0.99", "--local"], "not in the range 0.5<=x<=0.95"),
        (["--server", "http://127.0.0.1:9"], "127.0.0.1:9"),
    ):
        with subtests.test(str((arguments, said))):
            monkeypatch.chdir(tmp_path)
            done = run(folder, *arguments)
            assert done.exit_code != 0 and said in done.output and "Traceback" not in done.output
            assert list(tmp_path.iterdir()) == []


def test_effects_that_clash_with_the_library_s_are_told(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(EDGE_GLOW.replace("edge_glow", "ghost"))
    done = run(folder, "--local", "--effects", tmp_path / "mine.py")
    assert done.exit_code == 1
    assert "expected unique effect names; got 'ghost' twice" in done.output


def test_a_folder_without_a_transit_and_a_word_that_is_neither_are_told(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    done = run(tmp_path / "empty", "--local")
    assert done.exit_code == 1 and "transit.json" in done.output
    done = run(tmp_path / "nothing-here", "--local")
    assert done.exit_code == 2 and "does not exist" in done.output


def test_the_transit_may_come_after_the_options_and_help_names_both_commands(folder: Path) -> None:
    done = run("--seed", "-1", folder)
    assert done.exit_code == 2 and "not in the range" in done.output
    helped = run("--help").output
    assert "diagnose" in helped and "blind" in helped
    assert "--effects" in run("diagnose", "-h").output


def test_the_numbers_of_a_field_are_not_printed(diagnosed: Diagnosed) -> None:
    report = json.loads((diagnosed.out / "g.json").read_text())
    fit = report["effects"][0]
    bumps = {f"unknown.bump_{k}": fit["parameters"]["height"] for k in range(100)}
    both = fit | {
        "name": "edge_glow + unknown",
        "parameters": bumps | {"edge_glow.height": fit["parameters"]["height"]},
    }
    report |= {"together": [both, fit | {"name": "unknown", "parameters": bumps}]}
    report["set"]["members"] = [["edge_glow", "unknown"], ["unknown"]]
    said = [line for line in _lines(report) if "P = " in line]
    assert len(said) == 1 and "edge_glow.height" in said[0] and "bump" not in said[0]
