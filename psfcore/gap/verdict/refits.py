"""The full refits of a diagnosis. Each refit is made only once and then kept."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.gap.effect import Effect
from psfcore.gap.evidence.effect_fits import EffectFit, fit_effects, label_of
from psfcore.gap.evidence.fields import LIKELY, Field, FieldColumns, with_field, with_likely
from psfcore.gap.evidence.likelihood import SCALES, Weighed
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.verdict.correction import Corrected, add_to_model
from psfcore.gap.verdict.posterior import Form, at_refit, name_of
from psfcore.gap.view import View, return_unused_memory
from psfcore.scatter.reconstruction import Progress

VISIBLE_SIGMA = 2.0
MOST_TRIES = 2


class Refits:
    """Full refits of forms of hypotheses.

    view, model: the view and the linear model of the fit. columns: its fields. failures: sentences.
    """

    def __init__(
        self, view: View, model: LinearModel, progress: Progress = lambda stage, step, steps: None
    ) -> None:
        self._view, self._model, self._progress = view, model, progress
        self.columns = FieldColumns(model.evidence)
        self._order = tuple(effect.name for effect in model.evidence.effects)
        self._made: dict[Form, Corrected | None] = {}
        self._with_field: dict[Field, LinearModel] = {}
        self.failures: list[str] = []

    def weighed(
        self, form: Form, most_visible: float = math.inf
    ) -> tuple[Mapping[Form, Weighed], LinearModel] | None:
        """The evidence of forms, computed at the refit of `form` (`posterior.at_refit`), and the model; None if the refit
        failed. No evidence if it did not settle: the error of its first order, `Weighed.visible_error`, is larger than
        most_visible."""
        refit = self._fit(form)
        if refit is None:
            return None
        at = refit.model if refit.beside is None else refit.beside
        moved = refit.solution.inversion.coordinates - self._view.solution.inversion.coordinates
        evidence, model = at_refit(
            at, self.model_with(form), self.columns, form, refit.subtracted, moved, self._order
        )
        if evidence[form].visible_error > most_visible:
            self.failures.append(
                f"The full refit with {refit.label} in the model did not settle; the linear model was used instead."
            )
            self._made[form] = None
            return {}, model
        return evidence, model

    def model_with(self, form: Form) -> LinearModel:
        """The linear model without any refit, in which the field of a form is an effect."""
        if form.field is None:
            return self._model
        if form.field not in self._with_field:
            name = name_of(form.field, self._order)
            self._with_field[form.field] = model_with_field(self._model, self.columns, form.field, name)
        return self._with_field[form.field]

    @property
    def made(self) -> dict[Form, Corrected]:
        """All refits that succeeded."""
        return {form: fit for form, fit in self._made.items() if fit is not None}

    def of(self, forms: Sequence[Form]) -> tuple[Corrected, ...]:
        """The refits of these forms, in this order, if they succeed: of the first MOST_TRIES until one succeeds, and of
        those that were refitted before. No other refits are made, because each takes as long as the fit."""
        found: list[Corrected] = []
        for place, form in enumerate(forms):
            fit = self._fit(form) if not found and place < MOST_TRIES else self._made.get(form)
            found += [] if fit is None else [fit]
        return tuple(found)

    @property
    def departures(self) -> list[float]:
        """The measured template error of each refit: how far the refit differs from the first order.

        It is the rms difference between the residuals of the linear fit and of the refit in the cells, divided by the
        rms change of the cells by the effect. If the effects change the cells by less than VISIBLE_SIGMA, noise
        dominates, and the refit is left out.
        """
        out = []
        for form, refit in self.made.items():
            before = self.model_with(form)
            if refit.evidence.images != before.evidence.images:
                continue
            linear = fit_effects(before, refit.effects, any_sign=True).step
            left = before.left(linear)
            real = refit.model.left(refit.model.fit(refit.evidence.of_effects))
            base = len(before.evidence.base)
            own = list(linear.columns[base:])
            change = [disc.jacobian[own].T @ linear.values[base:] for disc in before.discs]
            size = _rms(change)
            if size > VISIBLE_SIGMA:
                out.append(_rms([a - b for a, b in zip(left, real, strict=True)]) / size)
        return out

    def _fit(self, form: Form) -> Corrected | None:
        if form not in self._made:
            model = self.model_with(form)
            names = form.names(self._order)
            effects = [effect for effect in model.evidence.effects if effect.name in names]
            # The pairs with a single effect are weighed at its refit.
            alone = form.field is None and len(names) == 1
            beside = [effect for effect in model.evidence.effects if alone and effect not in effects]
            label = label_of(names)
            try:
                self._made[form] = add_to_model(
                    self._view.solution,
                    effects,
                    linear_start(model, effects),
                    model,
                    beside=beside,
                    view=self._view,
                    progress=self._say(f"full refit with {label}"),
                )
            except DataError as error:  # the fit may fail if the subtracted effect is not in the images
                self.failures.append(f"The full refit with {label} in the model failed: {error}")
                self._made[form] = None
            return_unused_memory()
        return self._made[form]

    def _say(self, what: str) -> Progress:
        return lambda stage, step, steps: self._progress(f"{what}: {stage}", step, steps)


def linear_start(model: LinearModel, effects: Sequence[Effect]) -> EffectFit:
    """The linear fit of effects from which a refit starts.

    The fit leaves out parameters with the wrong sign or with too little gain. If it leaves out all parameters of an
    effect, it is repeated with all parameters.
    """
    start = fit_effects(model, effects)
    kept = set(start.step.columns)
    if all(kept.intersection(model.evidence.columns[effect.name]) for effect in effects):
        return start
    return fit_effects(model, effects, any_sign=True)


def model_with_field(model: LinearModel, columns: FieldColumns, field: Field, name: str) -> LinearModel:
    """The linear model with a field as an effect of this name.

    The likely size S of its coefficients theta follows from the data (MacKay 1992): S^2 = sum of theta^2 / sum of (1 - Var / W^2),
    with the fitted values and variances for a prior of the width W. It is at least LIKELY.
    """
    widest = SCALES[-1] * LIKELY
    effect = with_likely(columns.effect(field, name), widest)
    directions = columns.of(field)
    evidence = with_field(model.evidence, effect, directions)
    step = replace(model, evidence=evidence).fit(evidence.columns[name])
    own = slice(len(evidence.base), None)
    known = float(np.sum(1 - np.diag(step.covariance)[own] / widest**2))
    size = float(np.sqrt(np.sum(step.values[own] ** 2) / max(known, 1e-9)))
    sized = with_likely(effect, float(np.clip(size, LIKELY, widest)))
    effects = tuple(sized if one is effect else one for one in evidence.effects)
    return replace(model, evidence=replace(evidence, effects=effects))


def _rms(vectors: Sequence[NDArray[np.float64]]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(vectors) ** 2)))
