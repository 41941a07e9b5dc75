"""The limits: what the data of a transit could have shown, and which effects they cannot tell apart.

The strength of an effect is the value t of one of its parameters while its other parameters are 0. Then the score of
the columns H of the effect (`closed_form`) is

    s_H = t N_Hj + z,    z ~ Normal(0, N_HH)                                                             Eq. (1)

found_90 is the smallest strength at which the effect alone excludes "no cause" FLOOR to 1 (`answer`) with a probability
of 90 %: the 10 % quantile of its ln E over DRAWS of z. The strength of a random field is the standard deviation of its
coefficients; they are drawn too.

excluded_95 is the 95 % quantile of the strength, fitted beside the told causes: a Gaussian with the fitted value and
its error, cut at 0 for a parameter that cannot be negative. For a random field it is the quantile of the likelihood of
the data as a function of the standard deviation.

The distance of two effects is the square root of the chi2 that remains if the second one is fitted to the change by the
first one at found_90. Below ALIKE the data cannot tell them apart.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq
from scipy.special import logsumexp, ndtr, ndtri

from psfcore.gap.effect import Effect
from psfcore.gap.evidence.closed_form import ClosedForm, Form, Variant
from psfcore.gap.evidence.tree import listed
from psfcore.gap.schema import EffectLimitsJson, LimitsJson, ParameterLimitsJson
from psfcore.gap.verdict.answer import FLOOR, NONE, ONE, prior_of

FOUND, EXCLUDED = 0.9, 0.95
ALIKE = 3.0  # in sigma: a difference of chi2 of 9
DRAWS, SEED = 500, 1
# Strengths between these multiples of the error of the parameter are tried.
WEAKEST_TRIED, STRONGEST_TRIED, TRIED = 0.5, 3000.0, 48
CREDIBLE = 1000.0  # a strength above this multiple of the likely size is not stated
ENDLESS = "the likely size of a parameter is infinite, so no strength is plausible"
RMS = "rms"  # the parameter of a random field: the standard deviation of its coefficients


@dataclass(frozen=True)
class ParameterLimits:
    """The limits of one parameter, in its unit.

    Attributes
    ----------
    likely
        The largest plausible size of the parameter.
    found_90
        The smallest strength that is found with a probability of 90 %; None if no strength would be found.
    excluded_95
        The 95 % quantile of the strength; None before there are data.
    """

    name: str
    unit: str
    likely: float
    found_90: float | None
    excluded_95: float | None

    def as_json(self, *, observed: bool = True) -> ParameterLimitsJson:
        """The limits for a report; with `excluded_95` only if there are data (`observed`), because only data can
        exclude strengths.
        """
        content: ParameterLimitsJson = {"unit": self.unit, "found_90": self.found_90}
        return {**content, "excluded_95": self.excluded_95} if observed else content


@dataclass(frozen=True)
class EffectLimits:
    """The limits of one effect: one entry for each parameter, valid if the other parameters are 0."""

    parameters: tuple[ParameterLimits, ...]

    @property
    def leading(self) -> ParameterLimits:
        """The parameter whose limits are stated for the effect: the first whose found_90 is at most its likely size.

        If there is none, it is the parameter with the smallest ratio of found_90 to likely size.
        """

        def multiple(one: ParameterLimits) -> float:
            return math.inf if one.found_90 is None else max(one.found_90 / one.likely, 1.0)

        return min(self.parameters, key=multiple)

    def as_json(self, *, observed: bool = True) -> EffectLimitsJson:
        """The limits of the leading parameter. If the effect has several parameters, the limits of all parameters are
        added.
        """
        leading, every = self.leading, {p.name: p.as_json(observed=observed) for p in self.parameters}
        content = EffectLimitsJson(parameter=leading.name, unit=leading.unit, found_90=leading.found_90)
        if observed:
            content["excluded_95"] = leading.excluded_95
        if len(every) > 1:
            content["parameters"] = every
        return content


@dataclass(frozen=True)
class Alike:
    """Two effects that these data cannot tell apart.

    Attributes
    ----------
    would_separate
        An observation that could tell them apart.
    """

    pair: tuple[str, str]
    distance: float
    would_separate: str


@dataclass(frozen=True)
class Limits:
    """The limits of all effects, by name.

    Attributes
    ----------
    distances
        The distance of every pair of effects, in sigma.
    alike
        The pairs that the data cannot tell apart.
    untestable
        The reasons why effects cannot be tested, by name.
    """

    effects: Mapping[str, EffectLimits]
    distances: Mapping[tuple[str, str], float]
    alike: tuple[Alike, ...]
    untestable: Mapping[str, str]

    def after_refit(self, effect: Effect, fitted: Mapping[str, tuple[float, float]]) -> Limits:
        """The same limits, with excluded_95 of an effect from a full refit.

        Parameters
        ----------
        fitted
            Value and error of each parameter, by its name.
        """
        new = {
            p.name: upper_limit(*fitted[p.name], p.positive) for p in effect.parameters if p.name in fitted
        }
        parameters = self.effects[effect.name].parameters
        own = EffectLimits(tuple(replace(p, excluded_95=new.get(p.name, p.excluded_95)) for p in parameters))
        return replace(self, effects={**self.effects, effect.name: own})

    def as_json(self, *, observed: bool = True) -> LimitsJson:
        """`limits`, `alike` and `untestable` as in a report.

        Parameters
        ----------
        observed
            Whether there are data, which can exclude strengths.
        """
        return {
            "limits": {name: one.as_json(observed=observed) for name, one in self.effects.items()},
            "alike": [vars(one) | {"pair": list(one.pair)} for one in self.alike],
            "untestable": [{"name": name, "why": why} for name, why in self.untestable.items()],
        }


def limits(closed: ClosedForm, beside: Sequence[Variant] = (), *, observed: bool = True) -> Limits:
    """The limits of all effects.

    Parameters
    ----------
    beside
        The told causes, which act beside the effects.
    observed
        Whether the data are real; only then they can exclude strengths.
    """
    evidence = closed.model.evidence
    own = {
        form.effect: form for form in closed.forms if form.field is None and form.effect and not form.is_sun
    }
    endless = [name for name, form in own.items() if not np.isfinite(form.likely).all()]
    prior = prior_of(closed.forms)
    effects, settled_by = {}, {effect.name: effect.settled_by for effect in evidence.effects}
    for effect in evidence.effects:
        form = own.get(effect.name)
        if form is None or effect.name in endless:
            continue
        least = math.log(FLOOR * NONE / (ONE * prior[form]))
        rows = []
        for k in [None] if effect.field else range(form.columns.size):
            one, excluded = effect.parameters[k or 0], None
            if observed:
                others = [one for one in beside if one.form is not form]
                excluded = _excluded_rms(closed, form) if k is None else _excluded(closed, form, k, others)
            found = _found(closed, form, k, least)
            name = RMS if k is None else one.name
            rows.append(ParameterLimits(name, one.unit, one.likely, found, excluded))
        effects[effect.name] = EffectLimits(tuple(rows))
    distances = _distances(closed, {name: own[name] for name in effects}, effects)
    alike = (
        Alike(pair, distance, listed(settled_by[name] for name in pair))
        for pair, distance in distances.items()
        if distance < ALIKE
    )
    untestable = evidence.untestable | dict.fromkeys(endless, ENDLESS)
    return Limits(effects, distances, tuple(sorted(alike, key=lambda one: one.distance)), untestable)


def _found(closed: ClosedForm, form: Form, k: int | None, least: float) -> float | None:
    """found_90 of parameter k of an effect, or, if k is None, of the standard deviation of a random field.

    Parameters
    ----------
    least
        The smallest ln E at which an effect is found.
    """
    normal = closed.normal(form.columns)
    values, vectors = np.linalg.eigh(normal)
    rng = np.random.default_rng(SEED)
    noise = (vectors * np.sqrt(np.maximum(values, 0.0))) @ rng.standard_normal((values.size, DRAWS))
    if k is None:
        drawn = rng.standard_normal((values.size, DRAWS)) * (form.likely / form.likely[0])[:, None]
        change, seen = normal @ drawn, float(np.diag(normal).mean())
    else:
        change, seen = normal[:, k : k + 1], float(normal[k, k])
    weights = []
    for variant in form.variants:
        inner = normal[np.ix_(variant.part, variant.part)] * np.outer(variant.width, variant.width)
        lower = np.linalg.cholesky(np.eye(variant.part.size) + inner)
        cost = float(np.log(np.diag(lower)).sum()) + variant.cost
        weights.append((np.linalg.inv(lower) * variant.width, cost, variant.part))

    def margin(strength: float) -> float:
        score = strength * change + noise
        each = [((white @ score[part]) ** 2).sum(axis=0) / 2 - cost for white, cost, part in weights]
        return float(np.quantile(logsumexp(np.array(each), axis=0), 1 - FOUND)) - least

    likely = float(form.likely[k or 0])
    return _first_found(margin, 1 / math.sqrt(seen), CREDIBLE * likely) if seen > 0 else None


def _first_found(margin: Callable[[float], float], unit: float, most: float) -> float | None:
    """The smallest strength, up to `most`, for which `margin` is at least 0; None if there is none.

    Parameters
    ----------
    unit
        The error of the strength.
    """
    if most <= WEAKEST_TRIED * unit:
        return None
    tried = np.geomspace(WEAKEST_TRIED * unit, min(STRONGEST_TRIED * unit, most), TRIED)
    first = next((n for n, strength in enumerate(tried) if margin(float(strength)) >= 0), None)
    if not first:
        return None if first is None else float(tried[0])
    return float(brentq(margin, tried[first - 1], tried[first], xtol=1e-3 * tried[first]))


def _excluded(closed: ClosedForm, form: Form, k: int, others: Sequence[Variant]) -> float:
    """excluded_95 of parameter k of an effect."""
    alone = Variant(replace(form, positive=np.zeros_like(form.positive)), np.array([k]), form.scales[-1], 0.0)
    values, covariance = closed.fitted([alone, *others])
    return upper_limit(float(values[0]), math.sqrt(max(float(covariance[0, 0]), 0.0)), bool(form.positive[k]))


def _excluded_rms(closed: ClosedForm, form: Form) -> float:
    """excluded_95 of the standard deviation of a random field."""
    normal, score = closed.normal(form.columns), closed.score(form.columns)[:, 0]
    shape = form.likely / form.likely[0]
    values, vectors = np.linalg.eigh(normal * np.outer(shape, shape))
    values, along = np.maximum(values, 0.0), vectors.T @ (score * shape)
    tried = np.linspace(0.0, 20 * float(form.likely[0]), 400)
    spread = 1 + np.outer(tried**2, values)
    log_likelihood = (tried[:, None] ** 2 * along**2 / spread - np.log(spread)).sum(axis=1) / 2
    share = np.cumsum(np.exp(log_likelihood - log_likelihood.max()))
    return float(np.interp(EXCLUDED, share / share[-1], tried))


def _distances(
    closed: ClosedForm, forms: Mapping[str, Form], effects: Mapping[str, EffectLimits]
) -> dict[tuple[str, str], float]:
    """The distance of every pair of effects: the smaller one of the two ways."""
    out = {}
    for pair in itertools.combinations(forms, 2):
        ways = [
            _distance(closed, forms[one], forms[other], effects[one]) for one, other in (pair, pair[::-1])
        ]
        known = [way for way in ways if way is not None]
        if known:
            out[pair] = min(known)
    return out


def _distance(closed: ClosedForm, true: Form, fitted: Form, at: EffectLimits) -> float | None:
    """What remains if one effect is fitted to the change by another one at its found_90, in sigma."""
    leading = at.leading
    if leading.found_90 is None:
        return None
    normal = closed.normal(np.concatenate([true.columns, fitted.columns]))
    here, own = slice(0, true.columns.size), slice(true.columns.size, None)
    if leading.name == RMS:  # the mean over its coefficients
        size = leading.found_90 * true.likely / true.likely[0]
    else:
        size = leading.found_90 * (np.arange(true.columns.size) == at.parameters.index(leading))
    across, covariance = normal[own, here], np.diag(size**2)
    inner = np.linalg.inv(normal[own, own] + np.diag((fitted.likely * fitted.scales[-1]) ** -2.0))
    left = np.sum((normal[here, here] - across.T @ inner @ across) * covariance)
    return math.sqrt(max(float(left), 0.0))


def upper_limit(value: float, sigma: float, positive: bool) -> float:
    """excluded_95 for a fitted value and its error: the 95 % quantile of the strength.

    The strength is a Gaussian, cut at 0, if the parameter cannot be negative; else the absolute value of a Gaussian.
    """
    if positive:
        below = float(ndtr(value / sigma)) if sigma > 0 else 1.0
        return value + sigma * -float(ndtri((1 - EXCLUDED) * below)) if below > 0 else sigma

    def beyond(strength: float) -> float:
        return float(ndtr((strength - value) / sigma) - ndtr((-strength - value) / sigma)) - EXCLUDED

    return float(brentq(beyond, 0.0, abs(value) + 5 * sigma)) if sigma > 0 else abs(value)
