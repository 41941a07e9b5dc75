"""A diagnosed case of a blind set: its true causes, its report, and whether the report is right.

**Entries.** A report states one entry for each cause that it claims (`causes`), and none if it finds no gap. The
alternatives of an entry are the causes of which one acts with 90 %. An alternative names a stage, a family, and an
effect of the gap library, or no effect: another form of the family.

**Levels.** An alternative is right at the level of

- names, if its effect is the true one. A withheld cause is named right by "another form" of one of its families;
- families, if its family is one of those of the true cause;
- stages, if its family is right or its stage is that of the true cause.

An entry is right at the level of families or stages if all its alternatives are, and at the level of names if it has
only one alternative, and this is right. An entry covers a cause if one of its alternatives is right by name or
family, or if it states a stage alone, and this is right.

**Classes.** The bound of a cause states what a Bayes observer could know (gap-bound/1). A cause is hidden if the
observer excludes "no gap" with a probability below DETECTED; isolable if the probability that it names the cause
alone is at least ISOLATED, for a withheld cause the probability of its family; else open.

    true closure = 1 - (sum of (s_i / n_i)^2) / (sum of (e_i / n_i)^2)                                Eq. (1)

Eq. (1) is the closure that a perfect model of the true effect would reach on noise-free images. e_i is the residual
of image i with the effect, after the PSF was refitted. s_i is the residual of the same image without the effect; the
sampling of the image on pixels causes it. n_i is the noise of the residual. The true closure is below 1, because a
model of the effect does not remove s_i. The library and the blind set describe the same effect by different formulas;
this difference counts as an error of the diagnosis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

Entry = Mapping[str, Any]  # an entry of a report, or one of its alternatives

NAME, FAMILY, STAGE = LEVELS = ("name", "family", "stage")
HIDDEN, OPEN, ISOLABLE = CLASSES = ("hidden", "open", "isolable")
DETECTED, ISOLATED = 0.5, 0.8
NONE = "none"  # the verdict of a report without a gap


@dataclass(frozen=True, eq=False)
class Cause:
    """A true cause of a case: cause `number` of `case`.

    effect: its entry in the truth. bound: its entry in bound.json; None if the bound was not computed.
    """

    case: Judged
    number: int
    effect: dict[str, Any]
    bound: dict[str, Any] | None

    @property
    def name(self) -> str:
        """The name of the effect."""
        return str(self.effect["name"])

    @property
    def is_known(self) -> bool:
        """Whether the gap library contains the effect in this form."""
        return bool(self.effect["cause"] == self.name)

    @property
    def is_only(self) -> bool:
        """Whether the case has no other cause."""
        return len(self.case.causes) == 1

    @property
    def visibility(self) -> str | None:
        """One of CLASSES; None if the bound was not computed."""
        if self.bound is None:
            return None
        if self.bound["detected"] < DETECTED:
            return HIDDEN
        return ISOLABLE if self.bound[NAME if self.is_known else FAMILY] >= ISOLATED else OPEN

    def matches(self, alternative: Entry, level: str) -> bool:
        """Whether an alternative is right at a level."""
        in_family = alternative["family"] in self.effect["families"]
        if level == NAME:
            effect, cause = alternative["effect"], self.effect["cause"]
            return effect == cause if self.is_known else in_family and effect in (None, cause)
        return in_family or (level == STAGE and alternative["stage"] == self.effect["stage"])

    def right_entries(self, level: str) -> list[Entry]:
        """The entries of the report that are right at a level."""
        return [
            entry
            for entry in self.case.entries
            if all(self.matches(one, level) for one in entry["alternatives"])
            and (len(entry["alternatives"]) == 1 if level == NAME else entry["alternatives"])
        ]

    def is_covered_by(self, entry: Entry) -> bool:
        """Whether an entry covers the cause."""
        if entry["level"] == STAGE and entry in self.right_entries(STAGE):
            return True
        return any(self.matches(one, level) for one in entry["alternatives"] for level in (NAME, FAMILY))

    @property
    def cover(self) -> Entry | None:
        """The first entry that covers the cause; None if there is none."""
        return next(filter(self.is_covered_by, self.case.entries), None)

    @property
    def answer(self) -> Entry | None:
        """The entry that covers the cause, else the first entry; None if the report has no entry."""
        return self.cover or next(iter(self.case.entries), None)

    @property
    def closure(self) -> tuple[float, float, float, float] | None:
        """The closure, the ends of its 90 % interval, and the true closure, if the entry of an only cause is right
        and alone.

        None otherwise, and if one of the closures is missing.
        """
        stated = next((entry.get("closure") for entry in self.right_entries(NAME)), None)
        true = true_closure(self.case.truth)
        if not self.is_only or stated is None or true is None:
            return None
        return stated["value"], *stated["ci90"], true

    @cached_property
    def map(self) -> tuple[float, float] | None:
        """The distance of the peak of the report's map from the true one, in units of half the field, and the
        correlation of the maps; None if the truth or an entry of the right family has no map."""
        fields = (entry.get("field") or {} for entry in self.right_entries(FAMILY))
        stated = next((field["map"] for field in fields if "map" in field), None)
        light = self.effect.get("light_map")
        if light is None or stated is None:
            return None
        grid, size_px = np.asarray(light["values"]), light["size_px"]
        at = np.stack(np.meshgrid(stated["x_px"], stated["y_px"]), axis=-1).reshape(-1, 2)
        x, y = np.clip((at.T + 0.5) / size_px * len(grid), 0, len(grid) - 1).astype(int)
        true, values = grid[y, x], np.ravel(np.asarray(stated["value"], dtype=np.float64))
        way = at[np.argmax(np.abs(values))] - at[np.argmax(np.abs(true))]
        both_vary = true.std() > 0 and values.std() > 0
        correlation = float(np.corrcoef(true, values)[0, 1]) if both_vary else 0.0
        return float(np.hypot(*way)) / (size_px / 2), correlation


@dataclass(frozen=True, eq=False)
class Judged:
    """One case: its truth, its report (gap/3), the wall time of its diagnosis, and its bound (gap-bound/1)."""

    number: int
    truth: dict[str, Any]
    report: dict[str, Any]
    wall_s: float
    bound: dict[str, Any] | None = None

    @cached_property
    def causes(self) -> tuple[Cause, ...]:
        """The true causes; none for clean data."""
        bounds = [None] * len(self.truth["effects"]) if self.bound is None else self.bound["causes"]
        both = zip(self.truth["effects"], bounds, strict=True)
        return tuple(Cause(self, n, effect, bound) for n, (effect, bound) in enumerate(both))

    @property
    def entries(self) -> list[Entry]:
        """The entries of the report: the causes that it claims."""
        return list(self.report["causes"])

    @property
    def wrong_alone(self) -> int:
        """The number of entries whose only alternative is a wrong effect of the library, of a wrong family too."""
        right = {name for cause in self.causes for name in (cause.effect["cause"], *cause.effect["also"])}
        families = {family for cause in self.causes for family in cause.effect["families"]}
        alone = [entry["alternatives"][0] for entry in self.entries if len(entry["alternatives"]) == 1]
        return sum(
            one["effect"] is not None and one["effect"] not in right and one["family"] not in families
            for one in alone
        )

    @property
    def tells_both(self) -> bool:
        """Whether two entries state the families of the two causes."""
        first, second = (cause.right_entries(FAMILY) for cause in self.causes)
        return any(one is not other for one in first for other in second)

    @property
    def strongest_axis(self) -> str | None:
        """The axis along which the gap of the report varies most; None if the report states none."""
        return (self.report.get("where") or [{}])[0].get("axis")


def true_closure(truth: Mapping[str, Any]) -> float | None:
    """Eq. (1) for a truth; None if no residuals were measured, or if they are 0."""
    percents = np.array([[one["residual_pct"], one["clean_pct"]] for one in truth["residuals"]])
    noise = np.array([one["noise_pct"] for one in truth["residuals"]])
    with_effect, without_effect = np.sum((percents.reshape(-1, 2) / noise[:, None]) ** 2, axis=0)
    return float(1 - without_effect / with_effect) if with_effect else None
