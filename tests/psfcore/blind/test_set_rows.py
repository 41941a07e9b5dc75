"""The rows of the sets of hypotheses: hand-made truths, sets and ideal observers, figures computed by hand."""

from __future__ import annotations

import math
from typing import Any

import pytest

from psfcore.blind.bounds import LEVEL
from psfcore.blind.rows import share_of_expected, wilson
from psfcore.blind.score_table import score, table
from psfcore.blind.scoring import Judged, covers, is_right_and_alone, verdict_is_right
from psfcore.blind.set_rows import set_rows

Members = list[list[str]]


def case(
    kind: str, names: list[str], members: Members | None, *, left: float = 5.0, rival: float | None = None
) -> Judged:
    """A case. rival: what none, and every effect but the true ones, leave; None: no ideal observer."""
    truth = {
        "kind": kind,
        "effects": [{"name": name, "strength": 1.0} for name in names],
        "left_before_refit_pct": left,
        "left_after_refit_pct": 0.0 if kind == "clean" else left,
    }
    report: dict[str, Any] = {"schema": "gap/1" if members is None else "gap/2", "verdict": "unknown"}
    if members is not None:
        report["set"] = {"coverage": 0.9, "members": members}
    ideal = None if rival is None else ideal_with(names, rival)
    return Judged(0, truth, report, 1.0, ideal)


def ideal_with(names: list[str], rival: float) -> dict[str, Any]:
    left = {(): rival, ("ghost",): rival, ("wide_halo",): rival, tuple(names): 0.0}
    if names == ["stripes"]:
        del left["stripes",]
    hypotheses = [{"effects": list(h), "chi2": chi2, "cost": 0.0} for h, chi2 in left.items()]
    return {"noncentrality": rival, "left_after_refit_pct": 2.5, "hypotheses": hypotheses}


CASES = [
    case("clean", [], [[]]),
    case("clean", [], [[], ["ghost"]]),
    case("clean", [], [["ghost"]]),
    case("single", ["ghost"], [["ghost"]], rival=400.0),
    case("single", ["ghost"], [["ghost", "persistence"]], rival=400.0, left=12.0),
    case("single", ["ghost"], [["wide_halo"]], rival=0.0),
    case("single", ["ghost"], [["wide_halo"], ["ghost"], ["unknown"]]),
    case("pair", ["ghost", "core_blur"], [["core_blur", "ghost"]], rival=400.0),
    case("pair", ["ghost", "core_blur"], [["ghost"], ["unknown"]], left=15.0, rival=400.0),
    case("unknown", ["stripes"], [["unknown"]], rival=400.0),
    case("unknown", ["stripes"], [["ghost"]], rival=1.0),
]

# Figure: cases, value.
EXPECTED = {
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
    "not in the library, noncentrality >= 30: unknown in set": (1, 1.0),
    "the same, nearest rival >= 30": (1, 1.0),
    "set covers the truth, >= 10 % left": (2, 1 / 2),
}


def test_every_figure_equals_the_one_computed_by_hand() -> None:
    rows = {row.figure: row for row in set_rows(CASES)}
    for figure, (cases, value) in EXPECTED.items():
        assert rows[figure].cases == cases, figure
        assert rows[figure].value == pytest.approx(value), figure
    assert rows["set covers the truth"].interval95 == pytest.approx(wilson(7, 11))
    assert set(rows) - set(EXPECTED) == {
        "right and alone / ideal observer",
        "the same, without clean data",
        "right verdict / ideal observer",
    }


