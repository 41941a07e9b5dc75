"""A diagnosed case of a blind set: its truth, its report, and whether the report is right.

**Causes.** The answer of a report is the set of effects that the verdict `attributed` or `tie` names. A report also
states a set of hypotheses. A hypothesis is a list of causes that act together: effects of the gap library (they are
"known"), and "unknown" for any other ("withheld") effect; `[]` is no gap. A hypothesis covers the truth if it contains
every required cause. An effect is required if it alone leaves at least LOWER_LEVEL_PCT in the discs; if no effect leaves
that much, all are required. The hypothesis may also contain other effects, except for clean data and for a withheld effect
alone. A set is right and alone if it has only one member, and this member covers the truth and contains no wrong cause.

**Maps.** The truth of a case with added light contains a map of this light. The distance of its peak from that of the
report's map is in units of half the width of the field.

    true closure = 1 - (sum of (s_i / n_i)^2) / (sum of (e_i / n_i)^2)                                Eq. (1)

Eq. (1) is the closure that a perfect model of the true effect would reach on noise-free images. e_i is the residual of
image i with the effect, after the PSF was refitted. s_i is the residual of the same image without the effect; the
sampling of the image on pixels causes it. n_i is the noise of the residual. The true closure is below 1, because a
model of the effect does not remove s_i. The library and the blind set describe the same effect by different formulas; this
difference counts as an error of the diagnosis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from psfcore.blind.bounds import CLEAN as KNOWN_OF_CLEAN
from psfcore.blind.bounds import Known, known
from psfcore.blind.cases import CLEAN, FOREIGN, PAIR, SINGLE
from psfcore.blind.effects.registry import KNOWN

LOWER_LEVEL_PCT = 1.0  # an effect that alone leaves less need not be named
LEAST_CLOSURE = 0.1  # if the closure by the true effect is smaller, the ratio of closures has no meaning
NONE, ATTRIBUTED, TIE, INCONCLUSIVE = "none", "attributed", "tie", "inconclusive"
NO_GAP: tuple[str, ...] = ()
OTHER = "unknown"  # as a verdict, and as a cause in a hypothesis
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


def true_closure(truth: Mapping[str, Any]) -> float | None:
    """Eq. (1) for a truth; None if the residuals were not measured."""
    if "refitted" not in truth:
        return None
    left, noise = truth["refitted"]["residual_pct"], truth["refitted"]["noise_pct"]
    both = [(value / noise[n], truth["clean_by_image_pct"][n] / noise[n]) for n, value in left.items()]
    with_effect, without_effect = np.array(both).reshape(-1, 2).T
    if not with_effect.any():
        return None
    return float(1 - np.sum(without_effect**2) / np.sum(with_effect**2))


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

    def raises_alarm(self) -> bool:
        """Whether the verdict is not `none`, so that the report claims or suspects a gap."""
        return self.verdict != NONE

    def contains_truth(self) -> bool:
        """Whether the answer names every required effect."""
        return self.required <= set(self.answer)

    def covers(self, hypothesis: tuple[str, ...]) -> bool:
        """Whether a hypothesis covers the truth of the case."""
        may_have_more = self.kind not in (CLEAN, FOREIGN)
        return self.required <= set(hypothesis) and (may_have_more or set(hypothesis) <= self.true_causes)

    def set_covers_truth(self) -> bool:
        """Whether a member of the set covers the truth."""
        return any(self.covers(member) for member in self.members)

    def is_right_and_alone(self) -> bool:
        """Whether the set has only one member, and this member covers the truth and contains no wrong cause."""
        (member, *others) = self.members or (NO_GAP, NO_GAP)
        return not others and self.covers(member) and set(member) <= self.true_causes

    def verdict_is_right(self) -> bool:
        """Whether the verdict states the truth and nothing else.

        It is `none` for clean data, and `unknown` if a withheld effect acts, else `attributed`. The known effects that the
        report's answer names are true, and are all that are required.
        """
        if self.kind == CLEAN or self.verdict not in (ATTRIBUTED, OTHER):
            return self.kind == CLEAN and self.verdict == NONE
        said = {*self.report.get("answer", ()), *((OTHER,) if self.verdict == OTHER else ())}
        return self.required <= said <= self.true_causes

    def has_only_wrong_effects(self) -> bool:
        """Whether every member of the set names effects of the library alone, and none of them is true."""
        return bool(self.members) and all(
            member and OTHER not in member and not set(member) & self.true_causes for member in self.members
        )

    def says_unknown(self) -> bool:
        """Whether a member of the set contains an unknown cause."""
        return any(OTHER in member for member in self.members)

    def tells_both(self) -> bool:
        """Whether a member of the set contains the known and the unknown cause of a mixed case, and the stage is right."""
        return self.stage_is_right and any(self.true_causes <= set(member) for member in self.members)

    def closure_share(self) -> float | None:
        """The closure by the first effect divided by the closure by the true effect; 1 if both are the same effect.

        None if one of the closures is missing, or if the closure by the true effect is below LEAST_CLOSURE.
        """
        first, true = self.closure(self.first), self.closure(self.true_names[0])
        if self.first == self.true_names[0]:
            return 1.0
        if first is None or true is None or true["value"] < LEAST_CLOSURE:
            return None
        return float(first["value"] / true["value"])

    def interval_holds(self) -> bool | None:
        """Whether the ci90 of the closure by the true effect contains the true closure; None if one of them is missing."""
        closure, true = self.closure(self.true_names[0]), true_closure(self.truth)
        return (
            None
            if closure is None or true is None
            else bool(closure["ci90"][0] <= true <= closure["ci90"][1])
        )
