"""Reports against truths: the table by which the diagnosis is judged.

    Wilson: (p + z^2 / 2n +- z sqrt(p (1 - p) / n + z^2 / 4n^2)) / (1 + z^2 / n)                     Eq. (1)
    true closure = 1 - (sum of (s_i / n_i)^2) / (sum of (e_i / n_i)^2)                                Eq. (2)

Eq. (2) is what closing the true effect wholly would close of the noise-free gap: e_i is what image i's disc has left
with the effect and the PSF fitted anew, s_i what the sampling alone leaves of it without the effect, n_i its noise. It
is not 1, because the sampling stays; that the library's form of the effect is not the truth's is the diagnosis' own
error and is counted as such.

Rows, each with its cases. An answer is what the verdict `attributed` or `tie` names.
- false alarms: clean cases whose verdict is not `none`; those that say `inconclusive` are counted once more, alone.
- of the first, where the discs show it: of `contains`, the cases whose discs' means alone, without any fit of an effect, exceed
  their noise by chi2 SHOWN_CHI2 or more: less is hidden from anyone who looks at the discs. Of a pair each effect that
  has to be named would exceed it alone, to first order.
- contains: single known effects and pairs at or above a level left in the discs after the refit; the answer names the
  true effect; of a pair both, but for one that alone leaves less than 1 % where the other leaves more. At 1 %,
  `inconclusive` counts half.
- first place: single known effects, at or above 2 %; the first of the report's `effects` is the truth.
- one wrong effect named: all cases, verdict `attributed`, one effect, and not one of the true ones. Clean cases and
  unknown effects have none that is true. It counts as confident, because a tie or `inconclusive` says otherwise.
- mean size of the answer: cases of `contains` at 2 % that have an answer.
- unknown: verdict `unknown` or `inconclusive`, at or above 2 %, where there is something to see.
- closure as a share: single known effects at 2 % that have an answer; closure of the first effect over closure of the
  true effect's own entry, where that is a tenth or more; the median, 1 where the first is the truth.
- interval: the same cases, the true effect's own ci90 holds Eq. (2).
- strongest axis: single known effects of AXES at 2 % whose verdict is not `none`; the first of `where` is one of its
  effect's. What clipping takes has none: where it shows goes with the exposure and where the Sun is bright.
- time: wall time of the slowest, s.
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

SCHEMA = "gap-blind/1"
Z95 = 1.959963984540054
LEVEL_PCT, LOWER_LEVEL_PCT = 2.0, 1.0
SHOWN_CHI2 = 30.0  # where one known pattern was looked for it would be 5.5 sigma
LEAST_CLOSURE = 0.1  # below it a ratio of closures says nothing
POWER_EDGES_PCT = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0, math.inf)
NONE, ATTRIBUTED, TIE, UNKNOWN_VERDICT, INCONCLUSIVE = "none", "attributed", "tie", "unknown", "inconclusive"

_DETECTOR = ("detector_x", "detector_y")
AXES: dict[str, tuple[str, ...]] = {
    "dark_offset": ("exposure", "intensity"),
    "nonlinearity": ("intensity",),
    "intensity_gradient": _DETECTOR,
    "flat_field_residual": _DETECTOR,
    "field_dependent_scatter": _DETECTOR,
    "gain_mismatch": ("gain_mode", "exposure"),
    "column_smear": (*_DETECTOR, "intensity"),
    "ghost": (*_DETECTOR, "intensity"),
    "persistence": ("time", "pointing"),
    "scene_evolution": ("time", "pointing"),
    "anisotropic_scatter": ("azimuth_in_disc", *_DETECTOR),
    "mesh_rotation": ("azimuth_in_disc", *_DETECTOR),
    "wide_halo": ("scattering_distance", "pointing", "intensity"),
    "out_of_field_light": ("scattering_distance", "pointing", "intensity"),
    "core_blur": ("radius_in_disc", "azimuth_in_disc"),
    "mesh_pitch": ("radius_in_disc", "azimuth_in_disc"),
    "occulter_motion": ("radius_in_disc", "azimuth_in_disc"),
}


@dataclass(frozen=True)
class Judged:
    """One case: what was true, and what was said."""

    number: int
    truth: dict[str, Any]
    report: dict[str, Any]
    wall_s: float

    @property
    def kind(self) -> str:
        """Clean, single, pair or unknown."""
        return str(self.truth["kind"])

    @property
    def true_names(self) -> tuple[str, ...]:
        """The effects that were put in."""
        return tuple(effect["name"] for effect in self.truth["effects"])

    @property
    def wanted_names(self) -> tuple[str, ...]:
        """Of these the ones that an answer has to name."""
        seen = [
            effect["name"]
            for effect in self.truth["effects"]
            if effect.get("left_alone_pct", LOWER_LEVEL_PCT) >= LOWER_LEVEL_PCT
        ]
        return tuple(seen) or self.true_names

    @property
    def left_pct(self) -> float:
        """Left in the discs after the refit."""
        return float(self.truth["left_after_refit_pct"])

    @property
    def verdict(self) -> str:
        """What the report says in one word."""
        return str(self.report["verdict"])

    @property
    def answer(self) -> tuple[str, ...]:
        """The effects that the verdict names."""
        return tuple(self.report.get("answer", ())) if self.verdict in (ATTRIBUTED, TIE) else ()

    @property
    def entries(self) -> dict[str, dict[str, Any]]:
        """The report's effects by name, best first."""
        return {effect["name"]: effect for effect in self.report.get("effects", ())}

    @property
    def first(self) -> str | None:
        """The report's best effect."""
        return next(iter(self.entries), None)

    def closure(self, name: str | None) -> dict[str, Any] | None:
        """Closure of an effect's entry, value and ci90."""
        found: dict[str, Any] | None = self.entries.get(name or "", {}).get("closure")
        return found


