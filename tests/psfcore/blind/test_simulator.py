"""Cases from a simulator of the user: sealed like others, the example of the documentation works, errors name their line."""

from __future__ import annotations

import re
from pathlib import Path
from textwrap import dedent
from typing import Any

import pytest

from psfcore.blind.case_set import make_set
from psfcore.blind.cases import SetPlan
from psfcore.blind.judged import Judged
from psfcore.blind.score import score
from psfcore.blind.simulator import checked_truth, simulator_of, source_sha256
from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.transit.folder import read_transit

SIZE_PX, IMAGES = 96, 9
# A simulator that writes a transit of the tests.
SMALL = """
    from tests.transit_files import write_transit

    def make_case(*, seed, number, size_px, images, transit, expected):
        write_transit(transit, images=images)
        return {"effects": [{"name": "ghost"}], "asked": [seed, number, size_px, images]}
"""


def source_in(folder: Path, text: str = SMALL, name: str = "mine.py") -> str:
    path = folder / name
    path.write_text(dedent(text))
    return str(path)


def plan_of(source: str, cases: int = 1) -> SetPlan:
    return SetPlan(cases, 3, SIZE_PX, IMAGES, simulator=source)


def test_the_example_of_the_documentation_makes_cases(tmp_path: Path) -> None:
    page = (Path(__file__).parents[3] / "docs" / "gap.md").read_text("utf-8")
    (example,) = (one for one in re.findall(r"```python\n(.*?)```", page, re.S) if "def make_case" in one)
    made, failed = make_set(tmp_path / "set", plan_of(source_in(tmp_path, example), cases=2))
    assert failed == {}
    clean, leak = made.truth(0), made.truth(1)
    assert (clean["kind"], clean["left_after_refit_pct"], leak["kind"]) == ("clean", 0.0, "single")
    assert not made.expected(0).exists() and made.expected(1).is_dir()
    limits = FitsLimits(max_pixels=(2 * SIZE_PX + 1) ** 2)  # the known PSF is larger than the images
    for number in (0, 1):
        assert len(read_transit(made.transit(number), limits).frames) == IMAGES


def test_a_simulated_case_is_sealed_and_told_what_was_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = source_in(tmp_path)
    module = source_in(tmp_path, name="my_simulator_module.py")  # a module also works
    monkeypatch.syspath_prepend(tmp_path)
    assert simulator_of("my_simulator_module").__name__ == "make_case"
    assert source_sha256("my_simulator_module") == source_sha256(module)
    made, failed = make_set(tmp_path / "set", plan_of(source))
    assert failed == {}
    truth = made.truth(0)
    assert truth["asked"] == [3, 0, SIZE_PX, IMAGES]
    assert (truth["kind"], truth["number"], truth["seed"]) == ("single", 0, 3)
    # Processes share the cases that are missing.
    assert make_set(tmp_path / "set", plan_of(source, cases=3), processes=2)[1] == {}
    assert [made.truth(number)["asked"][1] for number in range(3)] == [0, 1, 2]
    assert made.truth(0) == truth
    # A changed simulator does not continue a set.
    source_in(tmp_path, SMALL + "    # changed\n")
    with pytest.raises(DataError, match="other-set"):
        make_set(tmp_path / "set", plan_of(source, cases=4))


def test_a_bad_simulator_is_refused_before_the_first_case(tmp_path: Path) -> None:
    sources = {
        "expected a function make_case; got NoneType": source_in(tmp_path, ""),
        "expected a function make_case; got int": source_in(tmp_path, "make_case = 3", "other.py"),
        "ModuleNotFoundError": source_in(tmp_path, "import nothing_of_this_name", "third.py"),
        "expected a readable Python file": str(tmp_path / "missing.py"),
    }
    for n, (said, source) in enumerate(sources.items()):
        with pytest.raises(DataError) as refusal:
            make_set(tmp_path / f"set {n}", plan_of(source))
        assert refusal.value.code == "bad-simulator" and said in refusal.value.message, source


def test_a_case_that_fails_says_why(tmp_path: Path) -> None:
    bodies = {
        "return 1 / number": "ZeroDivisionError: division by zero (line 4)",
        "return {'effects': []}": "no-manifest",
        "write_transit(transit); (transit / 'truth.json').touch(); return {'effects': []}": "got also truth.json",
        "write_transit(transit, known_psf='other.fits')": "missing: other.fits",
        "write_transit(transit); expected.mkdir(); return {'effects': []}": "expected the folders",
    }
    head = "def make_case(*, seed, number, size_px, images, transit, expected):"
    for n, (body, said) in enumerate(bodies.items()):
        text = f"from tests.transit_files import write_transit\n\n{head}\n    {body}\n"
        made, failed = make_set(tmp_path / f"set {n}", plan_of(source_in(tmp_path, text)))
        assert said in failed[0], body
        assert made.seals() == {}


def test_a_truth_has_its_form_and_a_kind_by_its_names() -> None:
    ghost = {"name": "ghost"}
    truths: list[tuple[Any, str]] = [
        (None, 'a truth as JSON with "effects"'),
        ({"effects": [], "rate": float("nan")}, "a truth as JSON"),
        ({"effects": [ghost] * 2}, "different names"),
        ({"effects": [{"name": "pair"}]}, "expected names of effects"),
        ({"effects": [ghost, {"name": "core_blur"}, {"name": "mine"}]}, "at most 2 effects"),
        ({"effects": [ghost | {"left_alone_chi2": "many"}]}, "residuals in percent"),
        ({"effects": [], "left_after_refit_pct": "much"}, "residuals in percent"),
    ]
    for truth, said in truths:
        with pytest.raises(DataError, match=said):
            checked_truth("mine.py", truth)
    kinds = {(): "clean", ("ghost",): "single", ("ghost", "core_blur"): "pair", ("my_glow",): "unknown"}
    kinds |= {("ghost", "my_glow"): "mixed", ("my_glow", "my_haze"): "unknown"}
    for names, kind in kinds.items():
        assert checked_truth("mine.py", {"effects": [{"name": name} for name in names]})["kind"] == kind
    # Effects with other names have a row in the confusion matrix.
    truth = checked_truth("mine.py", {"effects": [{"name": "my_glow"}], "left_after_refit_pct": 4.0})
    found = score([Judged(0, truth, {"verdict": "unknown", "set": {"members": [["unknown"]]}}, 1.0)])
    assert found["confusion"] == {"my_glow": {"unknown": 1}}
    rows = {row["figure"]: row for row in found["rows"]}
    assert rows["unknown effects called unknown or inconclusive"]["value"] == 1.0
