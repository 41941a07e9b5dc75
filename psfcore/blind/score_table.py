"""The score of a blind set: a table of figures that judge the diagnosis, the confusion matrix, and the power.

Each row of the table has its own selection of cases. "Left" is the residual that the effects leave in the discs after the
refit of the PSF. The answer of a report is the set of effects that the verdict `attributed` or `tie` names. An effect is
"known" if the gap library contains it, otherwise "unknown".

| row | cases | counted |
|---|---|---|
| false alarms | clean | the verdict is not `none` |
| inconclusive on clean data | clean | the verdict is `inconclusive`; these cases are also false alarms |
| answer contains the truth, >= 2 % | known effects and pairs with 2 % left or more | the answer contains the true effect. For a pair it must contain both effects; an effect that leaves less than 1 % alone is not required if the other leaves more |
| the same, >= 1 % | known effects and pairs with 1 % left or more | as above; a case with the verdict `inconclusive` counts one half |
| the same, shown by the discs | cases of the 2 % row in which the chi2 of the disc means, with no effect in the model, is SHOWN_CHI2 or more. For a pair, the same must hold for each required effect alone, to first order | the answer contains the truth |
| first effect is the true one | single known effects, 2 % or more | the first entry of the report's `effects` is the true effect |
| one wrong effect named with confidence | all | the verdict is `attributed`, and names one effect that is not true. For clean cases and unknown effects every name is wrong. The verdicts `tie` and `inconclusive` express doubt and do not count |
| mean number of named effects | cases of the 2 % row with an answer | number of effects in the answer |
| unknown effects | unknown effects, 2 % or more | the verdict is `unknown` or `inconclusive` |
| closure by the first effect / by the true effect | single known effects, 2 % or more, with an answer | median of the closure by the first effect divided by the closure by the true effect. 1 if the first effect is the true one; cases in which the closure by the true effect is below 0.1 are left out |
| 90 % interval contains the true closure | single known effects, 2 % or more, with an answer | the ci90 of the closure by the true effect contains the true closure |
| strongest axis is right | single known effects that have axes in `scoring.AXES`, 2 % or more, verdict not `none` | the first axis of the report's `where` is an axis of the effect |
| time | all | wall time of the slowest case, s |

`set_rows` explains the rows that judge the set of hypotheses in reports. The interval of a fraction is the Wilson
interval (`rows`).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from statistics import mean, median
from typing import Any

from psfcore.blind.cases import CLEAN, FOREIGN, PAIR, SINGLE
from psfcore.blind.effects.registry import KNOWN, UNKNOWN
from psfcore.blind.rows import Row, of_values, share
from psfcore.blind.rows import wilson as wilson
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
from psfcore.blind.set_rows import set_rows

SCHEMA = "gap-blind/1"
LEVEL_PCT = 2.0
POWER_EDGES_PCT = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, math.inf)


@dataclass(frozen=True)
class Score:
    """The score of a blind set.

    rows: the rows of the table. confusion, power: the results of `_confusion` and `_power`. judged: the number of cases
    with a report. failures: the reasons why cases have no report, by number of the case. cases: one entry for each
    case.
    """

    rows: tuple[Row, ...]
    confusion: dict[str, dict[str, int]]
    power: tuple[dict[str, Any], ...]
    judged: int
    failures: dict[int, str]
    cases: tuple[dict[str, Any], ...]

    def to_json(self) -> dict[str, Any]:
        """The score as JSON, schema gap-blind/1."""
        return {
            "schema": SCHEMA,
            "judged": self.judged,
            "failures": {f"{number:04d}": why for number, why in self.failures.items()},
            "rows": [row.to_json() for row in self.rows],
            "confusion": self.confusion,
            "power": list(self.power),
            "cases": list(self.cases),
        }


def score(judged: Sequence[Judged], failures: dict[int, str] | None = None) -> Score:
    """Score the cases that have a report. failures: the reasons why the other cases have no report, by number."""
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
        share(
            "first effect is the true one",
            single,
            lambda case: case.first == case.true_names[0],
            ">= 0.85",
            lambda p: p >= 0.85,
        ),
        share(
            "one wrong effect named with confidence", judged, names_one_wrong, "<= 0.02", lambda p: p <= 0.02
        ),
        of_values(
            "mean number of named effects",
            [float(len(case.answer)) for case in strong if case.answer],
            mean,
            "<= 1.5",
            lambda value: value <= 1.5,
        ),
        share(
            "unknown effects called unknown or inconclusive",
            foreign,
            lambda case: case.verdict in (UNKNOWN_VERDICT, INCONCLUSIVE),
            ">= 0.80",
            lambda p: p >= 0.8,
        ),
        *_closure_rows([case for case in single if case.answer]),
        _axis_row(single),
        *set_rows(judged),
        of_values(
            "time of the slowest case, s", [case.wall_s for case in judged], max, "<= 180", lambda s: s <= 180
        ),
    )


def _alarm_rows(clean: Sequence[Judged]) -> tuple[Row, ...]:
    return (
        share("false alarms on clean data", clean, raises_alarm, "<= 0.01", lambda p: p <= 0.01),
        share("inconclusive on clean data", clean, lambda case: case.verdict == INCONCLUSIVE),
    )


def _answer_rows(known: Sequence[Judged], strong: Sequence[Judged]) -> tuple[Row, ...]:
    return (
        share(
            "answer contains the truth, >= 2 % left", strong, contains_truth, ">= 0.95", lambda p: p >= 0.95
        ),
        share(
            "the same, >= 1 % left, inconclusive = 1/2",
            [case for case in known if case.left_pct >= LOWER_LEVEL_PCT],
            lambda case: 0.5 if case.verdict == INCONCLUSIVE else contains_truth(case),
            ">= 0.80",
            lambda p: p >= 0.8,
        ),
        share(
            "the same, >= 2 % left, shown by the discs",
            [case for case in strong if is_shown(case)],
            contains_truth,
        ),
    )


def _closure_rows(answered: Sequence[Judged]) -> tuple[Row, ...]:
    return (
        of_values(
            "closure by the first effect / by the true effect",
            [share for share in map(closure_share, answered) if share is not None],
            median,
            ">= 0.95",
            lambda value: value >= 0.95,
        ),
        share(
            "90 % interval contains the true closure",
            [case for case in answered if has_interval(case)],
            interval_holds,
            "0.85 - 0.95",
            lambda p: 0.85 <= p <= 0.95,
        ),
    )


def _axis_row(single: Sequence[Judged]) -> Row:
    noticed = [case for case in single if case.verdict != NONE and case.true_names[0] in AXES]
    return share("strongest axis is right", noticed, axis_is_right, ">= 0.90", lambda p: p >= 0.9)


def _confusion(judged: Sequence[Judged]) -> dict[str, dict[str, int]]:
    """The confusion matrix: the number of cases for each truth (row) and each answer (column).

    The column is the first effect of the answer; for a pair, it is a true effect, if the answer contains one. If the
    answer is empty, the column is the verdict.
    """
    table: dict[str, Counter[str]] = {}
    for case in judged:
        table.setdefault(true_label(case), Counter())[said_label(case)] += 1
    order = (
        "clean",
        *KNOWN,
        *UNKNOWN,
        *sorted(set(table) - {"pair"}),
        "pair",
    )  # a simulator may have other names
    return {name: dict(table[name]) for name in order if name in table}


def _power(judged: Sequence[Judged]) -> tuple[dict[str, Any], ...]:
    """For each bin of the residual left in the discs: how many effects were noticed, and how many known effects were named."""
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
    known = case.known
    return {
        "case": case.number,
        "kind": case.kind,
        "truth": list(case.true_names),
        "strength": [effect.get("strength") for effect in case.truth["effects"]],
        "left_before_refit_pct": case.truth.get("left_before_refit_pct"),
        "left_after_refit_pct": None if math.isnan(case.left_pct) else case.left_pct,
        "clean_left_pct": case.truth.get("clean_left_pct"),
        "shown_chi2": shown_chi2(case.truth),
        "verdict": case.verdict,
        "answer": list(case.answer),
        "first": case.first,
        "set": [list(member) for member in case.members],
        "noncentrality": None if known is None else known.noncentrality,
        "rival": None if known is None else known.rival,
        "ideal_alone": None if known is None else known.alone,
        "wall_s": case.wall_s,
    }


def table(found: Score) -> str:
    """The table as plain text."""
    lines = [f"{'figure':<58}{'n':>5}{'value':>9}  {'95 % (Wilson)':<16}{'goal':<13}met"]
    for row in found.rows:
        value = "-" if row.value is None else f"{row.value:.3f}"
        interval = "" if row.interval95 is None else f"{row.interval95[0]:.3f} - {row.interval95[1]:.3f}"
        met = {None: "", True: "yes", False: "NO"}[row.met]
        lines.append(f"{row.figure:<58}{row.cases:>5}{value:>9}  {interval:<16}{row.goal:<13}{met}")
    clean = found.rows[0]
    if clean.value == 0.0 and clean.cases:
        lines.append(
            f"no false alarm in {clean.cases} clean cases: the rate is below {min(3 / clean.cases, 1.0):.3f} (95 %)"
        )
    lines.append(f"{found.judged} cases judged, {len(found.failures)} failed")
    return "\n".join(
        [*lines, *(f"  {number:04d}: {why.splitlines()[-1]:.120}" for number, why in found.failures.items())]
    )
