"""The score of a blind set: a table of figures that judge the diagnosis, as JSON, as text and as a picture.

**Selections.** "Left" is the residual that the effects leave in the discs after the refit of the PSF. "Noncentrality" and
"rival" are numbers of the ideal observer (`bounds.Known`): the chi2 of the gap that remains in noise-free images after the
PSF is refitted, and the distance of the nearest hypothesis that is not true. Rows that need these numbers count only cases
for which they were computed. For the two effects of a mixed case, the noncentrality of each is the chi2 that it alone
leaves in the means of the discs (`left_alone_chi2`). In a row "/ ideal observer", the number of cases that meet the
condition is divided by the number expected of the ideal observer, the sum of `bounds.Known.alone`.

    (p + z^2 / 2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)                             Eq. (1)

Eq. (1) is the Wilson interval of a fraction p of n cases.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import mean, median
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from psfcore.blind.case_set import BlindSet
from psfcore.blind.cases import CLEAN, FOREIGN, MIXED, PAIR, SINGLE
from psfcore.blind.effects.registry import KNOWN, UNKNOWN
from psfcore.blind.judged import ATTRIBUTED, INCONCLUSIVE, LOWER_LEVEL_PCT, NO_GAP, NONE, OTHER, Judged
from psfcore.blind.run_set import IDEAL_SCHEMA, REPORT_SCHEMA, result_in, run_of
from psfcore.drawing.plots import INK, write_png

SCHEMA = "gap-blind/1"
LEVEL_PCT, STRONG_PCT = 2.0, 10.0
# A chi2: an effect with this noncentrality is found among eighteen effects with a probability of 0.99.
SEEN = 30.0
NEAR = 0.15  # distance of the peak of a map from the true peak, in units of half the field
POWER_EDGES_PCT = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, math.inf)
Z95 = 1.959963984540054
KIND_WORDS = {
    CLEAN: "clean",
    SINGLE: "one effect",
    PAIR: "two effects",
    FOREIGN: "not in the library",
    MIXED: "known and withheld effect",
}

_DETECTOR = ("detector_x", "detector_y")
# The axes along which each effect varies. `saturation_fill` has no entry: it depends on exposure and on the Sun's brightness.
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

Row = dict[str, Any]
Holds = Callable[[Judged], float | None]  # 1 if a case meets a condition, 0 if not; 0.5 counts as half a case


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
    interval: Sequence[float] | None,
    least: float | None = None,
    most: float | None = None,
) -> Row:
    """A row of the table, as JSON. interval: Eq. (1), if the value is a fraction of cases. least, most: the goal."""
    bounds = [f"{bound:g}" for bound in (least, most) if bound is not None]
    sign = "" if len(bounds) != 1 else "<= " if least is None else ">= "
    met = None
    if value is not None and bounds:
        met = (least is None or value >= least) and (most is None or value <= most)
    return {
        "figure": figure,
        "n": cases,
        "value": value,
        "wilson95": None if interval is None else list(interval),
        "goal": sign + " - ".join(bounds),
        "met": met,
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
        return row(figure, len(cases), None, None, least, most)
    hits, scale = math.fsum(holds(case) or 0.0 for case in cases), len(cases) / possible
    interval = [end * scale for end in wilson(hits, len(cases))]
    return row(figure, len(cases), hits / possible, interval, least, most)


def of_values(
    figure: str,
    values: Sequence[float],
    of: Callable[[Sequence[float]], float],
    least: float | None = None,
    most: float | None = None,
) -> Row:
    """The row of one number. of: the function that computes this number from the values, for example their mean."""
    return row(figure, len(values), float(of(values)) if values else None, None, least, most)


def figures(judged: Sequence[Judged]) -> Iterator[Row]:
    """All rows of the table: first those that judge the answer, then those that judge the set of hypotheses."""
    clean, foreign = _of_kind(judged, CLEAN), _of_kind(judged, FOREIGN)
    library = _of_kind(judged, SINGLE, PAIR)
    strong = _left(library, LEVEL_PCT)
    single = _of_kind(strong, SINGLE)
    answered = [case for case in single if case.answer]
    yield share("false alarms on clean data", clean, Judged.raises_alarm, most=0.01)
    yield share("answer contains the truth, >= 2 % left", strong, Judged.contains_truth, 0.95)
    yield share(
        "the same, >= 1 % left, inconclusive = 1/2",
        _left(library, LOWER_LEVEL_PCT),
        lambda case: 0.5 if case.verdict == INCONCLUSIVE else case.contains_truth(),
        0.8,
    )
    yield share("first effect is the true one", single, lambda case: case.first == case.true_names[0], 0.85)
    yield share(
        "one wrong effect named with confidence",
        judged,
        lambda case: (
            case.verdict == ATTRIBUTED and len(case.answer) == 1 and case.answer[0] not in case.true_names
        ),
        most=0.02,
    )
    named = [float(len(case.answer)) for case in strong if case.answer]
    yield of_values("mean number of named effects", named, mean, most=1.5)
    yield share(
        "unknown effects called unknown or inconclusive",
        _left(foreign, LEVEL_PCT),
        lambda case: case.verdict in (OTHER, INCONCLUSIVE),
        0.8,
    )
    shares = [one for one in map(Judged.closure_share, answered) if one is not None]
    yield of_values("closure by the first effect / by the true effect", shares, median, 0.95)
    stated = [case for case in answered if case.interval_holds() is not None]
    yield share("90 % interval contains the true closure", stated, Judged.interval_holds, 0.85, 0.95)
    noticed = [case for case in single if case.verdict != NONE and case.true_names[0] in AXES]
    yield share(
        "strongest axis is right",
        noticed,
        lambda case: case.strongest_axis in AXES[case.true_names[0]],
        0.93,
    )
    yield from set_figures(judged)
    yield of_values("time of the slowest case, s", [case.wall_s for case in judged], max, most=180)


def set_figures(judged: Sequence[Judged]) -> Iterator[Row]:
    """The rows that judge the set of hypotheses in reports, and what reports state about an unknown cause."""
    clean, foreign = _of_kind(judged, CLEAN), _of_kind(judged, FOREIGN)
    seen = [case for case in judged if case.noncentrality >= SEEN]
    observed = [case for case in judged if case.known is not None]
    yield share("set covers the truth", judged, Judged.set_covers_truth, 0.87, 0.93)
    for kind, words in KIND_WORDS.items():
        yield share(f"the same, {words}", _of_kind(judged, kind), Judged.set_covers_truth, 0.85)
    for figure, some, most in (
        ("mean number of members of the set", judged, 2.2),
        ("the same, noncentrality >= 30", seen, 1.4),
    ):
        yield of_values(figure, [float(len(case.members)) for case in some], mean, most=most)
    without_clean = [case for case in observed if case.kind != CLEAN]
    for figure, some, right in (
        ("right and alone / ideal observer", observed, Judged.is_right_and_alone),
        ("the same, without clean data", without_clean, Judged.is_right_and_alone),
        ("right verdict / ideal observer", observed, Judged.verdict_is_right),
    ):
        yield share(figure, some, right, 0.6, expected=lambda case: case.known.alone if case.known else 0.0)
    yield share("clean data: set without []", clean, lambda case: NO_GAP not in case.members, most=0.01)
    yield share(
        "one wrong effect alone in the set",
        judged,
        lambda case: len(case.members) == 1 and case.has_only_wrong_effects(),
        most=0.02,
    )
    yield share("only wrong effects in the set", judged, Judged.has_only_wrong_effects, most=0.015)
    yield share(
        "only wrong effects in the set, not in the library", foreign, Judged.has_only_wrong_effects, most=0.02
    )
    known_seen = _of_kind(seen, SINGLE, PAIR)
    yield share("known, noncentrality >= 30: named and alone", known_seen, Judged.is_right_and_alone, 0.85)
    foreign_seen = _of_kind(seen, FOREIGN)
    yield share(
        "not in the library, noncentrality >= 30: unknown in set", foreign_seen, Judged.says_unknown, 0.9
    )
    staged = [case for case in foreign_seen if case.stages]
    yield share("the same, its stage is right", staged, lambda case: case.stage_is_right, 0.8)
    far = [case for case in foreign if case.known is not None and (case.known.rival or 0.0) >= SEEN]
    yield share("the same, nearest rival >= 30", far, Judged.says_unknown)
    mixed = [
        case
        for case in _of_kind(judged, MIXED)
        if case.stages and all(e.get("left_alone_chi2", 0.0) >= SEEN for e in case.truth["effects"])
    ]
    yield share("known and withheld, each >= 30: both told", mixed, Judged.tells_both, 0.6)
    mapped = [case for case in seen if case.map is not None]
    yield share("map of light: peak within 0.15", mapped, lambda case: (case.map or (9.0,))[0] <= NEAR, 0.9)
    correlations = [case.map[1] for case in mapped if case.map is not None]
    yield of_values("map of light: correlation, median", correlations, median, 0.8)
    yield share(
        "set covers the truth, >= 10 % left", _left(judged, STRONG_PCT), Judged.set_covers_truth, 0.95
    )


def _of_kind(judged: Sequence[Judged], *kinds: str) -> list[Judged]:
    return [case for case in judged if case.kind in kinds]


def _left(judged: Sequence[Judged], least_pct: float) -> list[Judged]:
    return [case for case in judged if case.left_pct >= least_pct]


def score(judged: Sequence[Judged], failures: Mapping[int, str] | None = None) -> dict[str, Any]:
    """The score of the cases that have a report, as JSON (gap-blind/1).

    failures: the reasons why the other cases have no report, by number.
    """
    return {
        "schema": SCHEMA,
        "judged": len(judged),
        "failures": {f"{number:04d}": why for number, why in (failures or {}).items()},
        "rows": list(figures(judged)),
        "confusion": _confusion(judged),
        "power": _power(judged),
        "cases": [_case(case) for case in judged],
    }


def _confusion(judged: Sequence[Judged]) -> dict[str, dict[str, int]]:
    """The confusion matrix: the number of cases for each truth (row) and each answer (column).

    The column is the first effect of the answer; for two effects, it is a true effect, if the answer contains one. If
    the answer is empty, the column is the verdict.
    """
    counts: dict[str, Counter[str]] = {}
    for case in judged:
        true = case.true_names[0] if case.kind in (SINGLE, FOREIGN) else case.kind
        said = case.verdict
        if case.answer:
            best = case.first if case.first in case.answer else case.answer[0]
            right = (name for name in case.answer if name in case.true_names)
            said = next(right, best) if len(case.true_names) > 1 else best
        counts.setdefault(true, Counter())[said] += 1
    # A simulator of a user may have other names.
    order = (CLEAN, *KNOWN, *UNKNOWN, *sorted(set(counts) - {PAIR, MIXED}), PAIR, MIXED)
    return {name: dict(counts[name]) for name in order if name in counts}


def _power(judged: Sequence[Judged]) -> list[dict[str, Any]]:
    """For each bin of the residual left in the discs: how many effects were noticed, and how many known effects were named."""
    found = []
    for low, high in pairwise(POWER_EDGES_PCT):
        here = [case for case in judged if case.kind != CLEAN and low <= case.left_pct < high]
        library = _of_kind(here, SINGLE, PAIR)
        noticed, named = sum(map(Judged.raises_alarm, here)), sum(map(Judged.contains_truth, library))
        found.append(
            {
                "left_after_refit_pct": [low, None if math.isinf(high) else high],
                "n": len(here),
                "noticed": noticed,
                "noticed_wilson95": list(wilson(noticed, len(here))),
                "n_known": len(library),
                "contains_truth": named,
                "contains_wilson95": list(wilson(named, len(library))),
            }
        )
    return found


def _case(case: Judged) -> dict[str, Any]:
    """The entry of one case in score.json."""
    known, effects = case.known, case.truth["effects"]
    return {
        "case": case.number,
        "kind": case.kind,
        "truth": list(case.true_names),
        "stages": sorted(case.stages),
        "strength": [effect.get("strength") for effect in effects],
        "left_alone_pct": [effect.get("left_alone_pct") for effect in effects],
        "left_alone_chi2": [effect.get("left_alone_chi2") for effect in effects],
        "left_before_refit_pct": case.truth.get("left_before_refit_pct"),
        "left_after_refit_pct": None if math.isnan(case.left_pct) else case.left_pct,
        "clean_left_pct": case.truth.get("clean_left_pct"),
        "verdict": case.verdict,
        "answer": list(case.answer),
        "first": case.first,
        "set": [list(member) for member in case.members],
        "covered": case.set_covers_truth(),
        "unknown": {key: case.unknown.get(key) for key in ("stage", "form", "width", "probability")},
        "map": None if case.map is None else dict(zip(("distance", "correlation"), case.map, strict=True)),
        "noncentrality": None if known is None else known.noncentrality,
        "rival": None if known is None else known.rival,
        "ideal_alone": None if known is None else known.alone,
        "wall_s": case.wall_s,
    }


def table(found: Mapping[str, Any]) -> str:
    """The table of a score as plain text."""
    lines = [f"{'figure':<58}{'n':>5}{'value':>9}  {'95 % (Wilson)':<16}{'goal':<13}met"]
    for one in found["rows"]:
        value = "-" if one["value"] is None else f"{one['value']:.3f}"
        interval = " - ".join(f"{end:.3f}" for end in one["wilson95"] or ())
        met = {None: "", True: "yes", False: "NO"}[one["met"]]
        lines.append(f"{one['figure']:<58}{one['n']:>5}{value:>9}  {interval:<16}{one['goal']:<13}{met}")
    clean = found["rows"][0]
    if clean["value"] == 0.0:
        rate = min(3 / clean["n"], 1.0)
        lines.append(f"no false alarm in {clean['n']} clean cases: the rate is below {rate:.3f} (95 %)")
    lines.append(f"{found['judged']} cases judged, {len(found['failures'])} failed")
    failures = found["failures"].items()
    return "\n".join([*lines, *(f"  {number}: {why.splitlines()[-1]:.120}" for number, why in failures)])


def judged_cases(made: BlindSet, numbers: Sequence[int]) -> tuple[list[Judged], dict[int, str]]:
    """Two results: the cases that have a report; the reasons why the other cases have none, by number.

    Each truth is read, and its seal is checked. Raises DataError "broken-seal", "bad-seals".
    """
    judged, failures = [], {}
    for number in numbers:
        truth, run = made.truth(number), run_of(made, number)
        report = result_in(made.report(number), REPORT_SCHEMA)
        if report is None:
            failures[number] = run.error if run is not None and run.failed else "no complete report"
        else:
            ideal = result_in(made.ideal(number), IDEAL_SCHEMA)
            judged.append(Judged(number, truth, report, run.wall_s if run else 0.0, ideal))
    return judged, failures


def write_score(made: BlindSet, numbers: Sequence[int], not_made: Mapping[int, str]) -> str:
    """Open the seals of a diagnosed set, compare reports and truths, and write score.json, score.txt and score.png into its folder.

    numbers: the cases to score. not_made: the reason for each case that could not be made. Returns the table as text.
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
    """Draw two panels: the truth against the first effect named, and the power with Wilson intervals.

    found: a score (gap-blind/1). path: a PNG file.
    """
    figure = Figure(figsize=(17, 9.5), dpi=90, facecolor="white", layout="constrained")
    title = f"Blind set: {found['judged']} cases judged, {len(found['failures'])} failed"
    figure.suptitle(title, fontsize=13, color=INK, weight="bold", x=0.01, ha="left")
    matrix, power = figure.subplots(1, 2, width_ratios=(1.9, 1))
    _draw_matrix(matrix, found["confusion"])
    _draw_power(power, found["power"])
    write_png(figure, path)


