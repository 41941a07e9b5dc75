"""The tables of the blind set: hand-made truths, reports, sets and ideal observers; figures computed by hand."""

from __future__ import annotations

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from psfcore.blind.bounds import LEVEL
from psfcore.blind.judged import Judged, required_causes, true_closure
from psfcore.blind.score import score, score_png, set_figures, share, table, wilson


def truth(kind: str, *names: str, left: float = 0.0, **more: Any) -> dict[str, Any]:
    effects = [{"name": name, "strength": 1.0} for name in names]
    measured = {"left_before_refit_pct": 2 * left, "left_after_refit_pct": left}
    return {"kind": kind, "effects": effects, **measured, **more}


def report(
    verdict: str, *answer: str, axis: str = "time", **closures: tuple[float, float, float]
) -> dict[str, Any]:
    """A report. closures: value and interval of the closure by an effect."""
    entries = [
        {"name": name, "closure": {"value": value, "ci90": [low, high]}}
        for name, (value, low, high) in closures.items()
    ]
    said = {"schema": "gap/2", "verdict": verdict, "answer": list(answer), "set": {"members": []}}
    return said | {"effects": entries, "where": [{"axis": axis}]}


# Residuals of two images, noise 1 %: 3 and 4 with the effect, 0 and 1 of the sampling: closure 1 - 1 / 25.
MEASURED = {
    "refitted": {"residual_pct": {"0": 3.0, "1": 4.0}, "noise_pct": {"0": 1.0, "1": 1.0}},
    "clean_by_image_pct": {"0": 0.0, "1": 1.0},
}
OFFSET = report(
    "attributed", "dark_offset", axis="exposure", dark_offset=(0.9, 0.85, 0.97), ghost=(0.5, 0.4, 0.6)
)
SMEAR = report("attributed", "column_smear", column_smear=(0.6, 0.5, 0.7), ghost=(0.8, 0.7, 0.9))
HALO = report("tie", "dark_offset", "wide_halo", axis="pointing", wide_halo=(0.97, 0.9, 1.0))
CASES = [
    (truth("clean"), report("none")),
    (truth("clean"), report("none")),
    (truth("clean"), report("inconclusive")),
    (truth("clean"), report("attributed", "ghost")),
    (truth("single", "dark_offset", left=5.0, **MEASURED), OFFSET),
    (truth("single", "ghost", left=3.0, **MEASURED), SMEAR),
    (truth("single", "wide_halo", left=2.0, **MEASURED), HALO),
    (truth("single", "core_blur", left=1.5), report("inconclusive")),
    (truth("single", "persistence", left=0.6), report("none")),
    (truth("pair", "ghost", "dark_offset", left=9.0), report("attributed", "dark_offset", "ghost")),
    (truth("unknown", "stripes", left=4.0), report("unknown")),
    (truth("unknown", "glow", left=4.0), report("attributed", "intensity_gradient")),
    (truth("unknown", "glow", left=0.3), report("none")),
]
JUDGED = [Judged(n, true, said, 10.0 + n) for n, (true, said) in enumerate(CASES)]
# Figure: cases, value, whether its goal is met.
FIGURES = {
    "false alarms on clean data": (4, 2 / 4, False),
    "answer contains the truth, >= 2 % left": (4, 3 / 4, False),
    "the same, >= 1 % left, inconclusive = 1/2": (5, 3.5 / 5, False),
    "first effect is the true one": (3, 2 / 3, False),
    "one wrong effect named with confidence": (13, 3 / 13, False),
    "mean number of named effects": (4, (1 + 1 + 2 + 2) / 4, True),
    "unknown effects called unknown or inconclusive": (2, 1 / 2, False),
    "closure by the first effect / by the true effect": (3, 1.0, True),  # of 1, 0.6 / 0.8, 1
    "90 % interval contains the true closure": (3, 2 / 3, False),
    "strongest axis is right": (3, 2 / 3, False),
    "time of the slowest case, s": (13, 22.0, True),
}


