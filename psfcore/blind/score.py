"""The score of a blind set: a table of figures that judge the diagnosis, the confusion matrix, and the power, with a picture.

Each row of the table (`figures`) has its own selection of cases. "Left" is the residual that the effects leave in the discs after
the refit of the PSF. The answer of a report is the set of effects that the verdict `attributed` or `tie` names. An effect is
"known" if the gap library contains it, otherwise "unknown". The conditions of the rows are functions of `scoring`, which also
explains "covers" and "right and alone". "Noncentrality" and "rival" are numbers of the ideal observer (`bounds.Known`): the chi2 of
the gap that remains in noise-free images after the PSF is refitted, and the distance of the nearest hypothesis that is not true.
Rows that need these numbers count only cases for which they were computed. In a row "/ ideal observer", the number of cases
that meet the condition is divided by the number expected of the ideal observer, the sum of `bounds.Known.alone`.

The interval of a fraction p of n cases is the Wilson interval:

    (p + z^2 / 2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)                             Eq. (1)
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import mean, median
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from psfcore.blind.case_set import BlindSet
from psfcore.blind.cases import CLEAN, FOREIGN, PAIR, SINGLE
from psfcore.blind.effects.registry import KNOWN, UNKNOWN
from psfcore.blind.run_set import judged_cases
from psfcore.blind.scoring import (
    AXES,
    INCONCLUSIVE,
    LOWER_LEVEL_PCT,
    NONE,
    NOTHING,
    UNKNOWN_VERDICT,
    Judged,
    axis_is_right,
    closure_share,
    contains_truth,
    has_interval,
    has_only_wrong_effects,
    interval_holds,
    is_right_and_alone,
    is_shown,
    names_one_wrong,
    raises_alarm,
    said_label,
    set_covers_truth,
    shown_chi2,
    true_label,
    verdict_is_right,
)
from psfcore.drawing.plots import INK, write_png

SCHEMA = "gap-blind/1"
LEVEL_PCT = 2.0
STRONG_PCT = 10.0
# A chi2: an effect with this noncentrality is found among eighteen effects with a probability of 0.99.
SEEN = 30.0
KIND_WORDS = {CLEAN: "clean", SINGLE: "one effect", PAIR: "two effects", FOREIGN: "not in the library"}
POWER_EDGES_PCT = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, math.inf)
Z95 = 1.959963984540054
_VERDICTS = (NONE, UNKNOWN_VERDICT, INCONCLUSIVE)
Holds = Callable[[Judged], float]  # 1 if a case meets a condition, 0 if not; 0.5 counts as half a case


def wilson(hits: float, cases: int, z: float = Z95) -> tuple[float, float]:
    """Eq. (1) for hits / cases; (0, 1) if there is no case."""
    if cases == 0:
        return 0.0, 1.0
    p, spread = hits / cases, z**2 / cases
    middle = (p + spread / 2) / (1 + spread)
    half = z * math.sqrt(p * (1 - p) / cases + spread / (4 * cases)) / (1 + spread)
    return max(0.0, middle - half), min(1.0, middle + half)


@dataclass(frozen=True)
class Goal:
    """The interval in which a figure should lie. digits: of the numbers in the text."""

    least: float | None = None
    most: float | None = None
    digits: int = 2

    def __str__(self) -> str:
        bounds = [f"{bound:.{self.digits}f}" for bound in (self.least, self.most) if bound is not None]
        sign = "" if len(bounds) != 1 else ">= " if self.least is not None else "<= "
        return sign + " - ".join(bounds)

    def met(self, value: float | None) -> bool | None:
        """Whether the value reaches the goal; None without a value or a goal."""
        if value is None or (self.least is None and self.most is None):
            return None
        return (self.least is None or value >= self.least) and (self.most is None or value <= self.most)


@dataclass(frozen=True)
class Row:
    """A row of the table. interval95: Eq. (1), if the value is a fraction of cases; otherwise None."""

    figure: str
    cases: int
    value: float | None
    interval95: tuple[float, float] | None
    goal: Goal

    @property
    def met(self) -> bool | None:
        """Whether the value reaches the goal; None if there is no goal or no case."""
        return self.goal.met(self.value)

    def to_json(self) -> dict[str, Any]:
        """The row as JSON."""
        return {
            "figure": self.figure,
            "n": self.cases,
            "value": self.value,
            "wilson95": None if self.interval95 is None else list(self.interval95),
            "goal": str(self.goal),
            "met": self.met,
        }


def share(
    figure: str,
    cases: Sequence[Judged],
    holds: Holds,
    least: float | None = None,
    most: float | None = None,
    *,
    expected: Callable[[Judged], float] = lambda case: 1.0,
) -> Row:
    """The row of a fraction: the number of cases that meet a condition, divided by the expected number.

    expected: the probability that an ideal observer meets the condition. The interval is Eq. (1) for the fraction of cases,
    divided by the mean of ``expected``, which is treated as exact.
    """
    possible = math.fsum(expected(case) for case in cases)
    if possible <= 0:
        return Row(figure, len(cases), None, None, Goal(least, most))
    hits, scale = math.fsum(holds(case) for case in cases), len(cases) / possible
    low, high = wilson(hits, len(cases))
    return Row(figure, len(cases), hits / possible, (low * scale, high * scale), Goal(least, most))


def of_values(
    figure: str, values: Sequence[float], of: Callable[[Sequence[float]], float], goal: Goal
) -> Row:
    """The row of one number. of: the function that computes this number from the values, for example their mean."""
    return Row(figure, len(values), float(of(values)) if values else None, None, goal)


def figures(judged: Sequence[Judged]) -> Iterator[Row]:
    """All rows of the table: first those that judge the answer, then those that judge the set of hypotheses."""
    clean, foreign = _of_kind(judged, CLEAN), _of_kind(judged, FOREIGN)
    known = _of_kind(judged, SINGLE, PAIR)
    strong = [case for case in known if case.left_pct >= LEVEL_PCT]
    single = _of_kind(strong, SINGLE)
    answered = [case for case in single if case.answer]
    yield share("false alarms on clean data", clean, raises_alarm, most=0.01)
    # These cases are also false alarms.
    yield share("inconclusive on clean data", clean, lambda case: case.verdict == INCONCLUSIVE)
    yield share("answer contains the truth, >= 2 % left", strong, contains_truth, 0.95)
    yield share(
        "the same, >= 1 % left, inconclusive = 1/2",
        [case for case in known if case.left_pct >= LOWER_LEVEL_PCT],
        lambda case: 0.5 if case.verdict == INCONCLUSIVE else contains_truth(case),
        0.80,
    )
    yield share(
        "the same, >= 2 % left, shown by the discs", [c for c in strong if is_shown(c)], contains_truth
    )
    yield share("first effect is the true one", single, lambda case: case.first == case.true_names[0], 0.85)
    yield share("one wrong effect named with confidence", judged, names_one_wrong, most=0.02)
    yield of_values(
        "mean number of named effects",
        [float(len(case.answer)) for case in strong if case.answer],
        mean,
        Goal(most=1.5, digits=1),
    )
    yield share(
        "unknown effects called unknown or inconclusive",
        [case for case in foreign if case.left_pct >= LEVEL_PCT],
        lambda case: case.verdict in (UNKNOWN_VERDICT, INCONCLUSIVE),
        0.80,
    )
    shares = [one for one in map(closure_share, answered) if one is not None]
    yield of_values("closure by the first effect / by the true effect", shares, median, Goal(0.95))
    yield share(
        "90 % interval contains the true closure",
        [case for case in answered if has_interval(case)],
        interval_holds,
        0.85,
        0.95,
    )
    noticed = [case for case in single if case.verdict != NONE and case.true_names[0] in AXES]
    yield share("strongest axis is right", noticed, axis_is_right, 0.90)
    yield from set_figures(judged)
    yield of_values(
        "time of the slowest case, s", [case.wall_s for case in judged], max, Goal(most=180, digits=0)
    )


def set_figures(judged: Sequence[Judged]) -> Iterator[Row]:
    """The rows that judge the set of hypotheses in reports."""
    clean, foreign = _of_kind(judged, CLEAN), _of_kind(judged, FOREIGN)
    seen = [case for case in judged if case.noncentrality >= SEEN]
    observed = [case for case in judged if case.known is not None]
    yield share("set covers the truth", judged, set_covers_truth, 0.86, 0.94)
    for kind, words in KIND_WORDS.items():
        yield share(f"the same, {words}", _of_kind(judged, kind), set_covers_truth, 0.80)
    for figure, some, most in (
        ("mean number of members of the set", judged, Goal(most=3, digits=0)),
        ("the same, noncentrality >= 30", seen, Goal(most=1.5, digits=1)),
    ):
        yield of_values(figure, [float(len(case.members)) for case in some], mean, most)
    without_clean = [case for case in observed if case.kind != CLEAN]
    for figure, some, right in (
        ("right and alone / ideal observer", observed, is_right_and_alone),
        ("the same, without clean data", without_clean, is_right_and_alone),
        ("right verdict / ideal observer", observed, verdict_is_right),
    ):
        yield share(figure, some, right, 0.85, expected=_ideal_alone)
    yield share("clean data: set without []", clean, lambda case: NOTHING not in case.members, most=0.01)
    yield share("one wrong effect alone in the set", judged, has_only_wrong_effects, most=0.02)
    yield share(
        "not in the library, noncentrality >= 30: unknown in set",
        [case for case in foreign if case.noncentrality >= SEEN],
        set_covers_truth,
        0.85,
    )
    far = [case for case in foreign if case.known is not None and (case.known.rival or 0.0) >= SEEN]
    yield share("the same, nearest rival >= 30", far, set_covers_truth)
    left = [case for case in judged if case.left_pct >= STRONG_PCT]
    yield share("set covers the truth, >= 10 % left", left, set_covers_truth, 0.95)


def _of_kind(judged: Sequence[Judged], *kinds: str) -> list[Judged]:
    return [case for case in judged if case.kind in kinds]


def _ideal_alone(case: Judged) -> float:
    return 0.0 if case.known is None else case.known.alone


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
        rows=tuple(figures(judged)),
        confusion=_confusion(judged),
        power=_power(judged),
        judged=len(judged),
        failures=dict(failures or {}),
        cases=tuple(_case(case) for case in judged),
    )


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
        lines.append(f"{row.figure:<58}{row.cases:>5}{value:>9}  {interval:<16}{row.goal!s:<13}{met}")
    clean = found.rows[0]
    if clean.value == 0.0 and clean.cases:
        lines.append(
            f"no false alarm in {clean.cases} clean cases: the rate is below {min(3 / clean.cases, 1.0):.3f} (95 %)"
        )
    lines.append(f"{found.judged} cases judged, {len(found.failures)} failed")
    return "\n".join(
        [*lines, *(f"  {number:04d}: {why.splitlines()[-1]:.120}" for number, why in found.failures.items())]
    )


def score_png(found: Score, path: str | Path) -> None:
    """Draw two panels: the truth against the first effect named, and the power with Wilson intervals. path: a PNG file."""
    figure = Figure(figsize=(17, 9.5), dpi=90, facecolor="white", layout="constrained")
    figure.suptitle(
        f"Blind set: {found.judged} cases judged, {len(found.failures)} failed",
        fontsize=13,
        color=INK,
        weight="bold",
        x=0.01,
        ha="left",
    )
    matrix, power = figure.subplots(1, 2, width_ratios=(1.9, 1))
    _draw_matrix(matrix, found)
    _draw_power(power, found)
    write_png(figure, path)


def _draw_matrix(axes: Axes, found: Score) -> None:
    rows = list(found.confusion)
    said = {name for row in found.confusion.values() for name in row}
    columns = [name for name in (*_VERDICTS, *KNOWN) if name in said or name in _VERDICTS or name in rows]
    columns += sorted(said - set(columns))
    counts = np.array([[found.confusion[row].get(column, 0) for column in columns] for row in rows])
    if not counts.size:
        axes.text(0.5, 0.5, "no case was judged", ha="center", transform=axes.transAxes)
        return
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(shares, cmap="Blues", vmin=0, vmax=1.3, aspect="auto")
    for (row, column), count in np.ndenumerate(counts):
        if count:
            axes.text(column, row, str(count), ha="center", va="center", fontsize=9, color=INK)
    for row, name in enumerate(rows):  # frame the correct columns of each row
        right = _right_columns(name)
        for column in (n for n, label in enumerate(columns) if label in right):
            corner = (column - 0.5, row - 0.5)
            axes.add_patch(_frame(corner))
    axes.set_xticks(range(len(columns)), columns, rotation=60, ha="right", fontsize=9)
    axes.set_yticks(
        range(len(rows)), [f"{name} *" if _is_foreign(name) else name for name in rows], fontsize=9
    )
    axes.set(
        xlabel="first effect named, or verdict",
        ylabel="truth (* not in the library)",
        title="Number of cases; frames mark correct verdicts",
    )


def _right_columns(truth: str) -> tuple[str, ...]:
    if truth == "clean":
        return (NONE,)
    return (UNKNOWN_VERDICT, INCONCLUSIVE) if _is_foreign(truth) else (truth,)


def _is_foreign(truth: str) -> bool:
    """Whether a row is of an effect that is not in the library; a simulator may have effects with any names."""
    return truth not in (*KNOWN, CLEAN, PAIR)


def _frame(corner: tuple[float, float]) -> Rectangle:
    return Rectangle(corner, 1, 1, fill=False, edgecolor="#c73e2b", linewidth=1.2, clip_on=False)


def _draw_power(axes: Axes, found: Score) -> None:
    labels = []
    for bin_of in found.power:
        low, high = bin_of["left_after_refit_pct"]
        labels.append(f"{low:g} -\n{high:g}" if high is not None else f"> {low:g}")
    at = np.arange(len(labels))
    for offset, count, hits, interval, colour, name in (
        (-0.08, "n", "noticed", "noticed_wilson95", "#1b4f91", "noticed (the verdict is not “none”)"),
        (
            0.08,
            "n_known",
            "contains_truth",
            "contains_wilson95",
            "#2b8a6e",
            "the named effects include the true ones",
        ),
    ):
        shown = [n for n, row in enumerate(found.power) if row[count]]
        share = np.array([found.power[n][hits] / found.power[n][count] for n in shown])
        ends = np.array([found.power[n][interval] for n in shown]).reshape(-1, 2)
        errors = np.abs(np.stack([share - ends[:, 0], ends[:, 1] - share])) if shown else None
        axes.errorbar(at[shown] + offset, share, yerr=errors, fmt="o-", color=colour, capsize=3, label=name)
        for n, value in zip(shown, share, strict=True):
            axes.annotate(
                f"{found.power[n][hits]}/{found.power[n][count]}",
                (n + offset, value),
                textcoords="offset points",
                xytext=(-24 if offset < 0 else 6, 6),
                fontsize=8,
                color=colour,
            )
    axes.set_xticks(at, labels)
    axes.set(
        xlabel="residual left in the discs after the refit (%, rms over images)",
        ylabel="fraction of cases, with 95 % Wilson interval",
        ylim=(-0.03, 1.08),
    )
    axes.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.03), ncols=2)
    axes.grid(color="#dddddd", linewidth=0.7)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def write_score(made: BlindSet, numbers: Sequence[int], not_made: Mapping[int, str]) -> str:
    """Open the seals of a diagnosed set, compare reports and truths, and write score.json, score.txt and score.png into its folder.

    numbers: the cases to score. not_made: the reason for each case that could not be made. Returns the table as text.
    """
    judged, failures = judged_cases(made, numbers)
    found = score(judged, dict(not_made) | failures)
    text = table(found)
    (made.folder / "score.json").write_text(json.dumps(found.to_json(), indent=1, allow_nan=False), "utf-8")
    (made.folder / "score.txt").write_text(text + "\n", "utf-8")
    score_png(found, made.folder / "score.png")
    return text
