"""Diagnosing a blind set: only the transit is visible, runs can be resumed, failures are kept apart."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from psfcore.blind.case_set import BlindSet
from psfcore.blind.judge import diagnosed_cases
from psfcore.blind.run_set import BOUND_SCHEMA, REPORT_SCHEMA, result_in, run_of, run_set
from psfcore.errors import DataError

TRUTH = {"kind": "clean", "effects": []}
# A diagnosis that logs its transit and reports the files that it can see.
DIAGNOSIS = """
import json, os, pathlib, sys
log, transit, report = sys.argv[1:4]
with open(log, "a") as lines:
    lines.write(pathlib.Path(transit, "transit.json").read_text() + "\\n")
seen = sorted(str(path.relative_to(os.getcwd())) for path in pathlib.Path(os.getcwd()).rglob("*"))
told = {"schema": "gap/3", "verdict": "none", "causes": [], "seen": seen, "at": os.getcwd()}
pathlib.Path(report).write_text(json.dumps(told))
"""


@pytest.fixture
def blind(tmp_path: Path) -> BlindSet:
    """Three sealed cases whose transit is one file."""
    made = BlindSet(tmp_path / "set")
    (made.folder / "truth").mkdir(parents=True)
    for number in range(3):
        made.transit(number).mkdir(parents=True)
        made.expected(number).mkdir()
        (made.transit(number) / "transit.json").write_text(f"case {number}")
        made.keep_seal(number, made.keep_truth(number, TRUTH))
    return made


BOUND = """
import json, pathlib, sys
log, expected, bound = map(pathlib.Path, sys.argv[1:4])
with open(log, "a") as lines:
    lines.write("bound\\n")
seen = sorted(path.name for path in expected.iterdir())
bound.write_text(json.dumps({"schema": "gap-bound/1", "causes": [], "seen": seen}))
"""


def command(log: Path, code: str = DIAGNOSIS) -> list[str]:
    return [sys.executable, "-c", code, str(log)]


def test_a_diagnosis_sees_only_a_copy_of_the_transit(blind: BlindSet, tmp_path: Path) -> None:
    (run,) = run_set(blind, [1], command(tmp_path / "log"), keep=True)
    assert not run.error and run.wall_s > 0 and run.peak_mib > 1
    report = result_in(blind.report(1), REPORT_SCHEMA)
    assert report is not None
    assert report["seen"] == ["transit", "transit/transit.json", "words.txt"]
    assert not Path(report["at"]).is_relative_to(blind.folder)
    assert not Path(report["at"]).exists()
    assert blind.transit(1).is_dir()
    assert run_of(blind, 1) == run


def test_only_cases_without_a_complete_report_are_diagnosed(blind: BlindSet, tmp_path: Path) -> None:
    log = tmp_path / "log"
    blind.report(2).write_text('{"schema": "gap/3", "verd')
    run_set(blind, [0, 1], command(log), processes=2)
    assert not blind.transit(0).exists(), "a transit is deleted after its diagnosis"
    run_set(blind, [0, 1, 2], command(log), processes=2)
    assert sorted(log.read_text().splitlines()) == ["case 0", "case 1", "case 2"]
    assert all(result_in(blind.report(number), REPORT_SCHEMA) for number in range(3))
    assert run_set(blind, [0, 1, 2], command(log)) == []


def test_failures_are_kept_apart_and_tried_again(blind: BlindSet, tmp_path: Path) -> None:
    log = tmp_path / "log"
    (broken,) = run_set(blind, [0], command(log, "import sys; sys.exit('no light')"))
    assert "no light" in broken.error and blind.transit(0).is_dir()
    (silent,) = run_set(blind, [1], command(log, "pass"))
    assert "gap/3" in silent.error
    (late,) = run_set(blind, [2], command(log, "import time; time.sleep(60)"), longest_s=0.5)
    assert "killed after" in late.error and late.wall_s < 20
    judged, failures = diagnosed_cases(blind, range(2))
    assert judged == [] and "no light" in failures[0]
    run_set(blind, [0], command(log))
    judged, failures = diagnosed_cases(blind, range(2))
    assert ([case.number for case in judged], list(failures)) == ([0], [1])


def test_the_program_of_the_bound_sees_the_images_without_noise_once(blind: BlindSet, tmp_path: Path) -> None:
    log = tmp_path / "log"
    (blind.expected(1) / "effect_0").mkdir()
    (run,) = run_set(blind, [1], command(log), bound=command(log, BOUND))
    assert not run.error
    assert (result_in(blind.bound(1), BOUND_SCHEMA) or {})["seen"] == ["effect_0"]
    assert not blind.expected(1).exists(), "the images are deleted after their use"
    assert run_set(blind, [1], command(log), bound=command(log, BOUND)) == []
    assert log.read_text().splitlines() == ["case 1", "bound"]
    assert diagnosed_cases(blind, [1])[0][0].bound == result_in(blind.bound(1), BOUND_SCHEMA)
    # If the program fails, it is tried again without a new diagnosis.
    log.write_text("")
    said: list[str] = []
    run_set(
        blind, [0], command(log), bound=command(log, "import sys; sys.exit('dark')"), progress=said.append
    )
    assert "no bound: exit status 1: dark" in said[-1]
    assert result_in(blind.bound(0), BOUND_SCHEMA) is None
    assert result_in(blind.report(0), REPORT_SCHEMA) and blind.expected(0).is_dir()
    run_set(blind, [0], command(log), bound=command(log, BOUND), keep=True)
    assert result_in(blind.bound(0), BOUND_SCHEMA) is not None
    assert blind.expected(0).is_dir(), "kept on request"
    assert log.read_text().splitlines() == ["case 0", "bound"]


def test_other_reports_and_changed_or_missing_truths_are_refused(blind: BlindSet, tmp_path: Path) -> None:
    log = tmp_path / "log"
    run_set(blind, [0], command(log))
    (other,) = run_set(blind, [1], command(log, DIAGNOSIS.replace("gap/3", "gap/9")))
    assert "gap/3" in other.error and "gap/9" in other.error
    with pytest.raises(DataError, match="not-sealed"):
        run_set(blind, [7], command(log))
    # A truth that was changed after its diagnosis is not scored.
    kept = json.loads(blind.truth_file(0).read_text())
    kept["truth"]["kind"] = "single"
    blind.truth_file(0).write_text(json.dumps(kept))
    with pytest.raises(DataError, match="broken-seal"):
        diagnosed_cases(blind, [0])
