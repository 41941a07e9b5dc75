"""The blind set's table: hand-made truths and reports, figures computed by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from matplotlib.image import imread

from psfcore.blind.plot import score_png
from psfcore.blind.score_table import score, table, wilson
from psfcore.blind.scoring import Judged, shown_chi2, true_closure


def truth(kind: str, *names: str, left: float = 0.0, **more: Any) -> dict[str, Any]:
    effects = [{"name": name, "strength": 1.0} for name in names]
    return {
        "kind": kind,
        "effects": effects,
        "left_before_refit_pct": 2 * left,
        "left_after_refit_pct": left,
        **more,
    }


def report(
    verdict: str, *answer: str, axis: str = "time", **closures: tuple[float, float, float]
) -> dict[str, Any]:
    entries = [
        {"name": name, "closure": {"value": value, "ci90": [low, high]}}
        for name, (value, low, high) in closures.items()
    ]
    return {
        "schema": "gap/2",
        "verdict": verdict,
        "answer": list(answer),
        "effects": entries,
        "where": [{"axis": axis}],
    }


# Residuals of two images, noise 1 %: 3 and 4 with the effect, 0 and 1 of the sampling: closure 1 - 1 / 25.
MEASURED = {
    "refitted": {"residual_pct": {"0": 3.0, "1": 4.0}, "noise_pct": {"0": 1.0, "1": 1.0}},
    "clean_by_image_pct": {"0": 0.0, "1": 1.0},
}

CASES = [
    (truth("clean"), report("none")),
    (truth("clean"), report("none")),
    (truth("clean"), report("inconclusive")),
    (truth("clean"), report("attributed", "ghost")),
    (
        truth("single", "dark_offset", left=5.0, **MEASURED),
        report(
            "attributed", "dark_offset", axis="exposure", dark_offset=(0.9, 0.85, 0.97), ghost=(0.5, 0.4, 0.6)
        ),
    ),
    (
        truth("single", "ghost", left=3.0, **MEASURED),
        report(
            "attributed", "column_smear", axis="time", column_smear=(0.6, 0.5, 0.7), ghost=(0.8, 0.7, 0.9)
        ),
    ),
    (
        truth("single", "wide_halo", left=2.0, **MEASURED),
        report("tie", "dark_offset", "wide_halo", axis="pointing", wide_halo=(0.97, 0.9, 1.0)),
    ),
    (truth("single", "core_blur", left=1.5), report("inconclusive")),
    (truth("single", "persistence", left=0.6), report("none")),
    (truth("pair", "ghost", "dark_offset", left=9.0), report("attributed", "dark_offset", "ghost")),
    (truth("unknown", "stripes", left=4.0), report("unknown")),
    (truth("unknown", "glow", left=4.0), report("attributed", "intensity_gradient")),
    (truth("unknown", "glow", left=0.3), report("none")),
]


@pytest.fixture(scope="module")
def judged() -> list[Judged]:
    return [Judged(n, true, said, 10.0 + n) for n, (true, said) in enumerate(CASES)]


def test_wilson_agrees_with_the_textbook() -> None:
    assert wilson(0, 0) == (0.0, 1.0)
    low, high = wilson(8, 10)
    assert (low, high) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert wilson(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert wilson(10, 10)[1] == pytest.approx(1.0)


# Figure: cases, value, whether its goal is met.
EXPECTED = {
    "false alarms on clean data": (4, 2 / 4, False),
    "inconclusive on clean data": (4, 1 / 4, None),
    "answer contains the truth, >= 2 % left": (4, 3 / 4, False),
    "the same, >= 1 % left, inconclusive = 1/2": (5, 3.5 / 5, False),
    # Two means of chi2 3^2 + 3^2 = 18 are below 30: none of these cases counts.
    "the same, >= 2 % left, shown by the discs": (0, None, None),
    "first effect is the true one": (3, 2 / 3, False),
    "one wrong effect named with confidence": (13, 3 / 13, False),
    "mean number of named effects": (4, (1 + 1 + 2 + 2) / 4, True),
    "unknown effects called unknown or inconclusive": (2, 1 / 2, False),
    "closure by the first effect / by the true effect": (3, 1.0, True),  # of 1, 0.6 / 0.8, 1
    "90 % interval contains the true closure": (3, 2 / 3, False),
    "strongest axis is right": (3, 2 / 3, False),
    "time of the slowest case, s": (13, 22.0, True),
}


def test_what_the_discs_show_is_what_exceeds_their_noise() -> None:
    shown = MEASURED | {"refitted": {"residual_pct": {"0": 3.0, "1": 4.0}, "noise_pct": {"0": 0.5, "1": 1.0}}}
    assert shown_chi2(shown) == pytest.approx(36 + 9)
    assert shown_chi2({}) is None
    case = Judged(0, truth("single", "ghost", left=3.0, **shown), report("attributed", "ghost"), 1.0)
    row = score([case]).rows[4]
    assert (row.figure, row.cases, row.value) == ("the same, >= 2 % left, shown by the discs", 1, 1.0)


def test_of_a_pair_only_the_effects_that_show_must_be_named() -> None:
    pair = truth("pair", "ghost", "scene_evolution", left=4.0)
    said = report("attributed", "ghost")
    pair["effects"][0]["left_alone_pct"], pair["effects"][1]["left_alone_pct"] = 4.0, 0.1
    contains = score([Judged(0, pair, said, 1.0)]).rows[2]
    assert (contains.cases, contains.value) == (1, 1.0)
    pair["effects"][1]["left_alone_pct"] = 1.2
    assert score([Judged(0, pair, said, 1.0)]).rows[2].value == 0.0


def test_a_pair_is_shown_if_each_required_effect_alone_is() -> None:
    shown = MEASURED | {"refitted": {"residual_pct": {"0": 3.0, "1": 4.0}, "noise_pct": {"0": 0.5, "1": 0.5}}}
    pair = truth("pair", "ghost", "scene_evolution", left=4.0, **shown)
    strong, weak = pair["effects"]
    strong["left_alone_chi2"], weak["left_alone_chi2"] = 90.0, 29.0
    case = Judged(0, pair, report("attributed", "ghost"), 1.0)
    assert score([case]).rows[4].cases == 0
    weak["left_alone_chi2"] = 31.0
    assert score([case]).rows[4].cases == 1
    weak |= {"left_alone_chi2": 29.0, "left_alone_pct": 0.5}  # too weak: it need not be named
    assert score([case]).rows[4].cases == 1


def test_every_figure_equals_the_one_computed_by_hand(judged: list[Judged]) -> None:
    rows = {row.figure: row for row in score(judged).rows}
    assert set(rows) == set(EXPECTED)
    for figure, (cases, value, met) in EXPECTED.items():
        assert (rows[figure].cases, rows[figure].met) == (cases, met), figure
        assert rows[figure].value == (value if value is None else pytest.approx(value)), figure
    interval = rows["one wrong effect named with confidence"].interval95
    assert interval == pytest.approx(wilson(3, 13))


def test_the_true_closure_excludes_what_the_sampling_leaves() -> None:
    assert true_closure(MEASURED) == pytest.approx(1 - 1 / 25)
    assert true_closure(truth("clean")) is None


def test_confusion_and_power_count_every_case_once(judged: list[Judged]) -> None:
    found = score(judged)
    assert found.confusion["clean"] == {"none": 2, "inconclusive": 1, "ghost": 1}
    assert found.confusion["wide_halo"] == {"wide_halo": 1}
    assert found.confusion["pair"] == {"dark_offset": 1}
    assert sum(sum(row.values()) for row in found.confusion.values()) == len(judged)
    assert sum(bin_of["n"] for bin_of in found.power) == 9
    two_to_four = next(b for b in found.power if b["left_after_refit_pct"] == [2.0, 4.0])
    assert (two_to_four["n"], two_to_four["noticed"], two_to_four["contains_truth"]) == (2, 2, 1)
    top = found.power[-1]
    assert (top["left_after_refit_pct"], top["n"], top["contains_truth"]) == ([8.0, None], 1, 1)


def test_the_table_lists_failures_and_bounds_the_rate_of_false_alarms(judged: list[Judged]) -> None:
    clean = [case for case in judged if case.kind == "clean" and case.verdict == "none"] * 5
    text = table(score(clean, {7: "exit status 1: no light"}))
    assert "no false alarm in 10 clean cases: the rate is below 0.300" in text
    assert "0007: exit status 1: no light" in text
    assert score([]).rows[0].value is None


def test_the_picture_is_drawn_with_and_without_cases(judged: list[Judged], tmp_path: Path) -> None:
    for name, cases in (("full", judged), ("empty", [])):
        score_png(score(cases), tmp_path / f"{name}.png")
        pixels = imread(tmp_path / f"{name}.png")
        assert pixels.shape[0] > 400
        assert pixels[..., :3].std() > 0.02
