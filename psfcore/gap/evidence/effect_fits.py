"""The linear fit of one or several effects, as a report states it: parameters, gain and p-value; and the p-value of the
gap.

The gain of an effect is the decrease of chi2 when its parameters are fitted together with the PSF. From noise alone, a
free parameter gains a chi2 variable with one degree of freedom, and the parameters of a random field gain less
(`linear_model`, Eq. (3)). If an effect searched among many templates, its p-value is multiplied by their number.

The p-value of the gap is the probability of residuals at least as large as these if there is no gap: the smallest
p-value of chi2 of all cells, of the means of the discs, and of the blocks of the unocculted field, after the fit of the
PSF alone, times three.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from psfcore.arrays import Vector
from psfcore.gap.effect import Effect
from psfcore.gap.evidence.linear_model import LinearModel, Step

# Chi2 of the unocculted field may exceed its degrees of freedom by this fraction without a gap: the Sun always changes
# a little.
UNOCCULTED_WIDTH = 0.03


@dataclass(frozen=True, eq=False)
class EffectFit:
    """The linear fit of one effect, or of several effects, together with the PSF.

    Attributes
    ----------
    values
        Value, error and unit of each parameter; the key is "parameter", or "effect.parameter" if there are several
        effects.
    gain
        The decrease of chi2 by the effects.
    p_value
        The p-value of the gain.
    step
        The fit of the columns of the effects.
    model
        The model that was fitted.
    """

    names: tuple[str, ...]
    values: dict[str, tuple[float, float, str]]
    gain: float
    p_value: float
    step: Step
    model: LinearModel

    @property
    def label(self) -> str:
        """The names of the effects, as the report writes them."""
        return label_of(self.names)


def label_of(names: Sequence[str]) -> str:
    """Names of effects, as the report writes them."""
    return " + ".join(names)


def fit_effects(model: LinearModel, effects: Sequence[Effect], *, any_sign: bool = False) -> EffectFit:
    """Fit the coordinates of the PSF together with these effects.

    A parameter that must be positive is left out if its fitted value is not positive.

    Parameters
    ----------
    any_sign
        Whether to keep all parameters, whatever their sign.
    """
    columns = {
        column: (effect, parameter)
        for effect in effects
        # An effect that is fitted for each pointing may have fewer or more changes than parameters.
        for column, parameter in zip(model.evidence.columns[effect.name], effect.parameters, strict=False)
    }
    step = model.fit(tuple(columns))
    base = len(model.evidence.base)
    while not any_sign:
        below = {
            column: float(value)
            for column, value in zip(step.columns[base:], step.values[base:], strict=True)
            if columns[column][1].positive and value <= 0
        }
        if not below:
            break
        del columns[min(below, key=lambda column: below[column])]
        step = model.fit(tuple(columns))
    sigma = np.sqrt(np.maximum(np.diag(step.covariance), 0.0))
    values = {}
    for k, (effect, parameter) in enumerate(columns.values(), base):
        label = parameter.name if len(effects) == 1 else f"{effect.name}.{parameter.name}"
        values[label] = (float(step.values[k]), float(sigma[k]), parameter.unit)
    gain = model.gain(step)
    p_value = _p_value(model, tuple(columns), gain, math.prod(effect.trials for effect in effects))
    return EffectFit(tuple(effect.name for effect in effects), values, gain, p_value, step, model)


def left_chi2(model: LinearModel, step: Step) -> Vector:
    """chi2 after a fit: two values, for the discs and for the unocculted field."""
    return np.array([sum(float(one @ one) for one in model.left(step)), model.left_unocculted(step)])


def _p_value(model: LinearModel, columns: Sequence[int], gain: float, trials: float) -> float:
    """The probability that noise alone gives at least this gain, times the number of trials (at most 1).

    The distribution of the gain from noise alone is approximated by a scaled chi2 distribution with the same mean and
    variance.
    """
    learned = model.learned(columns)
    shares = learned / (1 + learned)
    free = len(columns) - learned.size
    mean, half_variance = free + float(shares.sum()), free + float((shares**2).sum())
    if half_variance <= 0:
        return 1.0
    scale = mean / half_variance
    return min(1.0, trials * float(chdtrc(mean * scale, gain * scale)))


def p_value_of_gap(model: LinearModel) -> float:
    """The p-value of the gap of a linear model."""
    cells, blocks = left_chi2(model, model.base)
    light = (
        white.white @ disc.expected for disc, white in zip(model.evidence.discs, model.discs, strict=True)
    )
    # Chi2 of the means of the discs: one value for each disc.
    means = [
        float(one @ left) ** 2 / max(float(one @ one), 1e-300)
        for one, left in zip(light, model.left(model.base), strict=True)
    ]
    fitted = len(model.base.columns)
    tests = (
        (max(sum(disc.residual.size for disc in model.discs) - fitted, 1), cells),
        (max(len(means) - fitted, 1), sum(means)),
        (model.evidence.all_unocculted.independent, blocks / (1 + UNOCCULTED_WIDTH)),
    )
    return min(1.0, len(tests) * min(float(chdtrc(count, max(chi2, 0.0))) for count, chi2 in tests))