@dataclass(frozen=True)
class Row:
    """A line of the table. interval95: Wilson's, of a share; None where the value is none."""

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
    """The table, the confusion matrix and the power, and what went wrong."""

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
    """Eq. (1); (0, 1) of no cases."""
    if cases == 0:
        return 0.0, 1.0
    p, spread = hits / cases, z**2 / cases
    middle = (p + spread / 2) / (1 + spread)
    half = z * math.sqrt(p * (1 - p) / cases + spread / (4 * cases)) / (1 + spread)
    return max(0.0, middle - half), min(1.0, middle + half)


def score(judged: Sequence[Judged], failures: dict[int, str] | None = None) -> Score:
    """All figures of cases that have a report; failures: why the others have none, by case."""
    return Score(
        rows=_rows(judged),
        confusion=_confusion(judged),
        power=_power(judged),
        judged=len(judged),
        failures=dict(failures or {}),
        cases=tuple(_case(case) for case in judged),
    )


def _rows(judged: Sequence[Judged]) -> tuple[Row, ...]:
    clean = [case for case in judged if case.kind == CLEAN]
    true = [case for case in judged if case.kind in (SINGLE, PAIR)]
    seen = [case for case in true if case.left_pct >= LEVEL_PCT]
    single = [case for case in seen if case.kind == SINGLE]
    answered = [case for case in single if case.answer]
    foreign = [case for case in judged if case.kind == FOREIGN and case.left_pct >= LEVEL_PCT]
    no_none = [case for case in single if case.verdict != NONE and case.true_names[0] in AXES]
    return (
        _share("false alarms on clean data", clean, _alarmed, "<= 0.01", lambda p: p <= 0.01),
        _share("of these, inconclusive", clean, lambda case: case.verdict == INCONCLUSIVE, "", None),
        _share("answer contains the truth, >= 2 % left", seen, _contains, ">= 0.95", lambda p: p >= 0.95),
        _share(
            "the same, >= 1 % left, inconclusive half",
            [case for case in true if case.left_pct >= LOWER_LEVEL_PCT],
            lambda case: 0.5 if case.verdict == INCONCLUSIVE else _contains(case),
            ">= 0.80",
            lambda p: p >= 0.8,
        ),
        _share(
            "of the first, where the discs show it",
            [case for case in seen if _all_shown(case)],
            _contains,
            "",
            None,
        ),
        _share(
            "first place is the truth",
            single,
            lambda case: case.first == case.true_names[0],
            ">= 0.85",
            lambda p: p >= 0.85,
        ),
        _share("one wrong effect named with confidence", judged, _wrong_one, "<= 0.02", lambda p: p <= 0.02),
        _value(
            "mean size of the answer",
            [float(len(case.answer)) for case in seen if case.answer],
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
        _value(
            "closure as a share of the true effect's",
            [share for share in map(_closure_share, answered) if share is not None],
            median,
            ">= 0.95",
            lambda value: value >= 0.95,
        ),
        _share(
            "90 % interval of closure holds the truth",
            [case for case in answered if _has_interval(case)],
            _interval_holds,
            "0.85 - 0.95",
            lambda p: 0.85 <= p <= 0.95,
        ),
        _share("strongest axis right", no_none, _axis_right, ">= 0.90", lambda p: p >= 0.9),
        _value(
            "time of the slowest, s",
            [case.wall_s for case in judged],
            max,
            "<= 180",
            lambda value: value <= 180,
        ),
    )


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


def _all_shown(case: Judged) -> bool:
    chi2 = [shown_chi2(case.truth) or 0.0]
    if case.kind == PAIR:
        wanted = (effect for effect in case.truth["effects"] if effect["name"] in case.wanted_names)
        chi2 += [float(effect["left_alone_chi2"]) for effect in wanted if "left_alone_chi2" in effect]
    return min(chi2) >= SHOWN_CHI2


def _alarmed(case: Judged) -> bool:
    return case.verdict != NONE


def _contains(case: Judged) -> bool:
    return set(case.wanted_names) <= set(case.answer)


def _wrong_one(case: Judged) -> bool:
    return case.verdict == ATTRIBUTED and len(case.answer) == 1 and case.answer[0] not in case.true_names


def _closure_share(case: Judged) -> float | None:
    """Closure of the first effect over that of the true one."""
    first, true = case.closure(case.first), case.closure(case.true_names[0])
    if case.first == case.true_names[0]:
        return 1.0
    if first is None or true is None or true["value"] < LEAST_CLOSURE:
        return None
    return float(first["value"] / true["value"])


def _has_interval(case: Judged) -> bool:
    return case.closure(case.true_names[0]) is not None and true_closure(case.truth) is not None


def _interval_holds(case: Judged) -> bool:
    closure, true = case.closure(case.true_names[0]), true_closure(case.truth)
    if closure is None or true is None:
        return False
    low, high = closure["ci90"]
    return bool(low <= true <= high)


def true_closure(truth: dict[str, Any]) -> float | None:
    """Eq. (2) of a truth; None where it was not measured."""
    if "refitted" not in truth:
        return None
    with_effect, noise = truth["refitted"]["residual_pct"], truth["refitted"]["noise_pct"]
    images = sorted(set(with_effect) & set(truth["clean_by_image_pct"]))
    gap = sum((with_effect[n] / noise[n]) ** 2 for n in images)
    stays = sum((truth["clean_by_image_pct"][n] / noise[n]) ** 2 for n in images)
    return 1 - stays / gap if gap > 0 else None


def shown_chi2(truth: dict[str, Any]) -> float | None:
    """What the effect leaves in the discs' means after the refit, over their noise, squared and summed; None where it
    was not measured."""
    if "refitted" not in truth:
        return None
    left, noise, clean = (
        truth["refitted"]["residual_pct"],
        truth["refitted"]["noise_pct"],
        truth["clean_by_image_pct"],
    )
    return float(sum(((left[n] - clean[n]) / noise[n]) ** 2 for n in set(left) & set(clean)))


def _axis_right(case: Judged) -> bool:
    where = case.report.get("where") or [{}]
    return where[0].get("axis") in AXES[case.true_names[0]]


def _confusion(judged: Sequence[Judged]) -> dict[str, dict[str, int]]:
    """Truth by what was said first: a name where one was, else the verdict. Pairs and clean cases are rows too."""
    table: dict[str, Counter[str]] = {}
    for case in judged:
        table.setdefault(true_label(case), Counter())[said_label(case)] += 1
    order = ("clean", *KNOWN, *UNKNOWN, "pair")
    return {name: dict(table[name]) for name in order if name in table}


def true_label(case: Judged) -> str:
    """Row of the confusion matrix."""
    return case.kind if case.kind in (CLEAN, PAIR) else case.true_names[0]


def said_label(case: Judged) -> str:
    """Column of the confusion matrix: the first of an answer, else the verdict.

    Where an answer of several is the truth's pair the order says nothing, and a true effect counts as named first.
    """
    if not case.answer:
        return case.verdict
    if case.kind == PAIR:
        return next((name for name in case.answer if name in case.true_names), case.answer[0])
    return case.first if case.first in case.answer else case.answer[0]


def _power(judged: Sequence[Judged]) -> tuple[dict[str, Any], ...]:
    """By what is left in the discs: how many known effects were noticed at all, and how many named."""
    found = []
    for low, high in pairwise(POWER_EDGES_PCT):
        here = [
            case for case in judged if case.kind in (SINGLE, PAIR, FOREIGN) and low <= case.left_pct < high
        ]
        true = [case for case in here if case.kind != FOREIGN]
        noticed, named = sum(map(_alarmed, here)), sum(map(_contains, true))
        found.append(
            {
                "left_after_refit_pct": [low, None if math.isinf(high) else high],
                "n": len(here),
                "noticed": noticed,
                "noticed_wilson95": list(wilson(noticed, len(here))),
                "n_known": len(true),
                "contains_truth": named,
                "contains_wilson95": list(wilson(named, len(true))),
            }
        )
    return tuple(found)


def _case(case: Judged) -> dict[str, Any]:
    """One case in a line."""
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
    """The rows as plain text."""
    lines = [f"{'figure':<50}{'n':>5}{'value':>9}  {'95 % (Wilson)':<16}{'goal':<13}met"]
    for row in found.rows:
        value = "-" if row.value is None else f"{row.value:.3f}"
        interval = "" if row.interval95 is None else f"{row.interval95[0]:.3f} - {row.interval95[1]:.3f}"
        met = {None: "", True: "yes", False: "NO"}[row.met]
        lines.append(f"{row.figure:<50}{row.cases:>5}{value:>9}  {interval:<16}{row.goal:<13}{met}")
    clean = found.rows[0]
    if clean.value == 0.0 and clean.cases:
        lines.append(
            f"no alarm in {clean.cases} clean cases bounds the rate at {min(3 / clean.cases, 1.0):.3f} (95 %)"
        )
    lines.append(f"{found.judged} cases judged, {len(found.failures)} failed")
    return "\n".join(
        [*lines, *(f"  {number:04d}: {why.splitlines()[-1]:.120}" for number, why in found.failures.items())]
    )
