"""Cases from a simulator of the user: sealed like others, the example of the documentation works, errors name their line."""

from __future__ import annotations

import json
import re
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest

from psfcore.blind.case_set import SetPlan, make_set
from psfcore.blind.score_table import score
from psfcore.blind.scoring import Judged
from psfcore.blind.simulator import checked_truth, simulator_of, source_sha256
from psfcore.errors import DataError
from psfcore.fits.header import FitsLimits
from psfcore.gap.ideal_observer import main
from psfcore.transit.folder import read_transit

SIZE_PX, IMAGES = 128, 9
# A simulator that writes a transit of the tests.
SMALL = """
    from tests.transit_files import write_transit

    def make_case(*, seed, number, size_px, images, transit, expected):
        write_transit(transit, images=images)
        return {"effects": [{"name": "ghost"}], "asked": [seed, number, size_px, images]}
"""


def written(folder: Path, text: str = SMALL, name: str = "mine.py") -> str:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text(dedent(text))
    return str(path)


def plan_of(source: str, cases: int = 1) -> SetPlan:
    return SetPlan(cases, 3, SIZE_PX, IMAGES, simulator=source)


def example() -> str:
    """The example of the documentation."""
    page = (Path(__file__).parents[3] / "docs" / "gap.md").read_text("utf-8")
    (code,) = (one for one in re.findall(r"```python\n(.*?)```", page, re.S) if "def make_case" in one)
    return str(code)


def test_the_example_of_the_documentation_makes_cases_that_an_ideal_observer_understands(
    tmp_path: Path,
) -> None:
    made, failed = make_set(tmp_path / "set", plan_of(written(tmp_path, example()), cases=2))
    assert failed == {}
    clean, leak = made.truth(0), made.truth(1)
    assert (clean["kind"], clean["left_after_refit_pct"], leak["kind"]) == ("clean", 0.0, "single")
    assert not made.expected(0).exists()
    limits = FitsLimits(max_pixels=(2 * SIZE_PX + 1) ** 2)  # the known PSF is larger than the images
    for number in (0, 1):
        assert len(read_transit(made.transit(number), limits).frames) == IMAGES
    assert main([str(made.expected(1)), str(made.ideal(1))]) == 0
    found = json.loads(made.ideal(1).read_text())
    left = {tuple(one["effects"]): one["chi2"] for one in found["hypotheses"]}
    assert left[()] > 30
    assert left[("intensity_gradient",)] < 0.05 * left[()]
    case = Judged(1, leak, {"verdict": "none"}, 1.0, found)
    assert case.left_pct == found["left_after_refit_pct"] > 1
    assert case.known is not None and case.known.alone > 0.5


def test_a_simulated_case_is_sealed_and_told_what_was_asked(tmp_path: Path) -> None:
    made, failed = make_set(tmp_path / "set", plan_of(written(tmp_path)))
    assert failed == {}
    truth = made.truth(0)
    assert truth["asked"] == [3, 0, SIZE_PX, IMAGES]
    assert (truth["kind"], truth["number"], truth["seed"]) == ("single", 0, 3)
    again, _ = make_set(tmp_path / "set", plan_of(written(tmp_path)))
    assert again.truth(0) == truth
    kept = json.loads(made.truth_file(0).read_text())
    kept["truth"]["effects"] = []
    made.truth_file(0).write_text(json.dumps(kept))
    with pytest.raises(DataError, match="broken-seal"):
        made.truth(0)


def test_processes_share_the_cases_of_a_simulator(tmp_path: Path) -> None:
    made, failed = make_set(tmp_path / "set", plan_of(written(tmp_path), cases=3), processes=2)
    assert failed == {}
    assert [made.truth(number)["asked"][1] for number in range(3)] == [0, 1, 2]


def test_a_changed_simulator_does_not_continue_a_set(tmp_path: Path) -> None:
    source = written(tmp_path)
    make_set(tmp_path / "set", plan_of(source))
    written(tmp_path, SMALL + "    # changed\n")
    with pytest.raises(DataError, match="other-set"):
        make_set(tmp_path / "set", plan_of(source, cases=2))


def test_a_module_also_works(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path, name="my_simulator_module.py")
    monkeypatch.syspath_prepend(tmp_path)
    assert simulator_of("my_simulator_module").__name__ == "make_case"
    assert source_sha256("my_simulator_module") == source_sha256(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "expected a function make_case; got NoneType"),
        ("make_case = 3", "expected a function make_case; got int"),
        ("import nothing_of_this_name", "ModuleNotFoundError"),
    ],
)
def test_a_bad_simulator_is_refused_before_the_first_case(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(DataError, match="bad-simulator") as refused:
        make_set(tmp_path / "set", plan_of(written(tmp_path, text)))
    assert said in refused.value.message
    with pytest.raises(DataError, match="expected a readable Python file"):
        make_set(tmp_path / "set", plan_of(str(tmp_path / "missing.py")))


HEAD = "def make_case(*, seed, number, size_px, images, transit, expected):"


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ("return 1 / number", "ZeroDivisionError: division by zero (line 4)"),
        ("return {'effects': []}", "no-manifest"),
        (
            "write_transit(transit); (transit / 'truth.json').touch(); return {'effects': []}",
            "got also truth.json",
        ),
        ("write_transit(transit, known_psf='other.fits')", "missing: other.fits"),
        ("write_transit(transit); expected.mkdir(); return {'effects': []}", "expected the folders"),
    ],
)
def test_a_case_that_fails_says_why(body: str, said: str, tmp_path: Path) -> None:
    text = f"from tests.transit_files import write_transit\n\n{HEAD}\n    {body}\n"
    made, failed = make_set(tmp_path / "set", plan_of(written(tmp_path, text)))
    assert said in failed[0]
    assert made.seals() == {}


@pytest.mark.parametrize(
    ("truth", "said"),
    [
        (None, 'a truth as JSON with "effects"'),
        ({"effects": ["ghost"]}, 'a truth as JSON with "effects"'),
        ({"effects": [], "rate": float("nan")}, "a truth as JSON"),
        ({"effects": [{"name": "ghost"}] * 2}, "different names"),
        ({"effects": [{"name": "pair"}]}, "expected names of effects"),
        ({"effects": [{"name": name} for name in ("ghost", "core_blur", "mine")]}, "at most 2 effects"),
        ({"effects": [{"name": "ghost", "left_alone_pct": -1}]}, "residuals in percent"),
        ({"effects": [], "left_after_refit_pct": "much"}, "residuals in percent"),
    ],
)
def test_a_truth_of_another_form_is_refused(truth: Any, said: str) -> None:
    with pytest.raises(DataError, match=said):
        checked_truth("mine.py", truth)


def test_the_kind_follows_from_the_names() -> None:
    def kind(*names: str) -> str:
        return str(checked_truth("mine.py", {"effects": [{"name": name} for name in names]})["kind"])

    assert [kind(), kind("ghost"), kind("ghost", "core_blur")] == ["clean", "single", "pair"]
    assert kind("my_glow") == kind("ghost", "my_glow") == "unknown"


def test_effects_with_other_names_have_a_row_in_the_confusion_matrix() -> None:
    truth = checked_truth("mine.py", {"effects": [{"name": "my_glow"}], "left_after_refit_pct": 4.0})
    found = score([Judged(0, truth, {"verdict": "unknown"}, 1.0)])
    assert found.confusion == {"my_glow": {"unknown": 1}}
    rows = {row.figure: row for row in found.rows}
    assert rows["unknown effects called unknown or inconclusive"].value == 1.0
