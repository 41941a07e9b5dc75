"""One case of a blind set: its truth, its report, and whether the report is right.

    true closure = 1 - (sum of (s_i / n_i)^2) / (sum of (e_i / n_i)^2)                                Eq. (1)

Eq. (1) is the closure that a perfect model of the true effect would reach on noise-free images. e_i is the residual of
image i with the effect, after the PSF was refitted. s_i is the residual of the same image without the effect; the
sampling of the image on pixels causes it. n_i is the noise of the residual. The true closure is below 1, because a
model of the effect does not remove s_i. The library and the
blind set describe the same effect by different formulas; this difference counts as an error of the diagnosis.

A report also states a set of hypotheses. A hypothesis is a list of effects that act together;
`["unknown"]` is an unknown cause, and `[]` is no gap. A hypothesis covers the truth if it names every required effect
(`Judged.required_names`); it may also name other effects. An effect that is not in the library is covered only by
`["unknown"]`, and clean data only by `[]`. The second effect of a pair is not required if this effect alone leaves less
than LOWER_LEVEL_PCT. A hypothesis with only the first effect then covers the pair, because the discs hardly show the
second one. If both effects leave less, both are required. A set is right and alone if it has only one member, and
this member covers the truth and names no wrong effect.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from psfcore.blind.bounds import CLEAN as KNOWN_OF_CLEAN
from psfcore.blind.bounds import Known, known
from psfcore.blind.cases import CLEAN, FOREIGN, PAIR

LOWER_LEVEL_PCT = 1.0
SHOWN_CHI2 = 30.0  # corresponds to 5.5 sigma, if one known pattern is searched for
LEAST_CLOSURE = 0.1  # if the closure by the true effect is smaller, the ratio of closures has no meaning
NONE, ATTRIBUTED, TIE, UNKNOWN_VERDICT, INCONCLUSIVE = "none", "attributed", "tie", "unknown", "inconclusive"
NOTHING: tuple[str, ...] = ()
UNKNOWN_HYPOTHESIS = ("unknown",)

_DETECTOR = ("detector_x", "detector_y")
# The axes along which each effect varies. `saturation_fill` has no entry: it depends on exposure and on the Sun's brightness.
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
    """One case: its truth, its report, the wall time of its diagnosis, and what an ideal observer could know (gap-ideal/1)."""

    number: int
    truth: dict[str, Any]
    report: dict[str, Any]
    wall_s: float
    ideal: dict[str, Any] | None = None

    @property
    def kind(self) -> str:
        """The kind of the case: "clean", "single", "pair" or "unknown"."""
        return str(self.truth["kind"])

    @property
    def true_names(self) -> tuple[str, ...]:
        """The names of the withheld effects."""
        return tuple(effect["name"] for effect in self.truth["effects"])

    @property
    def required_names(self) -> tuple[str, ...]:
        """The withheld effects that an answer must contain: the effects that each leave at least LOWER_LEVEL_PCT on
        their own.

        If no effect leaves that much, the answer must contain all withheld effects.
        """
        return required_names(self.truth)

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
        in_library = self.kind != FOREIGN
        return known(self.ideal, self.required_names, self.true_names, in_library=in_library)

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
        """The effects that the report names as the cause, if the verdict is `attributed` or `tie`. Empty for other
        verdicts."""
        return tuple(self.report.get("answer", ())) if self.verdict in (ATTRIBUTED, TIE) else ()

    @property
    def entries(self) -> dict[str, dict[str, Any]]:
        """The entries of the report's `effects`, by name, best effect first."""
        return {effect["name"]: effect for effect in self.report.get("effects", ())}

    @property
    def first(self) -> str | None:
        """The name of the first effect in the report; None if the report has no effects."""
        return next(iter(self.entries), None)

    def closure(self, name: str | None) -> dict[str, Any] | None:
        """The closure (value and ci90) that the report states for an effect; None if it states no closure."""
        found: dict[str, Any] | None = self.entries.get(name or "", {}).get("closure")
        return found


def required_names(truth: Mapping[str, Any]) -> tuple[str, ...]:
    """`Judged.required_names` for a truth."""
    effects = truth["effects"]
    shown = (e["name"] for e in effects if e.get("left_alone_pct", LOWER_LEVEL_PCT) >= LOWER_LEVEL_PCT)
    return tuple(shown) or tuple(effect["name"] for effect in effects)


def raises_alarm(case: Judged) -> bool:
    """Whether the verdict is not `none`, so that the report claims or suspects a gap."""
    return case.verdict != NONE


def contains_truth(case: Judged) -> bool:
    """Whether the answer names every required effect."""
    return set(case.required_names) <= set(case.answer)


