"""Reports, diagnoses, blind cases and plans on the command line; reports and diagnoses over HTTP too."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from astropy.io import fits
from click.testing import CliRunner, Result
from fastapi.testclient import TestClient

from psfcore.errors import DataError
from psfcore.fits.images import write_plane
from psfcore.gap import planning
from psfcore.gap.diagnose import Diagnosis, diagnose
from psfcore.gap.library.registry import LIBRARY
from psfcore.psf import REACH_GRID_PX
from psfcore.simulate.plan import default_plan
from psfcore.simulate.scatter_truth import total_kernel
from psfcore.transit.archive import pack
from service.cli.main import main
from tests.gap_files import EDGE_GLOW, GLOW_DN_S, answer_at_once, quick_diagnosis, small_reach, write_gap
from tests.html_page import check_stands_alone, read_page
from tests.service.conftest import result_of, upload
from tests.transit_files import TRUTH, diffraction, write_simulated
from workers.tasks import gap as gap_task
from workers.tasks.workspace import Progress


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_simulated(tmp_path_factory.mktemp("simulated") / "transit")


@pytest.fixture
def psf(tmp_path: Path) -> Path:
    """The true PSF, small enough for the service of these tests."""
    path = tmp_path / "true.fits"
    kernel = total_kernel(TRUTH, diffraction(), REACH_GRID_PX)
    fits.PrimaryHDU(kernel[896:-896, 896:-896].astype("f4")).writeto(path)
    return path


def test_a_transit_becomes_a_page(
    api: TestClient, run_jobs: Callable[[], None], simulated: Path, psf: Path, tmp_path: Path
) -> None:
    pack(simulated, tmp_path / "transit.tar")
    transit_id = upload(api, tmp_path / "transit.tar", "/v1/transits")
    parameters = {"transit_id": transit_id, "psf_id": upload(api, psf, "/v1/psfs")}
    report = result_of(api, run_jobs, "report", **parameters)
    assert report["kind"] == "report" and report["transit_id"] == transit_id
    page = api.get(report["html"])
    assert page.headers["content-type"] == "text/html; charset=utf-8"
    policy = page.headers["content-security-policy"]
    assert policy.startswith("default-src 'none'; img-src data:; style-src 'unsafe-inline'")
    check_stands_alone(page.text)
    again = api.get(report["html"], headers={"If-None-Match": page.headers["etag"]})
    assert again.status_code == 304 and again.headers["content-security-policy"] == policy
    assert api.get(report["file"]).json()["schema"] == "psf-report/1"
    assert api.get(report["preview"]).content.startswith(b"\x89PNG")
    equal = api.post("/v1/jobs", json={"kind": "report", "parameters": parameters})
    assert equal.status_code == 200 and equal.json()["phase"] == "COMPLETED"


def test_the_command_writes_the_page_and_its_numbers(simulated: Path, psf: Path, tmp_path: Path) -> None:
    page, numbers, plot = tmp_path / "R.html", tmp_path / "R.json", tmp_path / "R.png"
    arguments = ["report", simulated, "-o", page, "--json", numbers, "--plot", plot, "--psf", psf, "--local"]
    arguments += ["--noise", "24", "8", "--no-dark-offsets"]
    done = CliRunner().invoke(main, [str(one) for one in arguments])
    assert done.exit_code == 0, done.output
    check_stands_alone(page.read_text("utf-8"))
    assert plot.read_bytes().startswith(b"\x89PNG")
    told = json.loads(numbers.read_text())
    assert told["sentence"] in done.output
    whole = told["evaluation"]["all"]
    assert f"all pointings: {whole['images']} images, mean {whole['mean_pct']:+.2f} %" in done.output
    assert "the PSF was given, and no fit was made" in done.output


def test_what_is_wrong_with_a_report_is_said_in_a_line_and_nothing_is_written(
    simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for arguments, said in (
        (["-o", "no/such/folder/R.html"], "there is no folder"),
        (["-o", "R.html", "--psf", "missing.fits"], "expected a PSF id"),
        (["-o", "R.html", "--noise", "-1", "2"], "greater than or equal to 0"),
        ([], "expected an output: -o PAGE.html, --json FILE or --plot FILE"),
        (["-o", "R.html", "--shapes", "--psf", 64 * "a"], "--shapes fits every shape to TRANSIT"),
    ):
        monkeypatch.chdir(tmp_path)
        done = CliRunner().invoke(main, ["report", str(simulated), "--local", *arguments])
        assert done.exit_code != 0 and said in done.output and "Traceback" not in done.output
        assert list(tmp_path.iterdir()) == []


# --- a gap ----------------------------------------------------------------------------------------------


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
    stages: Sequence[str]


@pytest.fixture(scope="module")
def diagnosed(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Diagnosed:
    """Nothing is patched but the library's length; the light that the file describes is in the images."""
    out, made, stages = tmp_path_factory.mktemp("diagnosed"), [], list[str]()
    (out / "mine.py").write_text(EDGE_GLOW)

    def kept(*given: Any, progress: Progress, **how: Any) -> Diagnosis:
        def told(stage: str, step: int, steps: int) -> None:
            stages.append(stage)
            progress(stage, step, steps)

        made.append(diagnose(*given, progress=told, **how))
        return made[0]

    with quick_diagnosis(), patch.object(gap_task, "diagnose", kept):
        done = run(
            folder, "--local", "--effects", out / "mine.py", "--json", out / "g.json", "-o", out / "g.html",
            "--plot", out / "g.png", "--corrected", out / "psf.fits",
        )  # fmt: skip
    assert done.exit_code == 0, done.output
    return Diagnosed(done, out, made[0], stages)


