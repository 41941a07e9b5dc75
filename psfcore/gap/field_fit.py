"""Fit how the scatter of a transit changes linearly over the field, and test it against a constant PSF.

The fit is a full refit (`verdict.correction`) with the effect `field_dependent_scatter` without its quadratic part. The
test is the decrease of chi2 when the effect is fitted together with the PSF (`evidence.effect_fits`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from psfcore.errors import DataError
from psfcore.gap.corrected_psf import psf_of_refit
from psfcore.gap.effect import Effect
from psfcore.gap.evidence.effect_fits import fit_effects
from psfcore.gap.evidence.expected_gap import linear_model_of
from psfcore.gap.field_terms import HeldOutGaps, directions, held_out_gaps
from psfcore.gap.library.optics import EFFECTS, FIELD_DEPENDENT
from psfcore.gap.verdict.correction import Corrected, add_to_model
from psfcore.gap.view import View
from psfcore.psf import Psf
from psfcore.scatter.reconstruction import Progress, Solution, labelled

_LINEAR = ("x", "y")
_SIGNIFICANT = 0.01  # a larger p-value does not say that the scatter changes


@dataclass(frozen=True, eq=False)
class FieldFit:
    """A scatter that changes linearly over the field, fitted to a transit.

    Attributes
    ----------
    corrected
        The full refit.
    gain, p_value
        The decrease of chi2 from the constant PSF, and its p-value.
    directions
        Along which directions the images determine the change.
    gaps
        The gap in held-out images; None if there are too few images.
    """

    corrected: Corrected
    gain: float
    p_value: float
    directions: str
    gaps: HeldOutGaps | None

    def psf(self, name: str, version: str, provenance: dict[str, object]) -> Psf:
        """The fitted PSF with its terms, on the full reach."""
        return psf_of_refit(self.corrected, name, version, provenance)

    def lines(self) -> list[str]:
        """The change with its errors, the test, the directions and the gap, one sentence each."""
        (x, sigma_x), (y, sigma_y) = (self.corrected.parameters(FIELD_DEPENDENT)[name] for name in _LINEAR)
        total = self.corrected.solution.inversion.values["total"]
        better = "changes" if self.p_value < _SIGNIFICANT else "need not change"
        gaps = self.gaps
        return [
            f"the scatter {better} over the field: by {100 * x:+.1f} ± {100 * sigma_x:.1f} % from left to right, "
            f"{100 * y:+.1f} ± {100 * sigma_y:.1f} % from bottom to top, around {100 * total:.2f} % in "
            f"the centre; chi2 falls by {self.gain:.1f} (p {self.p_value:.2g})",
            self.directions,
            *([] if gaps is None else [str(gaps)]),
        ]

    def to_json(self) -> dict[str, object]:
        """The fit as JSON values."""
        values = self.corrected.values.items()
        return {
            "lines": self.lines(),
            "parameters": {name: {"value": v, "sigma": s, "unit": unit} for name, (v, s, unit) in values},
            "delta_chi2": self.gain,
            "p_value": self.p_value,
            "held_out": None if self.gaps is None else self.gaps.to_json(),
        }


def fit_field(
    solution: Solution, *, seed: int = 1, progress: Progress = lambda stage, step, steps: None
) -> FieldFit:
    """Fit a linear change of the scatter over the field.

    Raises DataError "field-needs-power-law" for another shape than the softened power law, and the errors of
    `add_to_model`.

    Parameters
    ----------
    solution
        The fit of the constant PSF.
    seed
        Seed of the simulation that scales chi2.
    """
    told = labelled(progress, "terms of the field")
    view = View(solution)
    effect = _linear()
    if (reason := effect.why_not(view)) is not None:
        raise DataError("field-needs-power-law", f"expected the shape softened-power-law: {reason}")
    model, _ = linear_model_of(view, (effect,), seed=seed, progress=told)
    fit = fit_effects(model, model.evidence.effects)
    corrected = add_to_model(solution, model.evidence.effects, fit, model, view=view, progress=told)
    base = len(corrected.model.evidence.base)
    step = corrected.model.fit(tuple(range(base, corrected.model.evidence.size)))
    values = [value for value, _, _ in corrected.values.values()]
    return FieldFit(
        corrected,
        fit.gain,
        fit.p_value,
        directions(values, step.covariance[base:, base:]),
        held_out_gaps(solution, model, corrected, seed=seed, progress=told),
    )


def _linear() -> Effect:
    """The effect without its quadratic part."""
    effect = next(one for one in EFFECTS if one.name == FIELD_DEPENDENT)
    changes = effect.changes
    return replace(
        effect,
        parameters=tuple(one for one in effect.parameters if one.name in _LINEAR),
        changes=lambda view: changes(view)[: len(_LINEAR)],
    )