def covers(case: Judged, hypothesis: tuple[str, ...]) -> bool:
    """Whether a hypothesis covers the truth of the case."""
    if case.kind == CLEAN:
        return hypothesis == NOTHING
    if case.kind == FOREIGN:
        return hypothesis == UNKNOWN_HYPOTHESIS
    return set(case.required_names) <= set(hypothesis)


def set_covers_truth(case: Judged) -> bool:
    """Whether a member of the set covers the truth."""
    return any(covers(case, member) for member in case.members)


def is_right_and_alone(case: Judged) -> bool:
    """Whether the set has only one member, and this member covers the truth and names no wrong effect."""
    if len(case.members) != 1 or not covers(case, case.members[0]):
        return False
    return case.kind == FOREIGN or set(case.members[0]) <= set(case.true_names)


def verdict_is_right(case: Judged) -> bool:
    """Whether the verdict states the truth and nothing else.

    It is `none` for clean data and `unknown` for an effect that is not in the library. For other cases it is
    `attributed`, and the answer contains every required effect and no wrong effect.
    """
    if case.kind == CLEAN:
        return case.verdict == NONE
    if case.kind == FOREIGN:
        return case.verdict == UNKNOWN_VERDICT
    return case.verdict == ATTRIBUTED and contains_truth(case) and set(case.answer) <= set(case.true_names)


def has_only_wrong_effects(case: Judged) -> bool:
    """Whether the set has only one member, and this member names one or more effects, none of which is true."""
    if len(case.members) != 1:
        return False
    (member,) = case.members
    return member not in (NOTHING, UNKNOWN_HYPOTHESIS) and not set(member) & set(case.true_names)


def names_one_wrong(case: Judged) -> bool:
    """Whether the verdict is `attributed` with a single effect that is not in the truth."""
    return case.verdict == ATTRIBUTED and len(case.answer) == 1 and case.answer[0] not in case.true_names


def is_shown(case: Judged) -> bool:
    """Whether the chi2 of the residuals of the disc means is at least SHOWN_CHI2.

    For a pair, this must also hold for each required effect alone.
    """
    chi2 = [shown_chi2(case.truth) or 0.0]
    if case.kind == PAIR:
        required = (effect for effect in case.truth["effects"] if effect["name"] in case.required_names)
        chi2 += [float(effect["left_alone_chi2"]) for effect in required if "left_alone_chi2" in effect]
    return min(chi2) >= SHOWN_CHI2


def shown_chi2(truth: dict[str, Any]) -> float | None:
    """chi2 of the residuals that the effects leave in the means of the discs after the refit; None if they were not measured."""
    if "refitted" not in truth:
        return None
    left, noise, clean = (
        truth["refitted"]["residual_pct"],
        truth["refitted"]["noise_pct"],
        truth["clean_by_image_pct"],
    )
    return float(sum(((left[n] - clean[n]) / noise[n]) ** 2 for n in set(left) & set(clean)))


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


def has_interval(case: Judged) -> bool:
    """Whether the report states a closure for the true effect, and the true closure is known."""
    return case.closure(case.true_names[0]) is not None and true_closure(case.truth) is not None


def interval_holds(case: Judged) -> bool:
    """Whether the ci90 of the closure by the true effect contains the true closure."""
    closure, true = case.closure(case.true_names[0]), true_closure(case.truth)
    if closure is None or true is None:
        return False
    low, high = closure["ci90"]
    return bool(low <= true <= high)


def true_closure(truth: dict[str, Any]) -> float | None:
    """Eq. (1) for a truth; None if the residuals were not measured."""
    if "refitted" not in truth:
        return None
    with_effect, noise = truth["refitted"]["residual_pct"], truth["refitted"]["noise_pct"]
    images = sorted(set(with_effect) & set(truth["clean_by_image_pct"]))
    gap = sum((with_effect[n] / noise[n]) ** 2 for n in images)
    stays = sum((truth["clean_by_image_pct"][n] / noise[n]) ** 2 for n in images)
    return 1 - stays / gap if gap > 0 else None


def axis_is_right(case: Judged) -> bool:
    """Whether the strongest axis of the report belongs to the true effect."""
    where = case.report.get("where") or [{}]
    return where[0].get("axis") in AXES[case.true_names[0]]


def true_label(case: Judged) -> str:
    """The row of the case in the confusion matrix."""
    return case.kind if case.kind in (CLEAN, PAIR) else case.true_names[0]


def said_label(case: Judged) -> str:
    """The column of the case in the confusion matrix: the first effect of the answer; the verdict if the answer is empty.

    For a pair, the order of the effects in the answer does not count: if the answer contains a true effect, that effect
    is used.
    """
    if not case.answer:
        return case.verdict
    if case.kind == PAIR:
        return next((name for name in case.answer if name in case.true_names), case.answer[0])
    return case.first if case.first in case.answer else case.answer[0]
