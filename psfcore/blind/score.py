"""The score of a blind set: a table of figures that judge the diagnosis, as JSON, as text and as a picture.

The rows judge cases without an effect, and true causes by their class (`judged`). A cause without a bound has no
class. In a row "/ bound", the number of causes for which the report is right is divided by the number expected of a
Bayes observer: the sum of the probabilities in the bounds. The table of levels has the same shares without the
division.

    (p + z^2 / 2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)                             Eq. (1)

Eq. (1) is the Wilson interval of a fraction p of n cases.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import mean, median
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from psfcore.blind.case_set import BlindSet
from psfcore.blind.cases import CLEAN, MIXED
from psfcore.blind.effects.effect import EFFECTS, STAGES
from psfcore.blind.effects.registry import KNOWN
from psfcore.blind.judged import CLASSES, FAMILY, ISOLABLE, LEVELS, NAME, NONE, OPEN, STAGE, Cause, Judged
from psfcore.blind.run_set import BOUND_SCHEMA, REPORT_SCHEMA, result_in, run_of
from psfcore.drawing.plots import INK, write_png

SCHEMA = "gap-blind/2"
STRONG_PCT = 10.0  # residual that a strong effect leaves in the discs
NEAR = 0.15  # distance of the peak of a map from the true peak, in units of half the field
SLOWEST_S = 180.0
POWER_EDGES = (0.0, 10.0, 30.0, 60.0, 100.0, 300.0, math.inf)  # noncentralities
Z95 = 1.959963984540054

_DETECTOR = ("detector_x", "detector_y")
# The axes along which each effect varies. `saturation_fill` has no entry: it depends on exposure and on the Sun's
# brightness.
AXES: dict[str, tuple[str, ...]] = {
    "dark_offset": ("exposure", "intensity"),
    "nonlinearity": ("intensity",),
    "gain_mismatch": ("gain_mode", "exposure"),
    **dict.fromkeys(("intensity_gradient", "flat_field_residual", "field_dependent_scatter"), _DETECTOR),
    **dict.fromkeys(("column_smear", "ghost"), (*_DETECTOR, "intensity")),
    **dict.fromkeys(("persistence", "scene_evolution"), ("time", "pointing")),
    **dict.fromkeys(("anisotropic_scatter", "mesh_rotation"), ("azimuth_in_disc", *_DETECTOR)),
    **dict.fromkeys(("wide_halo", "out_of_field_light"), ("scattering_distance", "pointing", "intensity")),
    **dict.fromkeys(("core_blur", "mesh_pitch", "occulter_motion"), ("radius_in_disc", "azimuth_in_disc")),
}
# Effects whose strength has the same meaning as a parameter of the library: this parameter, and its value for the
# strength 1.
COMPARABLE = {
    "dark_offset": ("offset", 1.0),
    "intensity_gradient": ("level", 1.0),
    "gain_mismatch": ("excess", 1.0),
    "ghost": ("share", 1.0),
    "wide_halo": ("share", 1.0),
    "mesh_rotation": ("angle", 1.0),
}

Row = dict[str, Any]


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
    cases: int,
    value: float | None,
    least: float | None = None,
    most: float | None = None,
    interval: Sequence[float] | None = None,
) -> Row:
    """A row of the table, as JSON. least, most: the goal. interval: Eq. (1), if the value is a fraction of cases."""
    bounds = [f"{bound:.3g}" for bound in (least, most) if bound is not None]
    sign = "" if len(bounds) != 1 else "<= " if least is None else ">= "
    within = value is not None and (least is None or value >= least) and (most is None or value <= most)
    return {
        "figure": figure,
        "n": cases,
        "value": value,
        "wilson95": None if interval is None else list(interval),
        "goal": sign + " - ".join(bounds),
        "met": within if bounds and value is not None else None,
    }


def share(
    figure: str,
    hits: Sequence[bool],
    least: float | None = None,
    most: float | None = None,
    *,
    expected: Sequence[float] | None = None,
) -> Row:
    """The row of a fraction: the number of cases that meet a condition, divided by the expected number.

    hits: whether each case meets the condition. expected: the probability that a Bayes observer meets it; None: 1. The
    interval is Eq. (1) for the fraction of cases, divided by the mean of ``expected``, which is treated as exact.
    """
    possible = len(hits) if expected is None else math.fsum(expected)
    if possible <= 0:
        return row(figure, len(hits), None, least, most)
    scale = len(hits) / possible
    interval = [end * scale for end in wilson(sum(hits), len(hits))]
    return row(figure, len(hits), sum(hits) / possible, least, most, interval)


def of_values(
    figure: str,
    values: Sequence[float],
    of: Callable[[Sequence[float]], float],
    least: float | None = None,
    most: float | None = None,
) -> Row:
    """The row of one number. of: the function that computes this number from the values, for example their mean."""
    return row(figure, len(values), float(of(values)) if values else None, least, most)


def rows(judged: Sequence[Judged]) -> list[Row]:
    """All rows of the table."""
    causes = _causes(judged)
    hidden, open_, isolable = ([cause for cause in causes if cause.visibility == one] for one in CLASSES)
    known, withheld = ([cause for cause in isolable if cause.is_known is one] for one in (True, False))
    both = [case for case in judged if case.truth["kind"] == MIXED and set(case.causes) <= set(isolable)]
    strong = [cause for cause in causes if cause.effect["left_alone_pct"] >= STRONG_PCT]
    sizes = [len(cause.answer["alternatives"]) for cause in open_ if cause.answer is not None]
    limits = [below for cause in hidden + open_ if (below := is_below_limit(cause)) is not None]
    maps = [cause.map for cause in causes if cause.map is not None]
    closures = [cause.closure for cause in causes if cause.closure is not None]
    axes = [cause for cause in open_ + isolable if cause.is_only and cause.name in AXES]
    return [
        share(
            "false alarms on clean data", [bool(one.entries) for one in judged if not one.causes], most=1 / 60
        ),
        share("hidden: no cause is claimed", [not one.case.entries for one in hidden if one.is_only], 0.95),
        share("hidden or open: strength below excluded_95", limits, 0.95),
        share("open: an entry covers the cause", [one.cover is not None for one in open_], 0.9),
        of_values("open: mean number of alternatives", sizes, mean, most=2.5),
        _over_bound("isolable, known: named and alone / bound", known, NAME, 0.75),
        share("isolable, known: named and alone", _right(known, NAME), 0.75),
        _over_bound("isolable, withheld: right family / bound", withheld, FAMILY, 0.7),
        _over_bound("isolable, withheld: right stage / bound", withheld, STAGE, 0.8),
        share("isolable, known beside withheld: both told", [case.tells_both for case in both], 0.6),
        share("wrong effect alone", [one.number < one.case.wrong_alone for one in causes], most=0.05),
        share("10 % left: an entry covers the cause", [one.cover is not None for one in strong], 0.8),
        share("map of light: peak within 0.15", [distance <= NEAR for distance, _ in maps], 0.9),
        of_values("map of light: correlation, median", [correlation for _, correlation in maps], median, 0.8),
        share(
            "90 % interval contains the true closure",
            [low <= true <= high for _, low, high, true in closures],
            0.85,
            0.95,
        ),
        of_values("closure / true closure, median", [one[0] / one[3] for one in closures], median, 0.95),
        share("strongest axis is right", [one.case.strongest_axis in AXES[one.name] for one in axes], 0.9),
        of_values("time of the slowest case, s", [case.wall_s for case in judged], max, most=SLOWEST_S),
    ]


def is_below_limit(cause: Cause) -> bool | None:
    """Whether the true strength is at most the excluded_95 of the report; None if the two cannot be compared."""
    parameter, factor = COMPARABLE.get(cause.name, ("", 1.0))
    limits = cause.case.report.get("limits", {}).get(cause.name, {})
    own = limits if limits.get("parameter") == parameter else limits.get("parameters", {}).get(parameter, {})
    excluded = own.get("excluded_95")
    return None if excluded is None else bool(abs(factor * cause.effect["strength"]) <= excluded)


def _causes(judged: Sequence[Judged]) -> list[Cause]:
    return [cause for case in judged for cause in case.causes]


def _right(causes: Sequence[Cause], level: str) -> list[bool]:
    return [bool(cause.right_entries(level)) for cause in causes]


def _bounds(causes: Sequence[Cause], level: str) -> list[float]:
    return [cause.bound[level] for cause in causes if cause.bound is not None]


def _over_bound(figure: str, causes: Sequence[Cause], level: str, least: float) -> Row:
    return share(figure, _right(causes, level), least, expected=_bounds(causes, level))


def score(judged: Sequence[Judged], failures: Mapping[int, str] | None = None) -> dict[str, Any]:
    """The score of the cases that have a report, as JSON (gap-blind/2).

    failures: the reasons why the other cases have no report, by number.
    """
    causes = _causes(judged)
    return {
        "schema": SCHEMA,
        "judged": len(judged),
        "failures": {f"{number:04d}": why for number, why in (failures or {}).items()},
        "rows": rows(judged),
        "levels": [
            {"class": one, **_levels([cause for cause in causes if cause.visibility == one])}
            for one in (OPEN, ISOLABLE)
        ],
        "confusion": _confusion(judged),
        "power": [
            {
                "noncentrality": [low, None if math.isinf(high) else high],
                **_levels([one for one in causes if one.bound and low <= one.bound["noncentrality"] < high]),
            }
            for low, high in pairwise(POWER_EDGES)
        ],
        "cases": [_case(case) for case in judged],
    }


def _levels(causes: Sequence[Cause]) -> dict[str, Any]:
    """The number of causes; for each level, how many are right, the Wilson interval of this share, and the mean
    bound."""
    told: dict[str, Any] = {"n": len(causes)}
    for level in LEVELS:
        right, bounds = sum(_right(causes, level)), _bounds(causes, level)
        told[level] = {
            "right": right,
            "wilson95": list(wilson(right, len(causes))),
            "bound": mean(bounds) if bounds else None,
        }
    return told


def _confusion(judged: Sequence[Judged]) -> dict[str, dict[str, int]]:
    """The confusion matrix: the number of causes for each true effect (row) and each answer (column).

    The column is an alternative of the entry that covers the cause, else of the first entry: the first right one,
    else the first. It is an effect, or "other" and a family. If the report has no entry, the column is the verdict.
    """
    counts: dict[str, Counter[str]] = {}
    for case in judged:
        for cause in case.causes or (None,):
            entry = cause.answer if cause else next(iter(case.entries), None)
            said = list(entry["alternatives"]) if entry else []
            right = [
                one for one in said if cause and (cause.matches(one, NAME) or cause.matches(one, FAMILY))
            ]
            column = next(
                (one["effect"] or f"other {one['family']}" for one in right + said), case.report["verdict"]
            )
            counts.setdefault(cause.name if cause else CLEAN, Counter())[column] += 1
    return {name: dict(counts[name]) for name in (CLEAN, *EFFECTS) if name in counts}


def _case(case: Judged) -> dict[str, Any]:
    """The entry of one case in score.json."""
    return {
        "case": case.number,
        "kind": case.truth["kind"],
        "verdict": case.report["verdict"],
        "entries": [
            {key: entry[key] for key in ("level", "words", "alternatives")} for entry in case.entries
        ],
        "wrong_alone": case.wrong_alone,
        "wall_s": case.wall_s,
        "causes": [
            {
                **{key: cause.effect[key] for key in ("name", "families", "strength", "left_alone_pct")},
                "class": cause.visibility,
                "bound": cause.bound,
                "covered": cause.cover is not None,
                "right": {level: bool(cause.right_entries(level)) for level in LEVELS},
                "map": cause.map,
                "closure": cause.closure,
            }
            for cause in case.causes
        ],
    }


def table(found: Mapping[str, Any]) -> str:
    """The tables of a score as plain text."""
    lines = [f"{'figure':<50}{'n':>5}{'value':>9}  {'95 % (Wilson)':<16}{'goal':<13}met"]
    for one in found["rows"]:
        value = "-" if one["value"] is None else f"{one['value']:.3f}"
        interval = " - ".join(f"{end:.3f}" for end in one["wilson95"] or ())
        met = {None: "", True: "yes", False: "NO"}[one["met"]]
        lines.append(f"{one['figure']:<50}{one['n']:>5}{value:>9}  {interval:<16}{one['goal']:<13}{met}")
    lines.append(f"{'right at the level (bound)':<50}{'n':>5}" + "".join(f"{level:>16}" for level in LEVELS))
    for one in found["levels"]:
        shares = (
            f"{one[level]['right'] / one['n']:.2f} ({one[level]['bound']:.2f})"
            for level in LEVELS
            if one["n"]
        )
        lines.append(f"{one['class']:<50}{one['n']:>5}" + "".join(f"{text:>16}" for text in shares))
    lines.append(f"{found['judged']} cases judged, {len(found['failures'])} failed")
    lines += [f"  {number}: {why.splitlines()[-1]:.120}" for number, why in found["failures"].items()]
    return "\n".join(lines)


def judged_cases(made: BlindSet, numbers: Sequence[int]) -> tuple[list[Judged], dict[int, str]]:
    """Two results: the cases that have a report; the reasons why the other cases have none, by number.

    Each truth is read, and its seal is checked. Raises DataError "broken-seal", "bad-seals".
    """
    judged, failures = [], {}
    for number in numbers:
        truth, run = made.truth(number), run_of(made, number)
        report = result_in(made.report(number), REPORT_SCHEMA)
        if report is None:
            failures[number] = (run.error if run else "") or "no complete report"
        else:
            bound = result_in(made.bound(number), BOUND_SCHEMA)
            judged.append(Judged(number, truth, report, run.wall_s if run else 0.0, bound))
    return judged, failures


def write_score(made: BlindSet, numbers: Sequence[int], not_made: Mapping[int, str]) -> str:
    """Open the seals of a diagnosed set, compare reports and truths, and write score.json, score.txt and score.png
    into its folder.

    numbers: the cases to score. not_made: the reason for each case that could not be made. Returns the tables as text.
    """
    judged, failures = judged_cases(made, numbers)
    found = score(judged, dict(not_made) | failures)
    text = table(found)
    (made.folder / "score.json").write_text(json.dumps(found, indent=1, allow_nan=False), "utf-8")
    (made.folder / "score.txt").write_text(text + "\n", "utf-8")
    score_png(found, made.folder / "score.png")
    return text


# --- the picture ------------------------------------------------------------------------------------------


def score_png(found: Mapping[str, Any], path: str | Path) -> None:
    """Draw two panels: the truth against the answer, and the share of right answers against the noncentrality.

    found: a score (gap-blind/2). path: a PNG file.
    """
    figure = Figure(figsize=(17, 9.5), dpi=90, facecolor="white", layout="constrained")
    title = f"Blind set: {found['judged']} cases judged, {len(found['failures'])} failed"
    figure.suptitle(title, fontsize=13, color=INK, weight="bold", x=0.01, ha="left")
    matrix, power = figure.subplots(1, 2, width_ratios=(1.9, 1))
    _draw_matrix(matrix, found["confusion"])
    _draw_power(power, found["power"])
    write_png(figure, path)


def _draw_matrix(axes: Axes, confusion: dict[str, dict[str, int]]) -> None:
    names, said = list(confusion), {name for answers in confusion.values() for name in answers}
    columns = [name for name in (*KNOWN, *(f"other {family}" for family in STAGES)) if name in said]
    columns = sorted(said - set(columns)) + columns
    counts = np.array([[confusion[name].get(column, 0) for column in columns] for name in names])
    if not counts.size:
        axes.text(0.5, 0.5, "no case was judged", ha="center", transform=axes.transAxes)
        return
    axes.imshow(counts / counts.sum(axis=1, keepdims=True), cmap="Blues", vmin=0, vmax=1.3, aspect="auto")
    for (at, column), count in np.ndenumerate(counts):
        kind = EFFECTS.get(names[at])
        right = (
            {NONE}
            if kind is None
            else {kind.name, kind.form_of, *(f"other {family}" for family in kind.families)}
        )
        if count:
            axes.text(column, at, str(count), ha="center", va="center", fontsize=9, color=INK)
        if columns[column] in right:
            axes.add_patch(Rectangle((column - 0.5, at - 0.5), 1, 1, fill=False, edgecolor="#c73e2b"))
    axes.set_xticks(range(len(columns)), columns, rotation=60, ha="right", fontsize=9)
    labels = [name if name in (*KNOWN, CLEAN) else f"{name} *" for name in names]
    axes.set_yticks(range(len(names)), labels, fontsize=9)
    axes.set(
        xlabel="effect or family that the report states, or its verdict",
        ylabel="true cause (* not in the library)",
        title="Number of causes; frames mark right answers",
    )


def _draw_power(axes: Axes, power: list[dict[str, Any]]) -> None:
    bins = [(at, one) for at, one in enumerate(power) if one["n"]]
    ats = np.array([at for at, _ in bins])
    for shift, level, colour in zip((-0.1, 0.0, 0.1), LEVELS, ("#1b4f91", "#2b8a6e", "#c73e2b"), strict=True):
        shares = np.array([one[level]["right"] / one["n"] for _, one in bins])
        ends = np.array([one[level]["wilson95"] for _, one in bins]).reshape(-1, 2).T
        errors = np.abs(ends - shares)
        axes.errorbar(ats + shift, shares, yerr=errors, fmt="o", color=colour, capsize=3, label=level)
        axes.plot(ats + shift, [one[level]["bound"] for _, one in bins], "--", color=colour)
    edges = ((*one["noncentrality"], one["n"]) for one in power)
    labels = [f"{low:g} -\n{'' if high is None else f'{high:g}'}\nn = {n}" for low, high, n in edges]
    axes.set_xticks(range(len(labels)), labels)
    axes.set(
        xlabel="noncentrality of the cause",
        ylabel="share of causes for which the answer is right (dashed: the bound)",
        ylim=(-0.03, 1.08),
    )
    axes.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.03), ncols=3)
    axes.grid(color="#dddddd", linewidth=0.7)
    axes.spines[["top", "right"]].set_visible(False)
