"""The score of a blind set: one table of figures that judge the diagnosis, as JSON and as text.

The rows judge cases without an effect, and true causes by their class (`judge`). A cause without a bound has no
class. In a row "/ bound", the number of causes for which the report is right is divided by the number expected of a
Bayes observer: the sum of the probabilities in the bounds. The rows of levels state the mean of these probabilities
instead.

    (p + z^2 / 2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)                             Eq. (1)

Eq. (1) is the Wilson interval of a fraction p of n cases.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from statistics import mean, median
from typing import TypedDict

from psfcore.blind.case_set import BlindSet
from psfcore.blind.cases import MIXED
from psfcore.blind.judge import (
    CLASSES,
    FAMILY,
    ISOLABLE,
    LEVELS,
    NAME,
    OPEN,
    STAGE,
    Cause,
    DiagnosedCase,
    diagnosed_cases,
)

SCHEMA = "gap-blind/3"
STRONG_PCT = 10.0  # residual that a strong effect leaves in the discs
NEAR = 0.15  # distance of the peak of a map from the true peak, in units of half the field
SLOWEST_S = 180.0
Z95 = 1.959963984540054


class Row(TypedDict):
    """A row of the table; None for what the cases do not give.

    Attributes
    ----------
    wilson95
        The ends of the interval of the value.
    """

    figure: str
    n: int
    value: float | None
    wilson95: list[float] | None
    bound: float | None
    goal: str
    met: bool | None


class Score(TypedDict):
    """The score of a blind set."""

    schema: str
    judged: int
    failures: dict[str, str]
    rows: list[Row]
    cases: list[dict[str, object]]


def wilson(hits: float, cases: int) -> tuple[float, float]:
    """Eq. (1) for hits / cases; (0, 1) if there is no case."""
    if cases == 0:
        return 0.0, 1.0
    p, spread = hits / cases, Z95**2 / cases
    middle = (p + spread / 2) / (1 + spread)
    half = Z95 * math.sqrt(p * (1 - p) / cases + spread / (4 * cases)) / (1 + spread)
    return max(0.0, middle - half), min(1.0, middle + half)


def row(
    figure: str,
    values: Sequence[float],
    least: float | None = None,
    most: float | None = None,
    *,
    of: Callable[[Sequence[float]], float] | None = None,
    bounds: Sequence[float] = (),
    expected: Sequence[float] | None = None,
) -> Row:
    """A row of the table, as JSON.

    Parameters
    ----------
    values
        For each case a number, or whether the case meets a condition.
    of
        The function that computes the figure from the numbers. None: the figure is the fraction of the cases that meet
        the condition, divided by the mean of ``expected``, the probability that a Bayes observer meets it (None: 1).
        Its interval is Eq. (1), divided by the same mean, which is treated as exact.
    least, most
        The least and the largest value that meet the goal.
    bounds
        Probabilities whose mean is stated beside the value.
    """
    possible = len(values) if expected is None else math.fsum(expected)
    value = interval = None
    if values and of is not None:
        value = float(of(values))
    elif possible > 0:
        value, scale = sum(values) / possible, len(values) / possible
        interval = [end * scale for end in wilson(sum(values), len(values))]
    ends = [f"{end:.3g}" for end in (least, most) if end is not None]
    sign = "" if len(ends) != 1 else "<= " if least is None else ">= "
    met = value is not None and (least is None or value >= least) and (most is None or value <= most)
    return {
        "figure": figure,
        "n": len(values),
        "value": value,
        "wilson95": interval,
        "bound": mean(bounds) if bounds else None,
        "goal": sign + " - ".join(ends),
        "met": met if ends and value is not None else None,
    }


def rows(cases: Sequence[DiagnosedCase]) -> list[Row]:
    """All rows of the table."""
    causes = [cause for case in cases for cause in case.causes]
    hidden, open_, isolable = ([cause for cause in causes if cause.visibility == one] for one in CLASSES)
    known, withheld = ([cause for cause in isolable if cause.is_known is one] for one in (True, False))
    both = [case for case in cases if case.truth["kind"] == MIXED and set(case.causes) <= set(isolable)]
    strong = [cause for cause in causes if cause.effect["left_alone_pct"] >= STRONG_PCT]
    answers = [cause.cover or next(iter(cause.case.entries), None) for cause in open_]
    sizes = [len(entry["alternatives"]) for entry in answers if entry is not None]
    limits = [below for cause in hidden + open_ if (below := cause.is_below_limit) is not None]
    axes = [right for cause in open_ + isolable if (right := cause.is_on_axis) is not None]
    maps = [cause.map for cause in causes if cause.map is not None]
    closures = [cause.closure for cause in causes if cause.closure is not None]
    wrong = [number < case.wrong_alone for case in cases for number in range(len(case.causes))]
    within = [low <= true <= high for _, low, high, true in closures]
    return [
        row(
            "false alarms on clean data",
            [bool(case.entries) for case in cases if not case.causes],
            most=1 / 60,
        ),
        row("hidden: no cause is claimed", [not one.case.entries for one in hidden if one.is_only], 0.95),
        row("hidden or open: strength below excluded_95", limits, 0.95),
        row("open: an entry covers the cause", [one.cover is not None for one in open_], 0.9),
        row("open: mean number of alternatives", sizes, most=2.5, of=mean),
        _over_bound("isolable, known: named and alone / bound", known, NAME, 0.75),
        row("isolable, known: named and alone", _right(known, NAME), 0.75),
        _over_bound("isolable, withheld: right family / bound", withheld, FAMILY, 0.7),
        _over_bound("isolable, withheld: right stage / bound", withheld, STAGE, 0.8),
        row("isolable, known beside withheld: both told", [case.tells_both for case in both], 0.6),
        row("wrong effect alone", wrong, most=0.05),
        row("10 % left: an entry covers the cause", [one.cover is not None for one in strong], 0.8),
        row("map of light: peak within 0.15", [distance <= NEAR for distance, _ in maps], 0.9),
        row("map of light: correlation, median", [correlation for _, correlation in maps], 0.8, of=median),
        row("90 % interval contains the true closure", within, 0.85, 0.95),
        row("closure / true closure, median", [one[0] / one[3] for one in closures], 0.95, of=median),
        row("strongest axis is right", axes, 0.9),
        row("time of the slowest case, s", [case.wall_s for case in cases], most=SLOWEST_S, of=max),
        *(
            row(f"{name}: right at the level of {level}", _right(some, level), bounds=_bounds(some, level))
            for name, some in ((OPEN, open_), (ISOLABLE, isolable))
            for level in LEVELS
        ),
    ]


def _right(causes: Sequence[Cause], level: str) -> list[bool]:
    return [bool(cause.right_entries(level)) for cause in causes]


def _bounds(causes: Sequence[Cause], level: str) -> list[float]:
    return [cause.bound[level] for cause in causes if cause.bound is not None]


def _over_bound(figure: str, causes: Sequence[Cause], level: str, least: float) -> Row:
    return row(figure, _right(causes, level), least, expected=_bounds(causes, level))


def score(cases: Sequence[DiagnosedCase], failures: Mapping[int, str]) -> Score:
    """The score of the cases that have a report, as JSON (gap-blind/3).

    Parameters
    ----------
    failures
        The reasons why the other cases have no report, by number.
    """
    return {
        "schema": SCHEMA,
        "judged": len(cases),
        "failures": {f"{number:04d}": why for number, why in failures.items()},
        "rows": rows(cases),
        "cases": [case.as_json() for case in cases],
    }


def table(found: Score) -> str:
    """The table of a score as plain text."""
    lines = [f"{'figure':<50}{'n':>5}{'value':>9}  {'95 % (Wilson)':<16}{'bound':<8}{'goal':<13}met"]
    for one in found["rows"]:
        value = "-" if one["value"] is None else f"{one['value']:.3f}"
        bound = "" if one["bound"] is None else f"{one['bound']:.3f}"
        interval = " - ".join(f"{end:.3f}" for end in one["wilson95"] or ())
        met = {None: "", True: "yes", False: "NO"}[one["met"]]
        lines.append(
            f"{one['figure']:<50}{one['n']:>5}{value:>9}  {interval:<16}{bound:<8}{one['goal']:<13}{met}"
        )
    lines.append(f"{found['judged']} cases judged, {len(found['failures'])} failed")
    lines += [f"  {number}: {why.splitlines()[-1]:.120}" for number, why in found["failures"].items()]
    return "\n".join(lines)


def write_score(blind_set: BlindSet, numbers: Sequence[int], not_made: Mapping[int, str]) -> str:
    """Open the seals of a diagnosed set, judge its cases, and write score.json and score.txt into its folder.

    Returns the table as text.

    Parameters
    ----------
    numbers
        The cases to score.
    not_made
        The reason for each case that could not be made.
    """
    cases, failures = diagnosed_cases(blind_set, numbers)
    found = score(cases, dict(not_made) | failures)
    text = table(found)
    (blind_set.folder / "score.json").write_text(json.dumps(found, indent=1, allow_nan=False), "utf-8")
    (blind_set.folder / "score.txt").write_text(text + "\n", "utf-8")
    return text