def _draw_matrix(axes: Axes, confusion: dict[str, dict[str, int]]) -> None:
    rows, verdicts = list(confusion), (NONE, OTHER, INCONCLUSIVE)
    said = {name for row in confusion.values() for name in row}
    columns = [name for name in (*verdicts, *KNOWN) if name in said or name in verdicts or name in rows]
    columns += sorted(said - set(columns))
    counts = np.array([[confusion[row].get(column, 0) for column in columns] for row in rows])
    if not counts.size:
        axes.text(0.5, 0.5, "no case was judged", ha="center", transform=axes.transAxes)
        return
    axes.imshow(counts / counts.sum(axis=1, keepdims=True), cmap="Blues", vmin=0, vmax=1.3, aspect="auto")
    for (row, column), count in np.ndenumerate(counts):
        if count:
            axes.text(column, row, str(count), ha="center", va="center", fontsize=9, color=INK)
        if columns[column] in _right_columns(rows[row]):
            corner = (column - 0.5, row - 0.5)
            frame = Rectangle(corner, 1, 1, fill=False, edgecolor="#c73e2b", linewidth=1.2, clip_on=False)
            axes.add_patch(frame)
    axes.set_xticks(range(len(columns)), columns, rotation=60, ha="right", fontsize=9)
    labels = [f"{name} *" if _is_foreign(name) else name for name in rows]
    axes.set_yticks(range(len(rows)), labels, fontsize=9)
    axes.set(
        xlabel="first effect named, or verdict",
        ylabel="truth (* not in the library)",
        title="Number of cases; frames mark correct verdicts",
    )


