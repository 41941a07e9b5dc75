"""``heliopsf gap plan``: limits of a plan in text, JSON and a page, and files that are no plan."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from psfcore.fits.images import write_plane
from psfcore.gap import planning
from psfcore.gap.library.registry import LIBRARY
from psfcore.simulate.plan import default_plan
from service.cli.main import main
from tests.transit_files import diffraction

FEW = tuple(effect for effect in LIBRARY if effect.name in ("dark_offset", "core_blur"))


def run(*arguments: str | Path) -> Result:
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
    done = run(plan_file, "-o", page, "--json", numbers, "--diffraction", known)
    assert done.exit_code == 0, done.output
    content = json.loads(numbers.read_text())
    offset = content["limits"]["dark_offset"]
    assert f"offset {offset['found_90']:.3g} DN" in done.output
    assert set(content["limits"]) == {"dark_offset", "core_blur"}
    # In a small field the occulter is invisible where it is in front of the dark sky.
    assert "001.fits" in content["left_out"] and "image not usable: 001.fits" in done.output
    assert "What a planned transit would show" in page.read_text("utf-8")
    assert "Images that the fit could not use" in page.read_text("utf-8")
    again = run(plan_file, "-o", page, "--diffraction", known)
    assert again.exit_code == 1 and "--overwrite" in again.output


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("{", "expected a plan or a transit.json, as JSON"),
        (json.dumps({"schema": "transit/1", "images": []}), "images"),
        (json.dumps(default_plan(2, 96).as_json()), "expected a plan with at least 3 images"),
    ],
)
def test_a_file_that_is_no_plan_is_refused_in_one_line(plan_file: Path, content: str, said: str) -> None:
    plan_file.write_text(content)
    done = run(plan_file)
    assert done.exit_code == 1
    assert said in done.output and len(done.output.strip().splitlines()) == 1


def test_a_plan_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    done = run(tmp_path / "none.json")
    assert done.exit_code == 2 and "does not exist" in done.output
