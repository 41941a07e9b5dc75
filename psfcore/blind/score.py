"""The score of a blind set: whether each report is right, and a table of figures that judge the diagnosis.

**Causes.** The answer of a report is the set of effects that the verdict `attributed` or `tie` names. A report also
states a set of hypotheses. A hypothesis is a list of causes that act together: effects of the gap library (they are
"known"), and "unknown" for any other ("withheld") effect; `[]` is no gap. A hypothesis covers the truth if it contains
every required cause. An effect is required if it alone leaves at least LOWER_LEVEL_PCT in the discs; if no effect leaves
that much, all are required. The hypothesis may also contain other effects, except for clean data and for a withheld effect
alone. A set is right and alone if it has only one member, and this member covers the truth and contains no wrong cause.

**Selections.** "Left" is the residual that the effects leave in the discs after the refit of the PSF. "Noncentrality" and
"rival" are numbers of the ideal observer (`bounds.Known`): the chi2 of the gap that remains in noise-free images after the
PSF is refitted, and the distance of the nearest hypothesis that is not true. Rows that need these numbers count only cases
for which they were computed. For the two effects of a mixed case, the noncentrality of each is the chi2 that it alone
leaves in the means of the discs (`left_alone_chi2`). In a row "/ ideal observer", the number of cases that meet the
condition is divided by the number expected of the ideal observer, the sum of `bounds.Known.alone`.

**Maps.** The truth of a case with added light contains a map of this light. The distance of its peak from that of the
report's map is in units of half the width of the field.

    true closure = 1 - (sum of (s_i / n_i)^2) / (sum of (e_i / n_i)^2)                                Eq. (1)
    (p + z^2 / 2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)                             Eq. (2)

Eq. (1) is the closure that a perfect model of the true effect would reach on noise-free images. e_i is the residual of
image i with the effect, after the PSF was refitted. s_i is the residual of the same image without the effect; the
sampling of the image on pixels causes it. n_i is the noise of the residual. The true closure is below 1, because a
model of the effect does not remove s_i. The library and the blind set describe the same effect by different formulas; this
difference counts as an error of the diagnosis. Eq. (2) is the Wilson interval of a fraction p of n cases.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from statistics import mean, median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.blind.bounds import CLEAN as KNOWN_OF_CLEAN
from psfcore.blind.bounds import Known, known
from psfcore.blind.case_set import BlindSet
from psfcore.blind.cases import CLEAN, FOREIGN, MIXED, PAIR, SINGLE
from psfcore.blind.effects.registry import KNOWN, UNKNOWN
from psfcore.blind.picture import score_png
from psfcore.blind.run_set import IDEAL_SCHEMA, REPORT_SCHEMA, result_in, run_of

SCHEMA = "gap-blind/1"
LOWER_LEVEL_PCT, LEVEL_PCT, STRONG_PCT = 1.0, 2.0, 10.0
# A chi2: an effect with this noncentrality is found among eighteen effects with a probability of 0.99.
SEEN = 30.0
NEAR = 0.15  # distance of the peak of a map from the true peak, in units of half the field
LEAST_CLOSURE = 0.1  # if the closure by the true effect is smaller, the ratio of closures has no meaning
POWER_EDGES_PCT = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, math.inf)
Z95 = 1.959963984540054
NONE, ATTRIBUTED, TIE, INCONCLUSIVE = "none", "attributed", "tie", "inconclusive"
NO_GAP: tuple[str, ...] = ()
OTHER = "unknown"  # as a verdict, and as a cause in a hypothesis
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


# Withheld effects that are a known effect in another form. A truncation to steps loses half a step on average: a smooth function of
# the counts, which is a nonlinearity whatever its curve.
IN_OTHER_FORM = {"faint_rounding": "nonlinearity"}


def cause_of(name: str) -> str:
    """The name of an effect in a hypothesis: effects that are not in the library are "unknown"."""
    known = IN_OTHER_FORM.get(name, name)
    return known if known in KNOWN else OTHER


def required_causes(truth: Mapping[str, Any]) -> tuple[str, ...]:
    """The causes that a hypothesis must contain to cover a truth."""
    effects = truth["effects"]
    shown = [e for e in effects if e.get("left_alone_pct", LOWER_LEVEL_PCT) >= LOWER_LEVEL_PCT]
    return tuple(dict.fromkeys(cause_of(effect["name"]) for effect in shown or effects))


@dataclass(frozen=True)
class Judged:
    """One case: its truth, its report, the wall time of its diagnosis, and what an ideal observer could know (gap-ideal/1)."""

    number: int
    truth: dict[str, Any]
    report: dict[str, Any]
    wall_s: float
    ideal: dict[str, Any] | None = None

    @property
    def kind(self) -> str:
        """The kind of the case: CLEAN, SINGLE, PAIR, FOREIGN or MIXED."""
        return str(self.truth["kind"])

    @property
    def true_names(self) -> tuple[str, ...]:
        """The names of the true effects."""
        return tuple(effect["name"] for effect in self.truth["effects"])

    @property
    def true_causes(self) -> set[str]:
        """The true effects, as a hypothesis names them."""
        return set(map(cause_of, self.true_names))

    @property
    def required(self) -> set[str]:
        """The result of `required_causes`."""
        return set(required_causes(self.truth))

    @property
    def left_pct(self) -> float:
        """The residual that the effects leave in the discs after the refit, percent, rms over images.

        If the truth does not state this residual, the value of the ideal observer is used; NaN if that was not
        computed.
        """
        if self.truth.get("left_after_refit_pct") is not None:
            return float(self.truth["left_after_refit_pct"])
        return math.nan if self.ideal is None else float(self.ideal["left_after_refit_pct"])

    @cached_property
    def known(self) -> Known | None:
        """What an ideal observer could know about the case; None if it was not computed."""
        if self.kind == CLEAN:
            return KNOWN_OF_CLEAN
        if self.ideal is None:
            return None
        in_library = self.kind in (SINGLE, PAIR)
        required = tuple(self.required) if in_library else self.true_names
        return known(self.ideal, required, self.true_names, in_library=in_library)

    @property
    def noncentrality(self) -> float:
        """The noncentrality of the case (`bounds.Known`), a chi2; NaN if it was not computed."""
        return math.nan if self.known is None else self.known.noncentrality

    @property
    def members(self) -> tuple[tuple[str, ...], ...]:
        """The hypotheses in the set of the report."""
        return tuple(tuple(member) for member in self.report["set"]["members"])

    @property
    def verdict(self) -> str:
        """The verdict of the report, one word."""
        return str(self.report["verdict"])

    @property
    def answer(self) -> tuple[str, ...]:
        """The effects that the verdict `attributed` or `tie` names as the cause; empty for other verdicts."""
        return tuple(self.report.get("answer", ())) if self.verdict in (ATTRIBUTED, TIE) else ()

    @property
    def first(self) -> str | None:
        """The name of the first effect in the report; None if the report has no effects."""
        return next((effect["name"] for effect in self.report.get("effects", ())), None)

    @property
    def strongest_axis(self) -> str | None:
        """The axis along which the gap of the report varies most; None if the report states none."""
        return (self.report.get("where") or [{}])[0].get("axis")

    @property
    def unknown(self) -> dict[str, Any]:
        """What the report states about the most probable field of an unknown cause; empty if it states none."""
        fields = (self.report.get("unknown") or {}).get("fields") or [{}]
        return dict(fields[0])

    @property
    def stages(self) -> set[str]:
        """The stages of the withheld effects, and "time" if one of them grows or fades; a simulator of a user need not state them."""
        withheld = [e for e in self.truth["effects"] if cause_of(e["name"]) == OTHER]
        stages = {str(effect["stage"]) for effect in withheld if "stage" in effect}
        return stages | ({"time"} if any(effect.get("in_time") for effect in withheld) else set())

    @property
    def stage_is_right(self) -> bool:
        """Whether the report states the stage of the withheld effect."""
        return self.unknown.get("stage") in self.stages

    def closure(self, name: str | None) -> dict[str, Any] | None:
        """The closure (value and ci90) that the report states for an effect; None if it states no closure."""
        effects = self.report.get("effects", ())
        return next((effect.get("closure") for effect in effects if effect["name"] == name), None)

    @cached_property
    def map(self) -> tuple[float, float] | None:
        """The distance of the peak of the report's map from the true one, and the correlation of the maps.

        None if the truth or the report has no map.
        """
        if "light_map" not in self.truth or "map" not in self.unknown:
            return None
        light, stated = self.truth["light_map"], self.unknown["map"]
        grid, size_px = np.asarray(light["values"]), light["size_px"]
        at = np.stack(np.meshgrid(stated["x_px"], stated["y_px"]), axis=-1).reshape(-1, 2)
        x, y = np.clip((at.T + 0.5) / size_px * len(grid), 0, len(grid) - 1).astype(int)
        true, values = grid[y, x], np.ravel(np.asarray(stated["value"], dtype=np.float64))
        way = at[np.argmax(np.abs(values))] - at[np.argmax(np.abs(true))]
        both_vary = true.std() > 0 and values.std() > 0
        correlation = float(np.corrcoef(true, values)[0, 1]) if both_vary else 0.0
        return float(np.hypot(*way)) / (size_px / 2), correlation


def raises_alarm(case: Judged) -> bool:
    """Whether the verdict is not `none`, so that the report claims or suspects a gap."""
    return case.verdict != NONE


def contains_truth(case: Judged) -> bool:
    """Whether the answer names every required effect."""
    return case.required <= set(case.answer)


def covers(case: Judged, hypothesis: tuple[str, ...]) -> bool:
    """Whether a hypothesis covers the truth of the case."""
    may_have_more = case.kind not in (CLEAN, FOREIGN)
    return case.required <= set(hypothesis) and (may_have_more or set(hypothesis) <= case.true_causes)


def set_covers_truth(case: Judged) -> bool:
    """Whether a member of the set covers the truth."""
    return any(covers(case, member) for member in case.members)


def is_right_and_alone(case: Judged) -> bool:
    """Whether the set has only one member, and this member covers the truth and contains no wrong cause."""
    (member, *others) = case.members or (NO_GAP, NO_GAP)
    return not others and covers(case, member) and set(member) <= case.true_causes


def verdict_is_right(case: Judged) -> bool:
    """Whether the verdict states the truth and nothing else.

    It is `none` for clean data, and `unknown` if a withheld effect acts, else `attributed`. The known effects that the
    report's answer names are true, and are all that are required.
    """
    if case.kind == CLEAN or case.verdict not in (ATTRIBUTED, OTHER):
        return case.kind == CLEAN and case.verdict == NONE
    said = {*case.report.get("answer", ()), *((OTHER,) if case.verdict == OTHER else ())}
    return case.required <= said <= case.true_causes


def has_only_wrong_effects(case: Judged) -> bool:
    """Whether every member of the set names effects of the library alone, and none of them is true."""
    return bool(case.members) and all(
        member and OTHER not in member and not set(member) & case.true_causes for member in case.members
    )


def says_unknown(case: Judged) -> bool:
    """Whether a member of the set contains an unknown cause."""
    return any(OTHER in member for member in case.members)


def tells_both(case: Judged) -> bool:
    """Whether a member of the set contains the known and the unknown cause of a mixed case, and the stage is right."""
    return case.stage_is_right and any(case.true_causes <= set(member) for member in case.members)


def _by_image(truth: Mapping[str, Any]) -> NDArray[np.float64] | None:
    """e_i / n_i and s_i / n_i of Eq. (1), (2, images); None if they were not measured."""
    if "refitted" not in truth:
        return None
    left, noise = truth["refitted"]["residual_pct"], truth["refitted"]["noise_pct"]
    both = [(value / noise[n], truth["clean_by_image_pct"][n] / noise[n]) for n, value in left.items()]
    return np.array(both).reshape(-1, 2).T


def shown_chi2(truth: Mapping[str, Any]) -> float | None:
    """chi2 of the residuals that the effects leave in the means of the discs after the refit; None if they were not measured."""
    both = _by_image(truth)
    return None if both is None else float(np.sum((both[0] - both[1]) ** 2))


def true_closure(truth: Mapping[str, Any]) -> float | None:
    """Eq. (1) for a truth; None if the residuals were not measured."""
    both = _by_image(truth)
    if both is None or not both[0].any():
        return None
    return float(1 - np.sum(both[1] ** 2) / np.sum(both[0] ** 2))


def is_shown(case: Judged) -> bool:
    """Whether the chi2 of the residuals of the disc means is at least SEEN, for a pair also that of each required effect alone."""
    required = (e for e in case.truth["effects"] if case.kind == PAIR and e["name"] in case.required)
    chi2 = [float(effect["left_alone_chi2"]) for effect in required if "left_alone_chi2" in effect]
    return min([*chi2, shown_chi2(case.truth) or 0.0]) >= SEEN


def closure_share(case: Judged) -> float | None:
    """The closure by the first effect divided by the closure by the true effect; 1 if both are the same effect.

    None if one of the closures is missing, or if the closure by the true effect is below LEAST_CLOSURE.
    """
    first, true = case.closure(case.first), case.closure(case.true_names[0])
    if case.first == case.true_names[0]:
        return 1.0
    if first is None or true is None or true["value"] < LEAST_CLOSURE:
        return None
    return float(first["value"] / true["value"])


def interval_holds(case: Judged) -> bool | None:
    """Whether the ci90 of the closure by the true effect contains the true closure; None if one of them is missing."""
    closure, true = case.closure(case.true_names[0]), true_closure(case.truth)
    return None if closure is None or true is None else bool(closure["ci90"][0] <= true <= closure["ci90"][1])


Row = dict[str, Any]
Holds = Callable[[Judged], float | None]  # 1 if a case meets a condition, 0 if not; 0.5 counts as half a case


def wilson(hits: float, cases: int, z: float = Z95) -> tuple[float, float]:
    """Eq. (2) for hits / cases; (0, 1) if there is no case."""
    if cases == 0:
        return 0.0, 1.0
    p, spread = hits / cases, z**2 / cases
    middle = (p + spread / 2) / (1 + spread)
    half = z * math.sqrt(p * (1 - p) / cases + spread / (4 * cases)) / (1 + spread)
    return max(0.0, middle - half), min(1.0, middle + half)


def row(
    figure: str,
    cases: int,
    value: float | None,
    interval: Sequence[float] | None,
    least: float | None = None,
    most: float | None = None,
) -> Row:
    """A row of the table, as JSON. interval: Eq. (2), if the value is a fraction of cases. least, most: the goal."""
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

    expected: the probability that an ideal observer meets the condition. The interval is Eq. (2) for the fraction of cases,
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
    yield share("false alarms on clean data", clean, raises_alarm, most=0.01)
    # These cases are also false alarms.
    yield share("inconclusive on clean data", clean, lambda case: case.verdict == INCONCLUSIVE)
    yield share("answer contains the truth, >= 2 % left", strong, contains_truth, 0.95)
    yield share(
        "the same, >= 1 % left, inconclusive = 1/2",
        _left(library, LOWER_LEVEL_PCT),
        lambda case: 0.5 if case.verdict == INCONCLUSIVE else contains_truth(case),
        0.8,
    )
    shown = [case for case in strong if is_shown(case)]
    yield share("the same, >= 2 % left, shown by the discs", shown, contains_truth)
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
    shares = [one for one in map(closure_share, answered) if one is not None]
    yield of_values("closure by the first effect / by the true effect", shares, median, 0.95)
    stated = [case for case in answered if interval_holds(case) is not None]
    yield share("90 % interval contains the true closure", stated, interval_holds, 0.85, 0.95)
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
    yield share("set covers the truth", judged, set_covers_truth, 0.87, 0.93)
    for kind, words in KIND_WORDS.items():
        yield share(f"the same, {words}", _of_kind(judged, kind), set_covers_truth, 0.85)
    for figure, some, most in (
        ("mean number of members of the set", judged, 2.2),
        ("the same, noncentrality >= 30", seen, 1.4),
    ):
        yield of_values(figure, [float(len(case.members)) for case in some], mean, most=most)
    without_clean = [case for case in observed if case.kind != CLEAN]
    for figure, some, right in (
        ("right and alone / ideal observer", observed, is_right_and_alone),
        ("the same, without clean data", without_clean, is_right_and_alone),
        ("right verdict / ideal observer", observed, verdict_is_right),
    ):
        yield share(figure, some, right, 0.6, expected=lambda case: case.known.alone if case.known else 0.0)
    yield share("clean data: set without []", clean, lambda case: NO_GAP not in case.members, most=0.01)
    yield share(
        "one wrong effect alone in the set",
        judged,
        lambda case: len(case.members) == 1 and has_only_wrong_effects(case),
        most=0.02,
    )
    yield share("only wrong effects in the set", judged, has_only_wrong_effects, most=0.015)
    yield share(
        "only wrong effects in the set, not in the library", foreign, has_only_wrong_effects, most=0.02
    )
    known_seen = _of_kind(seen, SINGLE, PAIR)
    yield share("known, noncentrality >= 30: named and alone", known_seen, is_right_and_alone, 0.85)
    foreign_seen = _of_kind(seen, FOREIGN)
    yield share("not in the library, noncentrality >= 30: unknown in set", foreign_seen, says_unknown, 0.9)
    staged = [case for case in foreign_seen if case.stages]
    yield share("the same, its stage is right", staged, lambda case: case.stage_is_right, 0.8)
    far = [case for case in foreign if case.known is not None and (case.known.rival or 0.0) >= SEEN]
    yield share("the same, nearest rival >= 30", far, says_unknown)
    mixed = [
        case
        for case in _of_kind(judged, MIXED)
        if case.stages and all(e.get("left_alone_chi2", 0.0) >= SEEN for e in case.truth["effects"])
    ]
    yield share("known and withheld, each >= 30: both told", mixed, tells_both, 0.6)
    mapped = [case for case in seen if case.map is not None]
    yield share("map of light: peak within 0.15", mapped, lambda case: (case.map or (9.0,))[0] <= NEAR, 0.9)
    correlations = [case.map[1] for case in mapped if case.map is not None]
    yield of_values("map of light: correlation, median", correlations, median, 0.8)
    yield share("set covers the truth, >= 10 % left", _left(judged, STRONG_PCT), set_covers_truth, 0.95)


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
        noticed, named = sum(map(raises_alarm, here)), sum(map(contains_truth, library))
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
        "shown_chi2": shown_chi2(case.truth),
        "verdict": case.verdict,
        "answer": list(case.answer),
        "first": case.first,
        "set": [list(member) for member in case.members],
        "covered": set_covers_truth(case),
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
