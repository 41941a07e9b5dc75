"""The full refits of a diagnosis, and the settled posterior: the linear model is replaced by full refits where it is not exact enough.

A plausible hypothesis is refitted if an error of its template (`likelihood.USUAL_ERROR`), or the curvature of the PSF
(`likelihood.CURVATURE`), would be visible in the data. The most probable hypothesis comes first, in its most probable form. Before
several effects are refitted together, the most probable of them is
refitted alone, for two reasons: this refit also gives the evidence of all pairs with this effect and of all fields beside it; and a
strong effect that is not linear can make a pair look more probable than the effect alone. The refits end when no plausible hypothesis
needs a refit, or after MOST_REFITS refits.

A field has no template error. It may therefore be more probable than a strong effect that is the true
cause, until this effect is refitted. So the plausible hypotheses are those that are plausible if no unknown cause acts.

The report names the effects of a hypothesis that is more probable than all others together. Its refit is made even if the
linear model is exact enough, and if this refit fails, the hypothesis is excluded. If it succeeds, the evidence of the linear
model stays: the evidence of a refit scatters by a few units, and the other hypotheses have no refit. A field is a change of the data,
not a model of a cause, so no failed refit excludes it.

If the refit of a pair fails, the triples with this pair are excluded too. A refit that did not settle counts for nothing: the
evidence of the linear model stays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from psfcore.errors import DataError
from psfcore.gap.effect import Effect
from psfcore.gap.evidence.effect_fits import EffectFit, fit_effects, label_of
from psfcore.gap.evidence.fields import LIKELY, Field, FieldColumns, with_field, with_likely
from psfcore.gap.evidence.fields import UNKNOWN as UNKNOWN_NAME
from psfcore.gap.evidence.likelihood import SCALES, Weighed
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.verdict.correction import Corrected, add_to_model
from psfcore.gap.verdict.posterior import NONE, Form, Posterior, at_refit, kind_of, name_of
from psfcore.gap.view import View, return_unused_memory
from psfcore.scatter.reconstruction import Progress, labelled

MOST_TRIES = 2
MOST_REFITS = 3  # for example, an effect alone, a pair that contains it, and a rival
VISIBLE = 9.0  # an error of the first order is visible if it adds this much to chi2
PLAUSIBLE = 0.02
LEADING = 0.5

# A function that makes a full refit of a form. It returns the evidence of this form, and of the other forms that the refit also
# tests, with the model in which they were weighed; None if the refit failed; no evidence if the error of the first order is still
# larger than the number that it gets.
Refit = Callable[[Form, float], "tuple[Mapping[Form, Weighed], LinearModel] | None"]


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
                    progress=labelled(self._progress, f"full refit with {label}"),
                )
            except DataError as error:  # the fit may fail if the subtracted effect is not in the images
                self.failures.append(f"The full refit with {label} in the model failed: {error}")
                self._made[form] = None
            return_unused_memory()
        return self._made[form]


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


# --- the settled posterior ---------------------------------------------------------------------------------


def settled_posterior(linear: Posterior, refit: Refit) -> Posterior:
    """The posterior after the full refits, without the hypotheses whose refit failed.

    linear: the posterior of the linear model. refit: makes the full refit of a form.
    """
    now = linear
    done: set[Form] = set()
    for _ in range(MOST_REFITS):
        inexact = _to_refit(now, done)
        form = inexact or _leading(now, done)
        if form is None:
            break
        done.add(form)
        real = refit(form, max(VISIBLE, now.forms[form].visible_error))
        if real is None:  # the images do not contain the effects as the linear fit states them
            if form.field is None:
                # The linear evidence of the triples with a failed pair is not trusted either.
                own = set(form.effects)
                now = now.without(
                    f for f in now.forms if f == form or (len(own) > 1 and own < set(f.effects))
                )
        elif real[0] and inexact is not None:
            # The refit of a form itself is more exact than its evidence at the refit of another one.
            new = {one: weighed for one, weighed in real[0].items() if one == form or one not in done}
            stale = [one for one in _stale(now, form) if one not in new and one not in done]
            now = now.without(stale).with_evidence(new, real[1])
    return now


def _stale(now: Posterior, refitted: Form) -> list[Form]:
    """The forms whose linear evidence the refit of one effect contradicts.

    The refit weighs this effect alone, its pairs, and the triples of the best pair. The linear model overestimates the
    other triples with this effect, if the effect is strong.
    """
    if len(refitted.effects) > 1 or refitted.field is not None:
        return []
    own = set(refitted.effects)
    return [form for form in now.forms if kind_of(form.effects) == "triple" and own < set(form.effects)]


def _to_refit(now: Posterior, done: set[Form]) -> Form | None:
    """The form of the most probable hypothesis for which the linear model is not exact enough, or one of its effects."""
    probabilities = now.probabilities()
    of_known = sum(share for names, share in probabilities.items() if UNKNOWN_NAME not in names)
    for names, share in probabilities.items():
        if share < PLAUSIBLE * max(of_known, 1e-300):
            return None
        form = now.leading(names)
        if names == NONE or form in done or now.forms[form].visible_error <= VISIBLE or not form.refittable:
            continue
        alone = [Form((name,)) for name in form.effects]
        if len(alone) + (form.field is not None) > 1 and alone and not done.intersection(alone):
            return max(alone, key=lambda one: now.forms[one].log_evidence if one in now.forms else -1e300)
        return form
    return None


def _leading(now: Posterior, done: set[Form]) -> Form | None:
    """The form of the hypothesis that is more probable than all others together, if it has no field and was not refitted yet."""
    names, share = next(iter(now.probabilities().items()))
    form = now.leading(names)
    return form if share > LEADING and names != NONE and form not in done and form.field is None else None
