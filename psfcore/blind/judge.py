"""The judge of a diagnosed case of a blind set: its true causes, its report, and whether the report is right.

**Entries.** A report states one entry for each cause that it claims (`causes`), and none if it finds no gap. The
alternatives of an entry are the causes of which one acts with 90 %. An alternative names a stage and a family, and also
an effect of the gap library; without an effect, it means another form of the family.

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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from psfcore.blind.case_set import BlindSet
from psfcore.blind.run_set import BOUND_SCHEMA, REPORT_SCHEMA, result_in, run_of

Entry = Mapping[str, Any]  # an entry of a report, or one of its alternatives

NAME, FAMILY, STAGE = LEVELS = ("name", "family", "stage")
HIDDEN, OPEN, ISOLABLE = CLASSES = ("hidden", "open", "isolable")
DETECTED, ISOLATED = 0.5, 0.8

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
# Effects whose strength is a parameter of the library: the name of this parameter.
COMPARABLE = {
    "dark_offset": "offset",
    "intensity_gradient": "level",
    "gain_mismatch": "excess",
    "ghost": "share",
    "wide_halo": "share",
    "mesh_rotation": "angle",
}


@dataclass(frozen=True, eq=False)
class Cause:
    """A true cause of a case.

    Attributes
    ----------
    effect
        The entry of the effect in the truth.
    bound
        The entry of the effect in bound.json; None if the bound was not computed.
    """

    case: DiagnosedCase
    effect: dict[str, Any]
    bound: dict[str, float] | None

    @property
    def is_known(self) -> bool:
        """Whether the gap library contains the effect in this form."""
        return bool(self.effect["cause"] == self.effect["name"])

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

    @property
    def cover(self) -> Entry | None:
        """The first entry that covers the cause; None if there is none."""
        right = self.right_entries(STAGE)
        for entry in self.case.entries:
            alike = (self.matches(one, level) for one in entry["alternatives"] for level in (NAME, FAMILY))
            if (entry["level"] == STAGE and entry in right) or any(alike):
                return entry
        return None

    @property
    def is_below_limit(self) -> bool | None:
        """Whether the true strength is at most the excluded_95 of the report; None if the two cannot be compared."""
        parameter = COMPARABLE.get(self.effect["name"])
        limit = self.case.report.get("limits", {}).get(self.effect["name"], {})
        own = limit if limit.get("parameter") == parameter else limit.get("parameters", {}).get(parameter, {})
        excluded = own.get("excluded_95")
        return (
            None if parameter is None or excluded is None else bool(abs(self.effect["strength"]) <= excluded)
        )

    @property
    def is_on_axis(self) -> bool | None:
        """Whether the gap of the report varies most along an axis of the effect; None if the case has another cause
        too, or the effect has no axis.
        """
        strongest = (self.case.report.get("where") or [{}])[0].get("axis")
        axes = AXES.get(self.effect["name"])
        return None if axes is None or not self.is_only else strongest in axes

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
        correlation of the maps; None if the truth or an entry of the right family has no map.
        """
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

    def as_json(self) -> dict[str, object]:
        """The judgement of the cause, as JSON."""
        return {
            **{key: self.effect[key] for key in ("name", "families", "strength", "left_alone_pct")},
            "class": self.visibility,
            "bound": self.bound,
            "covered": self.cover is not None,
            "right": {level: bool(self.right_entries(level)) for level in LEVELS},
            "map": self.map,
            "closure": self.closure,
        }


@dataclass(frozen=True, eq=False)
class DiagnosedCase:
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
        return tuple(Cause(self, *both) for both in zip(self.truth["effects"], bounds, strict=True))

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

    def as_json(self) -> dict[str, object]:
        """The judgement of the case, as JSON."""
        return {
            "case": self.number,
            "kind": self.truth["kind"],
            "verdict": self.report["verdict"],
            "entries": [
                {key: entry[key] for key in ("level", "words", "alternatives")} for entry in self.entries
            ],
            "wrong_alone": self.wrong_alone,
            "wall_s": self.wall_s,
            "causes": [cause.as_json() for cause in self.causes],
        }


def true_closure(truth: Mapping[str, Any]) -> float | None:
    """Eq. (1) for a truth; None if no residuals were measured, or if they are 0."""
    percents = np.array([[one["residual_pct"], one["clean_pct"]] for one in truth["residuals"]])
    noise = np.array([one["noise_pct"] for one in truth["residuals"]])
    with_effect, without_effect = np.sum((percents.reshape(-1, 2) / noise[:, None]) ** 2, axis=0)
    return float(1 - without_effect / with_effect) if with_effect else None


def diagnosed_cases(
    blind_set: BlindSet, numbers: Sequence[int]
) -> tuple[list[DiagnosedCase], dict[int, str]]:
    """Two results: the cases that have a report; the reasons why the other cases have none, by number.

    Each truth is read, and its seal is checked. Raises DataError "broken-seal", "bad-seals".
    """
    cases, failures = [], {}
    for number in numbers:
        truth, run = blind_set.truth(number), run_of(blind_set, number)
        report = result_in(blind_set.report(number), REPORT_SCHEMA)
        if report is None:
            failures[number] = (run.error if run else "") or "no complete report"
        else:
            bound = result_in(blind_set.bound(number), BOUND_SCHEMA)
            cases.append(DiagnosedCase(number, truth, report, run.wall_s if run else 0.0, bound))
    return cases, failures
