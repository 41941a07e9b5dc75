"""The score of a blind set: the table that judges the diagnosis, the confusion matrix, and the power.

    Wilson: (p + z^2 / 2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)                     Eq. (1)

Each row of the table counts its own cases. "Left" is what the effects leave in the discs after the refit. The answer of
a report is the set of effects that the verdict `attributed` or `tie` names.

| row | cases | counted |
|---|---|---|
| false alarms | clean | the verdict is not `none` |
| inconclusive on clean data | clean | the verdict is `inconclusive`: a part of the row above |
| answer contains the truth, >= 2 % | known effects and pairs with 2 % left or more | the answer names the true effect; of a pair both, but not one that leaves less than 1 % alone while the other leaves more |
| the same, >= 1 % | with 1 % left or more | as above; `inconclusive` counts one half |
| the same, shown by the discs | cases of the 2 % row with chi2 of SHOWN_CHI2 or more in the means of their discs, without any fit of an effect; of a pair each required effect alone, to first order | as above |
| first place is the truth | single known effects, 2 % or more | the first of the report's `effects` is the true one |
| one wrong effect named | all | the verdict is `attributed` with one effect, which is not true. For clean cases and unknown effects every name is wrong. A `tie` or `inconclusive` admits doubt and does not count |
| mean size of the answer | cases of the 2 % row with an answer | effects in the answer |
| unknown effects | unknown effects, 2 % or more | the verdict is `unknown` or `inconclusive` |
| closure as a share | single known effects, 2 % or more, with an answer | median of the first effect's closure over the true effect's, if that is 0.1 or more; 1 if the first is the true one |
| 90 % interval | as above | the true effect's ci90 contains the true closure |
| strongest axis | single known effects with AXES, 2 % or more, verdict not `none` | the first of `where` belongs to the effect |
| time | all | wall time of the slowest case, s |
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import mean, median
from typing import Any

from psfcore.blind.cases import CLEAN, FOREIGN, PAIR, SINGLE
from psfcore.blind.effects.registry import KNOWN, UNKNOWN
from psfcore.blind.scoring import (
    AXES,
    INCONCLUSIVE,
    LOWER_LEVEL_PCT,
    NONE,
    UNKNOWN_VERDICT,
    Judged,
    axis_is_right,
    closure_share,
    contains_truth,
    has_interval,
    interval_holds,
    is_shown,
    names_one_wrong,
    raises_alarm,
    said_label,
    shown_chi2,
    true_label,
)

SCHEMA = "gap-blind/1"
Z95 = 1.959963984540054
LEVEL_PCT = 2.0
POWER_EDGES_PCT = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, math.inf)


@dataclass(frozen=True)
class Row:
    """A row of the table. interval95: Eq. (1), for a share of cases; None otherwise."""

    figure: str
    cases: int
    value: float | None
    interval95: tuple[float, float] | None
    goal: str
    met: bool | None

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "figure": self.figure,
            "n": self.cases,
            "value": self.value,
            "wilson95": None if self.interval95 is None else list(self.interval95),
            "goal": self.goal,
            "met": self.met,
        }


@dataclass(frozen=True)
class Score:
    """The table, the confusion matrix, the power, and why the failed cases failed, by number."""

    rows: tuple[Row, ...]
    confusion: dict[str, dict[str, int]]
    power: tuple[dict[str, Any], ...]
    judged: int
    failures: dict[int, str]
    cases: tuple[dict[str, Any], ...]

    def to_json(self) -> dict[str, Any]:
        """Schema gap-blind/1."""
        return {
            "schema": SCHEMA,
            "judged": self.judged,
            "failures": {f"{number:04d}": why for number, why in self.failures.items()},
            "rows": [row.to_json() for row in self.rows],
            "confusion": self.confusion,
            "power": list(self.power),
            "cases": list(self.cases),
        }


def wilson(hits: float, cases: int, z: float = Z95) -> tuple[float, float]:
    """Eq. (1); (0, 1) if there is no case."""
    if cases == 0:
        return 0.0, 1.0
    p, spread = hits / cases, z**2 / cases
    middle = (p + spread / 2) / (1 + spread)
    half = z * math.sqrt(p * (1 - p) / cases + spread / (4 * cases)) / (1 + spread)
    return max(0.0, middle - half), min(1.0, middle + half)


def score(judged: Sequence[Judged], failures: dict[int, str] | None = None) -> Score:
    """The score of the cases that have a report. failures: why the other cases have no report, by number."""
    return Score(
        rows=_rows(judged),
        confusion=_confusion(judged),
        power=_power(judged),
        judged=len(judged),
        failures=dict(failures or {}),
        cases=tuple(_case(case) for case in judged),
    )


def _rows(judged: Sequence[Judged]) -> tuple[Row, ...]:
    known = [case for case in judged if case.kind in (SINGLE, PAIR)]
    strong = [case for case in known if case.left_pct >= LEVEL_PCT]
    foreign = [case for case in judged if case.kind == FOREIGN and case.left_pct >= LEVEL_PCT]
    single = [case for case in strong if case.kind == SINGLE]
    return (
        *_alarm_rows([case for case in judged if case.kind == CLEAN]),
        *_answer_rows(known, strong),
        _share(
            "first place is the truth",
            single,
            lambda case: case.first == case.true_names[0],
            ">= 0.85",
            lambda p: p >= 0.85,
        ),
        _share(
            "one wrong effect named with confidence", judged, names_one_wrong, "<= 0.02", lambda p: p <= 0.02
        ),
        _value(
            "mean size of the answer",
            [float(len(case.answer)) for case in strong if case.answer],
            mean,
            "<= 1.5",
            lambda value: value <= 1.5,
        ),
        _share(
            "unknown effects called unknown or inconclusive",
            foreign,
            lambda case: case.verdict in (UNKNOWN_VERDICT, INCONCLUSIVE),
            ">= 0.80",
            lambda p: p >= 0.8,
        ),
        *_closure_rows([case for case in single if case.answer]),
        _axis_row(single),
        _value(
            "time of the slowest case, s", [case.wall_s for case in judged], max, "<= 180", lambda s: s <= 180
        ),
    )


def _alarm_rows(clean: Sequence[Judged]) -> tuple[Row, ...]:
    return (
        _share("false alarms on clean data", clean, raises_alarm, "<= 0.01", lambda p: p <= 0.01),
        _share("inconclusive on clean data", clean, lambda case: case.verdict == INCONCLUSIVE, "", None),
    )


def _answer_rows(known: Sequence[Judged], strong: Sequence[Judged]) -> tuple[Row, ...]:
    return (
        _share(
            "answer contains the truth, >= 2 % left", strong, contains_truth, ">= 0.95", lambda p: p >= 0.95
        ),
        _share(
            "the same, >= 1 % left, inconclusive = 1/2",
            [case for case in known if case.left_pct >= LOWER_LEVEL_PCT],
            lambda case: 0.5 if case.verdict == INCONCLUSIVE else contains_truth(case),
            ">= 0.80",
            lambda p: p >= 0.8,
        ),
        _share(
            "the same, >= 2 % left, shown by the discs",
            [case for case in strong if is_shown(case)],
            contains_truth,
            "",
            None,
        ),
    )


def _closure_rows(answered: Sequence[Judged]) -> tuple[Row, ...]:
    return (
        _value(
            "closure over that of the true effect",
            [share for share in map(closure_share, answered) if share is not None],
            median,
            ">= 0.95",
            lambda value: value >= 0.95,
        ),
        _share(
            "90 % interval contains the true closure",
            [case for case in answered if has_interval(case)],
            interval_holds,
            "0.85 - 0.95",
            lambda p: 0.85 <= p <= 0.95,
        ),
    )


def _axis_row(single: Sequence[Judged]) -> Row:
    noticed = [case for case in single if case.verdict != NONE and case.true_names[0] in AXES]
    return _share("strongest axis is right", noticed, axis_is_right, ">= 0.90", lambda p: p >= 0.9)


def _share(
    figure: str,
    cases: Sequence[Judged],
    holds: Callable[[Judged], float],
    goal: str,
    met: Callable[[float], bool] | None,
) -> Row:
    hits = float(sum(holds(case) for case in cases))
    value = hits / len(cases) if cases else None
    return Row(
        figure,
        len(cases),
        value,
        wilson(hits, len(cases)) if cases else None,
        goal,
        None if met is None or value is None else met(value),
    )


def _value(
    figure: str,
    values: Sequence[float],
    of: Callable[[Sequence[float]], float],
    goal: str,
    met: Callable[[float], bool],
) -> Row:
    value = float(of(values)) if values else None
    return Row(figure, len(values), value, None, goal, None if value is None else met(value))


def _confusion(judged: Sequence[Judged]) -> dict[str, dict[str, int]]:
    """Number of cases by truth (row) and by first effect named, or verdict (column)."""
    table: dict[str, Counter[str]] = {}
    for case in judged:
        table.setdefault(true_label(case), Counter())[said_label(case)] += 1
    order = ("clean", *KNOWN, *UNKNOWN, "pair")
    return {name: dict(table[name]) for name in order if name in table}


def _power(judged: Sequence[Judged]) -> tuple[dict[str, Any], ...]:
    """In bins of what is left in the discs: how many effects were noticed, and how many known ones were named."""
    found = []
    for low, high in pairwise(POWER_EDGES_PCT):
        here = [
            case for case in judged if case.kind in (SINGLE, PAIR, FOREIGN) and low <= case.left_pct < high
        ]
        known = [case for case in here if case.kind != FOREIGN]
        noticed, named = sum(map(raises_alarm, here)), sum(map(contains_truth, known))
        found.append(
            {
                "left_after_refit_pct": [low, None if math.isinf(high) else high],
                "n": len(here),
                "noticed": noticed,
                "noticed_wilson95": list(wilson(noticed, len(here))),
                "n_known": len(known),
                "contains_truth": named,
                "contains_wilson95": list(wilson(named, len(known))),
            }
        )
    return tuple(found)


def _case(case: Judged) -> dict[str, Any]:
    """The entry of one case in score.json."""
    return {
        "case": case.number,
        "kind": case.kind,
        "truth": list(case.true_names),
        "strength": [effect["strength"] for effect in case.truth["effects"]],
        "left_before_refit_pct": case.truth["left_before_refit_pct"],
        "left_after_refit_pct": case.left_pct,
        "clean_left_pct": case.truth.get("clean_left_pct"),
        "shown_chi2": shown_chi2(case.truth),
        "verdict": case.verdict,
        "answer": list(case.answer),
        "first": case.first,
        "wall_s": case.wall_s,
    }


def table(found: Score) -> str:
    """The table as plain text."""
    lines = [f"{'figure':<50}{'n':>5}{'value':>9}  {'95 % (Wilson)':<16}{'goal':<13}met"]
    for row in found.rows:
        value = "-" if row.value is None else f"{row.value:.3f}"
        interval = "" if row.interval95 is None else f"{row.interval95[0]:.3f} - {row.interval95[1]:.3f}"
        met = {None: "", True: "yes", False: "NO"}[row.met]
        lines.append(f"{row.figure:<50}{row.cases:>5}{value:>9}  {interval:<16}{row.goal:<13}{met}")
    clean = found.rows[0]
    if clean.value == 0.0 and clean.cases:
        lines.append(
            f"no false alarm in {clean.cases} clean cases: the rate is below {min(3 / clean.cases, 1.0):.3f} (95 %)"
        )
    lines.append(f"{found.judged} cases judged, {len(found.failures)} failed")
    return "\n".join(
        [*lines, *(f"  {number:04d}: {why.splitlines()[-1]:.120}" for number, why in found.failures.items())]
    )