def test_the_stages_are_numbered_in_their_order(diagnosed: Diagnosed) -> None:
    numbers = [found[0] for stage in diagnosed.stages if (found := re.findall(r"\((\d) of 4\): ", stage))]
    assert len(numbers) == len(diagnosed.stages) and numbers == sorted(numbers)
    assert set(numbers) == {"1", "2", "3", "4"}


def test_an_effect_of_one_s_own_is_found_with_its_size(diagnosed: Diagnosed) -> None:
    done, out = diagnosed.done, diagnosed.out
    report = json.loads((out / "g.json").read_text())
    assert report["verdict"] == "attributed" and report["answer"] == ["edge_glow"]
    height = report["effects"][0]["parameters"]["height"]
    assert height["value"] == pytest.approx(GLOW_DN_S, abs=4 * height["sigma"])
    assert height["unit"] == "DN/s" and height["sigma"] < GLOW_DN_S / 5
    said = done.stdout.splitlines()  # a slow machine reports progress on stderr
    assert said[:4] == [*report["lines"], "verdict: attributed (edge_glow)"]
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
        {"added_effects": ["os"]},
        {"effects": "mine.py"},
        {"coverage": 0.99},
    )
    for one in wrong:
        request = {"kind": "gap-diagnose", "parameters": {"transit_id": transit_id, **one}}
        assert api.post("/v1/jobs", json=request).status_code == 422, one