def by_figure(rows: Iterable[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    return {row["figure"]: row for row in rows}


def test_wilson_agrees_with_the_textbook() -> None:
    assert wilson(0, 0) == (0.0, 1.0)
    assert wilson(8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert wilson(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert wilson(10, 10)[1] == pytest.approx(1.0)


def test_every_figure_of_the_answers_equals_the_one_computed_by_hand() -> None:
    rows = by_figure(score(JUDGED)["rows"])
    assert set(rows) - set(by_figure(set_figures(JUDGED))) == set(FIGURES)
    for figure, (cases, value, met) in FIGURES.items():
        assert (rows[figure]["n"], rows[figure]["met"]) == (cases, met), figure
        assert rows[figure]["value"] == (value if value is None else pytest.approx(value)), figure
    interval = rows["one wrong effect named with confidence"]["wilson95"]
    assert interval == pytest.approx(wilson(3, 13))
    # The true closure excludes what the sampling leaves.
    assert true_closure(MEASURED) == pytest.approx(1 - 1 / 25)
    assert true_closure(truth("clean")) is None
    found = score(JUDGED)
    assert found["confusion"]["clean"] == {"none": 2, "inconclusive": 1, "ghost": 1}
    assert found["confusion"]["wide_halo"] == {"wide_halo": 1}
    assert found["confusion"]["pair"] == {"dark_offset": 1}
    assert sum(sum(row.values()) for row in found["confusion"].values()) == len(JUDGED)
    assert sum(bin_of["n"] for bin_of in found["power"]) == 9
    two_to_four = next(b for b in found["power"] if b["left_after_refit_pct"] == [2.0, 4.0])
    assert (two_to_four["n"], two_to_four["noticed"], two_to_four["contains_truth"]) == (2, 2, 1)
    top = found["power"][-1]
    assert (top["left_after_refit_pct"], top["n"], top["contains_truth"]) == ([8.0, None], 1, 1)
    clean = [case for case in JUDGED if case.kind == "clean" and case.verdict == "none"] * 5
    text = table(score(clean, {7: "exit status 1: no light"}))
    assert "no false alarm in 10 clean cases: the rate is below 0.300" in text
    assert "0007: exit status 1: no light" in text
    assert score([])["rows"][0]["value"] is None


def test_the_picture_is_drawn_with_and_without_cases(tmp_path: Path) -> None:
    for name, cases in (("full", JUDGED), ("empty", [])):
        score_png(score(cases), tmp_path / f"{name}.png")
        pixels = imread(tmp_path / f"{name}.png")
        assert pixels.shape[0] > 400 and pixels[..., :3].std() > 0.02, name


def with_set(
    kind: str,
    names: list[str],
    members: list[list[str]],
    *,
    left: float = 5.0,
    rival: float | None = None,
) -> Judged:
    """A case. rival: what none, and every effect but the true ones, leave; None: no ideal observer."""
    true = truth(kind, *names) | {"left_after_refit_pct": 0.0 if kind == "clean" else left}
    said = {"schema": "gap/2", "verdict": "unknown", "set": {"coverage": 0.9, "members": members}}
    ideal = None
    if rival is not None:
        chi2 = {(): rival, ("ghost",): rival, ("wide_halo",): rival}
        chi2 |= {} if kind == "unknown" else {tuple(names): 0.0}
        hypotheses = [{"effects": list(h), "chi2": value, "cost": 0.0} for h, value in chi2.items()]
        ideal = {"noncentrality": rival, "left_after_refit_pct": 2.5, "hypotheses": hypotheses}
    return Judged(0, true, said, 1.0, ideal)


SETS = [
    with_set("clean", [], [[]]),
    with_set("clean", [], [[], ["ghost"]]),
    with_set("clean", [], [["ghost"]]),
    with_set("single", ["ghost"], [["ghost"]], rival=400.0),
    with_set("single", ["ghost"], [["ghost", "persistence"]], rival=400.0, left=12.0),
    with_set("single", ["ghost"], [["wide_halo"]], rival=0.0),
    with_set("single", ["ghost"], [["wide_halo"], ["ghost"], ["unknown"]]),
    with_set("pair", ["ghost", "core_blur"], [["core_blur", "ghost"]], rival=400.0),
    with_set("pair", ["ghost", "core_blur"], [["ghost"], ["unknown"]], left=15.0, rival=400.0),
    with_set("unknown", ["stripes"], [["unknown"]], rival=400.0),
    with_set("unknown", ["stripes"], [["ghost"]], rival=1.0),
]
# Figure: cases, value.
FIGURES_OF_SETS = {
    "set covers the truth": (11, 7 / 11),
    "the same, clean": (3, 2 / 3),
    "the same, one effect": (4, 3 / 4),
    "the same, two effects": (2, 1 / 2),
    "the same, not in the library": (2, 1 / 2),
    "mean number of members of the set": (11, (1 + 2 + 1 + 1 + 1 + 1 + 3 + 1 + 2 + 1 + 1) / 11),
    "the same, noncentrality >= 30": (5, (1 + 1 + 1 + 2 + 1) / 5),
    "clean data: set without []": (3, 1 / 3),
    # A ghost in clean data, a halo for a ghost, and a ghost for stripes.
    "one wrong effect alone in the set": (11, 3 / 11),
    "only wrong effects in the set": (11, 3 / 11),
    "only wrong effects in the set, not in the library": (2, 1 / 2),
    "known, noncentrality >= 30: named and alone": (4, 2 / 4),
    "not in the library, noncentrality >= 30: unknown in set": (1, 1.0),
    "the same, nearest rival >= 30": (1, 1.0),
    # These truths state no stage and no light; `test_what_reports_tell_of_an_unknown_cause` has others.
    "the same, known and withheld effect": (0, None),
    "the same, its stage is right": (0, None),
    "known and withheld, each >= 30: both told": (0, None),
    "map of light: peak within 0.15": (0, None),
    "map of light: correlation, median": (0, None),
    "set covers the truth, >= 10 % left": (2, 1 / 2),
}
COMPARED = (
    "right and alone / ideal observer",
    "the same, without clean data",
    "right verdict / ideal observer",
)


def test_every_figure_of_the_sets_equals_the_one_computed_by_hand() -> None:
    rows = by_figure(set_figures(SETS))
    for figure, (cases, value) in FIGURES_OF_SETS.items():
        assert rows[figure]["n"] == cases, figure
        assert rows[figure]["value"] == (value if value is None else pytest.approx(value)), figure
    assert rows["set covers the truth"]["wilson95"] == pytest.approx(wilson(7, 11))
    assert set(rows) - set(FIGURES_OF_SETS) == set(COMPARED)
    found = score(SETS)
    told = found["cases"]
    assert told[8]["set"] == [["ghost"], ["unknown"]]
    assert (told[8]["noncentrality"], told[8]["rival"]) == (400.0, 400.0)
    assert told[6]["ideal_alone"] is None
    assert COMPARED[0] in table(found)
    for rival, left_pct in ((9.0, 2.5), (None, math.nan)):
        one = with_set("single", ["ghost"], [["ghost"]], rival=rival)
        del one.truth["left_after_refit_pct"]
        assert one.left_pct == pytest.approx(left_pct, nan_ok=True)
    assert score([one])["cases"][0]["left_after_refit_pct"] is None


def light(*values: float) -> dict[str, Any]:
    at = [4.5, 14.5]
    return {
        "stage": "detector",
        "map": {"x_px": at, "y_px": at, "value": np.reshape(values, (2, 2)).tolist()},
    }


def with_cause(kind: str, members: list[list[str]], *, chi2: float = 90.0, **unknown: Any) -> Judged:
    """A glow alone, or beside a ghost; each leaves the chi2. unknown: what the report states about an unknown cause."""
    names = {"unknown": ["glow"], "mixed": ["ghost", "glow"]}[kind]
    case = with_set(kind, names, members, rival=400.0)
    for effect in case.truth["effects"]:
        effect |= {"left_alone_chi2": chi2, "stage": "optics" if effect["name"] == "ghost" else "detector"}
    case.truth["light_map"] = {"size_px": 20, "values": [[0.0, 1.0], [2.0, 9.0]]}
    case.report["unknown"] = {"fields": [unknown] if unknown else []}
    return case


def test_what_reports_tell_of_an_unknown_cause() -> None:
    cases = [
        with_cause("unknown", [["unknown"]], **light(0.0, 2.0, 4.0, 18.0)),
        with_cause("unknown", [["ghost", "unknown"]], **light(9.0, 2.0, 1.0, 0.0)),
        with_cause("unknown", [["ghost"]]),
        with_cause(
            "unknown", [["unknown"]], stage="optics", curve={"time_s": [0.0, 9.0], "value": [1.0, 2.0]}
        ),
        with_cause("mixed", [["ghost", "unknown"]], stage="detector"),
        with_cause("mixed", [["ghost"], ["unknown"]], stage="detector"),
        with_cause("mixed", [["unknown", "ghost"]], stage="scene"),
        with_cause("mixed", [["persistence", "unknown"], ["unknown", "ghost"]], stage="detector", chi2=29.0),
    ]
    rows = by_figure(set_figures(cases))
    for figure, count, value in (
        ("not in the library, noncentrality >= 30: unknown in set", 4, 3 / 4),
        ("the same, its stage is right", 4, 2 / 4),
        ("the same, not in the library", 4, 2 / 4),
        ("the same, known and withheld effect", 4, 3 / 4),
        ("known and withheld, each >= 30: both told", 3, 1 / 3),
        ("only wrong effects in the set", 8, 1 / 8),
        ("only wrong effects in the set, not in the library", 4, 1 / 4),
        ("map of light: peak within 0.15", 2, 1 / 2),
    ):
        assert (rows[figure]["n"], rows[figure]["value"]) == (count, pytest.approx(value)), figure
    agrees = np.corrcoef([0, 1, 2, 9], [9, 2, 1, 0])[0, 1]
    assert rows["map of light: correlation, median"]["value"] == pytest.approx((1 + agrees) / 2)
    assert cases[1].map == pytest.approx((np.hypot(10, 10) / 10, agrees))
    assert [n for n, case in enumerate(cases) if case.is_right_and_alone()] == [0, 3, 4, 6]
    assert [required_causes(case.truth) for case in cases[3:5]] == [("unknown",), ("ghost", "unknown")]
    told = score(cases)["cases"][4]
    assert told["unknown"]["stage"] == "detector" and told["covered"] is True
    assert told["left_alone_chi2"] == [90.0, 90.0]


def test_what_is_right_is_compared_with_what_could_be_known() -> None:
    rows = by_figure(set_figures(SETS))
    alone = [one.known.alone for one in SETS if one.known is not None]
    assert alone[:3] == [1 - LEVEL] * 3
    assert alone[3] > 0.999 > 0.5 > alone[5]
    # Right and alone: one clean case, the first ghost, the pair, and the stripes. The verdict of every case is `unknown`,
    # which is right for both stripes.
    for figure, cases, right, known in (
        (COMPARED[0], 10, 4, alone),
        (COMPARED[1], 7, 3, alone[3:]),
        (COMPARED[2], 10, 2, alone),
    ):
        expected = pytest.approx(right / math.fsum(known))
        assert (rows[figure]["n"], rows[figure]["value"]) == (cases, expected), figure
    low, high = wilson(3, 7)
    mean = math.fsum(alone[3:]) / 7
    assert rows[COMPARED[1]]["wilson95"] == pytest.approx((low / mean, high / mean))
    # Nothing is compared where nothing could be known.
    row = share("nothing", SETS[:1], Judged.is_right_and_alone, expected=lambda one: 0.0)
    assert (row["n"], row["value"], row["wilson95"]) == (1, None, None)


def test_a_verdict_names_the_effects_that_show_and_nothing_else() -> None:
    pair = with_set("pair", ["ghost", "core_blur"], [["ghost"]], rival=400.0)
    pair.report.update(verdict="attributed", answer=["ghost"])
    # Of two effects that show, or of which none shows, both are required.
    for left, alone in (((4.0, 0.9), True), ((4.0, 1.2), False), ((0.9, 0.9), False)):
        for effect, pct in zip(pair.truth["effects"], left, strict=True):
            effect["left_alone_pct"] = pct
        assert pair.covers(("ghost",)) == pair.is_right_and_alone() == alone, left
        assert score([pair])["rows"][1]["value"] == float(alone)
        assert pair.covers(("ghost", "core_blur")) and not pair.covers(("core_blur",))
    # Further effects cover the truth, but are not right.
    extra = with_set("single", ["ghost"], [["ghost", "persistence"]])
    assert extra.covers(("ghost", "persistence")) and not extra.is_right_and_alone()
    verdicts: list[tuple[str, list[str], str, list[str], bool]] = [
        ("clean", [], "none", [], True),
        ("clean", [], "inconclusive", [], False),
        ("unknown", ["stripes"], "unknown", [], True),
        ("single", ["ghost"], "attributed", ["ghost"], True),
        ("single", ["ghost"], "attributed", ["ghost", "core_blur"], False),
        ("single", ["ghost"], "tie", ["ghost"], False),
        ("pair", ["ghost", "core_blur"], "attributed", ["core_blur", "ghost"], True),
        ("mixed", ["ghost", "stripes"], "unknown", ["ghost"], True),
        ("mixed", ["ghost", "stripes"], "unknown", [], False),
    ]
    for kind, names, verdict, answer, right in verdicts:
        case = with_set(kind, names, [[]])
        case.report.update(verdict=verdict, answer=answer)
        assert case.verdict_is_right() is right, (kind, verdict, answer)