def test_what_is_right_is_compared_with_what_could_be_known() -> None:
    rows = {row.figure: row for row in set_rows(CASES)}
    alone = [one.known.alone for one in CASES if one.known is not None]
    assert alone[:3] == [1 - LEVEL] * 3
    assert alone[3] > 0.999 > 0.5 > alone[5]
    # Right and alone: one clean case, the first ghost, the pair, and the stripes.
    with_clean = rows["right and alone / ideal observer"]
    assert (with_clean.cases, with_clean.value) == (10, pytest.approx(4 / math.fsum(alone)))
    without = rows["the same, without clean data"]
    assert (without.cases, without.value) == (7, pytest.approx(3 / math.fsum(alone[3:])))
    # The verdict of every case is `unknown`, which is right for both stripes.
    verdicts = rows["right verdict / ideal observer"]
    assert (verdicts.cases, verdicts.value) == (10, pytest.approx(2 / math.fsum(alone)))
    low, high = wilson(3, 7)
    mean = math.fsum(alone[3:]) / 7
    assert without.interval95 == pytest.approx((low / mean, high / mean))


def test_nothing_is_compared_where_nothing_could_be_known() -> None:
    row = share_of_expected("nothing", CASES[:1], is_right_and_alone, lambda one: 0.0)
    assert (row.cases, row.value, row.interval95) == (1, None, None)


def test_a_pair_whose_second_effect_is_not_seen_is_covered_by_the_first() -> None:
    pair = case("pair", ["ghost", "core_blur"], [["ghost"]], rival=400.0)
    assert not covers(pair, ("ghost",))
    for effect, left in zip(pair.truth["effects"], (4.0, 0.9), strict=True):
        effect["left_alone_pct"] = left
    assert covers(pair, ("ghost",)) and is_right_and_alone(pair)
    assert covers(pair, ("ghost", "core_blur"))
    assert not covers(pair, ("core_blur",))
    pair.truth["effects"][0]["left_alone_pct"] = 0.9  # nothing is seen: both are required
    assert not covers(pair, ("ghost",))


def test_further_effects_cover_the_truth_but_are_not_right() -> None:
    extra = case("single", ["ghost"], [["ghost", "persistence"]])
    assert covers(extra, ("ghost", "persistence"))
    assert not is_right_and_alone(extra)
    assert not is_right_and_alone(case("clean", [], None))


def test_reports_without_a_set_have_no_such_rows() -> None:
    old = [case("clean", [], None)]
    assert set_rows(old) == ()
    assert "set covers the truth" not in {row.figure for row in score(old).rows}


def test_the_score_tells_the_set_and_what_could_be_known() -> None:
    found = score(CASES)
    told = found.to_json()["cases"]
    assert told[8]["set"] == [["ghost"], ["unknown"]]
    assert (told[8]["noncentrality"], told[8]["rival"]) == (400.0, 400.0)
    assert told[6]["ideal_alone"] is None
    assert "right and alone / ideal observer" in table(found)


def test_a_truth_without_a_residual_takes_that_of_the_ideal_observer() -> None:
    one = case("single", ["ghost"], [["ghost"]], rival=9.0)
    del one.truth["left_after_refit_pct"]
    assert one.left_pct == 2.5
    unmeasured = case("single", ["ghost"], [["ghost"]])
    del unmeasured.truth["left_after_refit_pct"]
    assert math.isnan(unmeasured.left_pct)
    assert score([unmeasured]).to_json()["cases"][0]["left_after_refit_pct"] is None


@pytest.mark.parametrize(
    ("kind", "names", "verdict", "answer", "right"),
    [
        ("clean", [], "none", [], True),
        ("clean", [], "inconclusive", [], False),
        ("unknown", ["stripes"], "unknown", [], True),
        ("unknown", ["stripes"], "attributed", ["ghost"], False),
        ("single", ["ghost"], "attributed", ["ghost"], True),
        ("single", ["ghost"], "attributed", ["ghost", "core_blur"], False),
        ("single", ["ghost"], "tie", ["ghost"], False),
        ("pair", ["ghost", "core_blur"], "attributed", ["ghost"], False),
        ("pair", ["ghost", "core_blur"], "attributed", ["core_blur", "ghost"], True),
    ],
)
def test_a_verdict_is_right_if_it_states_the_truth_and_nothing_else(
    kind: str, names: list[str], verdict: str, answer: list[str], right: bool
) -> None:
    judged = case(kind, names, [[]])
    judged.report.update(verdict=verdict, answer=answer)
    assert verdict_is_right(judged) is right