def _right_columns(truth: str) -> tuple[str, ...]:
    if truth == CLEAN:
        return (NONE,)
    return (OTHER, INCONCLUSIVE) if _is_foreign(truth) else (truth,)


def _is_foreign(truth: str) -> bool:
    """Whether a row is of an effect that is not in the library; a simulator may have effects with any names."""
    return truth not in (*KNOWN, CLEAN, PAIR, MIXED)


def _draw_power(axes: Axes, power: list[dict[str, Any]]) -> None:
    edges = [one["left_after_refit_pct"] for one in power]
    labels = [f"> {low:g}" if high is None else f"{low:g} -\n{high:g}" for low, high in edges]
    at = np.arange(len(labels))
    for offset, count, hits, interval, colour, name in (
        (-0.08, "n", "noticed", "noticed_wilson95", "#1b4f91", "noticed (the verdict is not “none”)"),
        (0.08, "n_known", "contains_truth", "contains_wilson95", "#2b8a6e", "the named effects include the true ones"),
    ):  # fmt: skip
        shown = [n for n, row in enumerate(power) if row[count]]
        share = np.array([power[n][hits] / power[n][count] for n in shown])
        ends = np.array([power[n][interval] for n in shown]).reshape(-1, 2)
        errors = np.abs(np.stack([share - ends[:, 0], ends[:, 1] - share])) if shown else None
        axes.errorbar(at[shown] + offset, share, yerr=errors, fmt="o-", color=colour, capsize=3, label=name)
        for n, value in zip(shown, share, strict=True):
            axes.annotate(
                f"{power[n][hits]}/{power[n][count]}",
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
    axes.spines[["top", "right"]].set_visible(False)
