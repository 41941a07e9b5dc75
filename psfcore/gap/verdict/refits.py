"""The full refits of a diagnosis. Each refit is made only once and then kept."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.gap.effect import Effect
from psfcore.gap.evidence.effect_fits import EffectFit, fit_effects, label_of
from psfcore.gap.evidence.likelihood import Weighed
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.verdict.correction import Corrected, add_to_model
from psfcore.gap.verdict.posterior import Names, at_refit
from psfcore.gap.view import View, return_unused_memory
from psfcore.scatter.reconstruction import Progress

VISIBLE_SIGMA = 2.0
MOST_TRIES = 2


class Refits:
    """Full refits with effects in the model. view, model: the view and the linear model of the fit. failures: sentences."""

    def __init__(
        self, view: View, model: LinearModel, progress: Progress = lambda stage, step, steps: None
    ) -> None:
        self._view, self._model, self._progress = view, model, progress
        self._made: dict[Names, Corrected | None] = {}
        self.failures: list[str] = []

    def weighed(self, names: Names, most_visible: float = math.inf) -> Mapping[Names, Weighed] | None:
        """The evidence of hypotheses, computed at the refit of `names` (`posterior.at_refit`); None if the refit
        failed. Empty if it did not settle: the error of its first order, `Weighed.visible_error`, is larger than most_visible."""
        made = self._fit(names)
        if made is None:
            return None
        effects = self._model.evidence.effects
        model = made.model if made.beside is None else made.beside
        moved = made.solution.inversion.coordinates - self._view.solution.inversion.coordinates
        found = at_refit(model, self._model, names, made.subtracted, moved, effects)
        if found[names].visible_error > most_visible:
            self.failures.append(
                f"The full refit with {label_of(names)} in the model did not settle; the linear model was used instead."
            )
            self._made[names] = None
            return {}
        return found

    @property
    def made(self) -> tuple[Corrected, ...]:
        """All refits that succeeded."""
        return tuple(fit for fit in self._made.values() if fit is not None)

    def of(self, hypotheses: Sequence[Names]) -> tuple[Corrected, ...]:
        """The refits of these hypotheses, in this order, if they succeed: of the first MOST_TRIES until one succeeds, and of
        those that were refitted before. No other refits are made, because each takes as long as the fit."""
        found: list[Corrected] = []
        for place, names in enumerate(hypotheses):
            fit = self._fit(names) if not found and place < MOST_TRIES else self._made.get(names)
            found += [] if fit is None else [fit]
        return tuple(found)

    @property
    def departures(self) -> dict[Names, float]:
        """The measured template error of each refit: how far the refit differs from the first order.

        It is the rms difference between the residuals of the linear fit and of the refit in the cells, divided by the
        rms change of the cells by the effect. If the effects change the cells by less than VISIBLE_SIGMA, noise
        dominates, and the refit is left out.
        """
        out = {}
        for names, made in self._made.items():
            if made is None or made.evidence.images != self._model.evidence.images:
                continue
            linear = fit_effects(self._model, made.effects, any_sign=True).step
            left = self._model.left(linear)
            real = made.model.left(made.model.fit(made.evidence.of_effects))
            base = len(self._model.evidence.base)
            own = list(linear.columns[base:])
            change = [disc.jacobian[own].T @ linear.values[base:] for disc in self._model.discs]
            size = _rms(change)
            if size > VISIBLE_SIGMA:
                out[names] = _rms([a - b for a, b in zip(left, real, strict=True)]) / size
        return out

    def _fit(self, names: Names) -> Corrected | None:
        if names not in self._made:
            chosen = [effect for effect in self._model.evidence.effects if effect.name in names]
            # The pairs with a single effect are weighed at its refit.
            alone = len(names) == 1
            beside = [effect for effect in self._model.evidence.effects if alone and effect not in chosen]
            label = label_of(names)
            try:
                self._made[names] = add_to_model(
                    self._view.solution,
                    chosen,
                    self._start(chosen),
                    self._model,
                    beside=beside,
                    view=self._view,
                    progress=self._say(f"full refit with {label}"),
                )
            except DataError as error:  # the fit may fail if the subtracted effect is not in the images
                self.failures.append(f"The full refit with {label} in the model failed: {error}")
                self._made[names] = None
            return_unused_memory()
        return self._made[names]

    def _start(self, effects: Sequence[Effect]) -> EffectFit:
        """The linear fit from which a refit starts.

        The fit leaves out parameters with the wrong sign or with too little gain. If it leaves out all parameters of an
        effect, it is repeated with all parameters.
        """
        start = fit_effects(self._model, effects)
        kept = set(start.step.columns)
        if all(kept.intersection(self._model.evidence.columns[effect.name]) for effect in effects):
            return start
        return fit_effects(self._model, effects, any_sign=True)

    def _say(self, what: str) -> Progress:
        return lambda stage, step, steps: self._progress(f"{what}: {stage}", step, steps)


def _rms(vectors: Sequence[NDArray[np.float64]]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(vectors) ** 2)))