def test_a_corrected_psf_that_there_is_not_is_said_after_all_else(
    folder: Path, diagnosed: Diagnosed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = replace(diagnosed.found.answer, verdict="none", named=(), causes=())
    asked = answer_at_once(monkeypatch, replace(diagnosed.found, answer=answer, corrected=None))
    psf, numbers = tmp_path / "psf.fits", tmp_path / "g.json"
    done = run(folder, "--local", "--corrected", psf, "--json", numbers, "--coverage", 0.8)
    assert [how["coverage"] for how in asked] == [0.8]
    assert done.exit_code == 1 and not psf.exists()
    assert done.output.splitlines()[3] == "verdict: none"
    assert "was not written: the diagnosis gave no corrected PSF (verdict none)" in done.output
    assert json.loads(numbers.read_text())["verdict"] == "none"


def test_the_next_step_is_a_command_that_works_here(
    folder: Path, diagnosed: Diagnosed, monkeypatch: pytest.MonkeyPatch
) -> None:
    tied = replace(diagnosed.found, corrected=None, answer=replace(diagnosed.found.answer, verdict="tie"))
    # A PSF corrected for the most probable of several effects is no next step.
    both = replace(tied, corrected=diagnosed.found.corrected)
    steps = (
        (diagnosed.found, f"gap {folder} --local --corrected "),
        (tied, "gap plan "),
        (both, "gap plan "),
    )
    for found, step in steps:
        answer_at_once(monkeypatch, found)
        said = run(folder, "--local").output.splitlines()
        assert said[-1].startswith(f"next: `heliopsf {step}")


def test_what_is_wrong_with_a_diagnosis_is_said_in_a_line_and_nothing_is_written(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for arguments, said in (
        (["--corrected", "no/such/folder/p.fits", "--local"], "there is no folder"),
        (["--psf", "0" * 64, "--local"], "asks no service"),
        (["--effects", "mine.py"], "--effects: expected --local with it"),
        (["--effects", "mine.py", "--local"], "effects of mine.py: expected a readable Python file"),
        (["--effects", "no_such_module_anywhere", "--local"], "No module named 'no_such_module_anywhere'"),
        (["--coverage", "0.99", "--local"], "not in the range 0.5<=x<=0.95"),
        (["--server", "http://127.0.0.1:9"], "127.0.0.1:9"),
    ):
        monkeypatch.chdir(tmp_path)
        done = run(folder, *arguments)
        assert done.exit_code != 0 and said in done.output and "Traceback" not in done.output
        assert list(tmp_path.iterdir()) == []


def test_a_folder_without_a_transit_is_told_and_the_transit_may_come_after_the_options(
    folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "empty").mkdir()
    done = run(tmp_path / "empty", "--local")
    assert done.exit_code == 1 and "transit.json" in done.output
    done = run("--seed", "-1", folder)
    assert done.exit_code == 2 and "not in the range" in done.output
    assert "blind" in run("--help").output


# --- blind cases ----------------------------------------------------------------------------------------


SMALL = ["--size", "128", "--images", "9", "--synthetic", "--processes", "1"]


def run_blind(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["gap", "blind", *[str(argument) for argument in arguments]])


def test_a_set_is_made_and_sealed_and_another_is_not_mixed_in(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    image = tmp_path / "sun.fits"
    rng = np.random.default_rng(2)
    header = fits.Header({"BUNIT": "DN", "XPOSURE": 2.0})
    fits.PrimaryHDU((400 + 80 * rng.random((300, 300))).astype("f4"), header).writeto(image)
    made = run_blind("--cases", 1, "--clean-only", "--make-only", "--scenes", image, "-o", folder, *SMALL)
    assert made.exit_code == 0, made.output
    assert "1 of 1 cases made and sealed" in made.output
    assert len((folder / "seals.jsonl").read_text().splitlines()) == 1
    assert len(list((folder / "cases" / "0000" / "transit").glob("0*.fits"))) == 9
    other = run_blind("--cases", 1, "--seed", 9, "--clean-only", "--make-only", "-o", folder, *SMALL)
    assert other.exit_code == 1
    assert "contains a set that was made" in other.output
    again = run_blind("--cases", 1, "--clean-only", "--make-only", "--scenes", image, "-o", folder, *SMALL)
    assert again.exit_code == 0 and "made case" not in again.output


def test_bad_input_is_said_in_a_line(tmp_path: Path) -> None:
    for arguments, said in (
        (["--only", "gremlins"], "expected one of anisotropic_scatter"),
        (["--clean-only", "--only", "ghost"], "expected one of --clean-only and --only"),
    ):
        answer = run_blind("-o", tmp_path / "set", "--make-only", "--processes", "1", *arguments)
        assert answer.exit_code != 0
        assert said in answer.output
        assert "Traceback" not in answer.output
        assert not (tmp_path / "set" / "cases").exists()


def test_where_no_case_can_be_made_that_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def cannot(case: object, *folders: object) -> None:
        raise DataError("bad-scene", "expected a scene with light for pointing 2; got none")

    monkeypatch.setattr("psfcore.blind.case_set.make", cannot)
    answer = run_blind("--cases", 2, "--clean-only", "-o", tmp_path / "set", *SMALL)
    assert answer.exit_code == 1 and "none of the 2 cases could be made" in answer.output
    assert "bad-scene: expected a scene" in answer.output and "Traceback" not in answer.output


@pytest.mark.slow
def test_six_cases_from_seal_to_score(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    arguments = ["--cases", 6, "--size", 160, "--images", 12, "--synthetic", "--processes", 2, "-o", folder]
    answer = run_blind(*arguments)
    assert answer.exit_code == 0, answer.output
    score = json.loads((folder / "score.json").read_text())
    assert score["schema"] == "gap-blind/3"
    assert (score["judged"], score["failures"]) == (6, {})
    assert {case["case"] for case in score["cases"]} == set(range(6))
    assert (folder / "score.txt").read_text().strip() in answer.output
    assert not list(folder.rglob("transit")), "transits go once there are reports"
    assert not list(folder.rglob("expected"))
    effects = [
        path for path in folder.rglob("truth/*.json") if json.loads(path.read_text())["truth"]["effects"]
    ]
    assert len(list(folder.rglob("bound.json"))) == len(effects) > 0
    assert "false alarms on clean data" in answer.output
    reports = {path: path.stat().st_mtime_ns for path in folder.rglob("report.json")}
    assert run_blind(*arguments).exit_code == 0
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("report.json")} == reports


# --- a planned transit ----------------------------------------------------------------------------------


FEW = tuple(effect for effect in LIBRARY if effect.name in ("dark_offset", "core_blur"))


def run_plan(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["gap", "plan", *[str(argument) for argument in arguments]])


@pytest.fixture
def plan_file(tmp_path: Path) -> Path:
    path = tmp_path / "plan.json"
    path.write_text(json.dumps(default_plan(12, 96, oversampling=1, brightness=6.0).as_json()))
    return path


def test_a_plan_gives_a_table_a_page_and_numbers(
    plan_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(planning.planned_limits.__kwdefaults__, "library", FEW)
    known = tmp_path / "known.fits"
    write_plane(known, diffraction(), cards={})
    page, numbers = tmp_path / "plan.html", tmp_path / "limits.json"
    done = run_plan(plan_file, "-o", page, "--json", numbers, "--diffraction", known)
    assert done.exit_code == 0, done.output
    content = json.loads(numbers.read_text())
    offset = content["limits"]["dark_offset"]
    assert f"offset {offset['found_90']:.3g} DN" in done.output
    assert set(content["limits"]) == {"dark_offset", "core_blur"}
    # In a small field the occulter is invisible where it is in front of the dark sky.
    assert "001.fits" in content["left_out"] and "image not usable: 001.fits" in done.output
    assert "What a planned transit would show" in page.read_text("utf-8")
    assert "Images that the fit could not use" in page.read_text("utf-8")
    again = run_plan(plan_file, "-o", page, "--diffraction", known)
    assert again.exit_code == 1 and "--overwrite" in again.output


def test_a_file_that_is_no_plan_is_refused_in_one_line(plan_file: Path) -> None:
    said = "expected a plan with at least 3 images"
    plan_file.write_text(json.dumps(default_plan(2, 96).as_json()))
    done = run_plan(plan_file)
    assert done.exit_code == 1
    assert said in done.output and len(done.output.strip().splitlines()) == 1
