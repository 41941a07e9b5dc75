"""The limits: what the data of a transit could have shown, and which effects they cannot tell apart.

The strength of an effect is the value t of one of its parameters while its other parameters are 0. Near the fit the data
change by t times a column j of the Jacobian. Let N be the normal matrix of all columns, with PSF, scenes and brightness free
(`Likelihood.normal`). Consider a hypothesis h with columns H and a prior of the widths W. The eigenvalues of W N_HH W are l_i, its
eigenvectors V. The decrease of chi2 by the fit of h is a weighted sum of noncentral chi2 variables with one degree of freedom:

    q_h = sum of w_i chi2_1(d_i^2),   w_i = l_i / (1 + l_i),   d_i^2 = t^2 (V^T W N_Hj)_i^2 / l_i      Eq. (1)
    ln(weight of h / weight of no effect) = o_h - sum of ln(1 + l_i) / 2 + q_h / 2                     Eq. (2)

In place of q_h / 2, the code uses the gain of Eq. (2) of `evidence.likelihood`, which is a little smaller.
o_h contains the prior probability of h, the number of templates among which it chose, and ln 2 for a parameter that cannot be
negative. The noise-free gain of h is the sum of w_i d_i^2. The cumulants of q_h are c_r = sum of w_i^r (1 + r d_i^2),
without the factor 2^(r-1) (r-1)!. The quantiles of q_h follow from the quantiles of a chi2 variable with the same first
three cumulants (Imhof 1961, Biometrika 48, 419), and these from the formula of Wilson & Hilferty. If the prior has
several widths, Eq. (2) is averaged over them.

found_90 is the smallest strength at which the effect belongs to the answer and "no effect" does not, computed with the
10 % quantile of every q_h. Hypotheses that resemble the effect have q_h that vary together with its own; the q_h of
other hypotheses hardly count.

The strength of a random field is the standard deviation of its coefficients. Because the coefficients are random, the
change by the effect is random too. It adds to the covariance of the scores of h, which becomes N_HH + t^2 N_HE S^2
N_EH; E are the columns of the field, and S are the likely sizes of its coefficients.

excluded_95 is the 95 % quantile of the strength after the fit of the effect: a Gaussian with the fitted value and its error,
cut at 0 for a parameter that cannot be negative. The error contains the template error of `evidence.likelihood`.

The distance of two effects is the square root of the chi2 that remains if the second one is fitted to the change by the first
one at found_90. Below ALIKE the data cannot tell them apart.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, nnls
from scipy.special import logsumexp, ndtr, ndtri

from psfcore.gap.effect import Effect
from psfcore.gap.evidence.fields import LIKELY, FieldColumns, widest_fields
from psfcore.gap.evidence.likelihood import MEASURED, SCALES, Likelihood
from psfcore.gap.evidence.linear_model import WEAKEST, LinearModel
from psfcore.gap.verdict.posterior import PRIOR, Kind

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

FOUND, EXCLUDED = 0.9, 0.95
ALIKE = 3.0  # in sigma: a difference of chi2 of 9
# Strengths between these multiples of the error of the parameter are tried.
WEAKEST_TRIED, STRONGEST_TRIED, TRIED = 0.5, 3000.0, 80
CREDIBLE = 1000.0  # a strength above this multiple of the likely size is not stated
ENDLESS = "the likely size of a parameter is infinite, so no strength is plausible"
RMS = "rms"  # the parameter of a random field: the standard deviation of its coefficients


@dataclass(frozen=True)
class ParameterLimits:
    """The limits of one parameter, in its unit.

    likely: the largest plausible size. found_90: None if no strength would be found. excluded_95: None before there are data.
    """

    name: str
    unit: str
    likely: float
    found_90: float | None
    excluded_95: float | None

    def as_json(self, *, observed: bool = True) -> dict[str, Any]:
        """The limits for a report. observed: whether there are data, which can exclude strengths."""
        content = {"unit": self.unit, "found_90": self.found_90}
        return content | ({"excluded_95": self.excluded_95} if observed else {})


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
            return math.inf if one.found_90 is None else one.found_90 / one.likely

        first = next((one for one in self.parameters if multiple(one) <= 1), None)
        return first or min(self.parameters, key=multiple)

    def as_json(self, *, observed: bool = True) -> dict[str, Any]:
        """The limits of the leading parameter. If the effect has several parameters, the limits of all parameters are added."""
        content = {"parameter": self.leading.name} | self.leading.as_json(observed=observed)
        if len(self.parameters) > 1:
            content["parameters"] = {one.name: one.as_json(observed=observed) for one in self.parameters}
        return content


@dataclass(frozen=True)
class Alike:
    """Two effects that these data cannot tell apart. would_separate: an observation that could tell them apart."""

    pair: tuple[str, str]
    distance: float
    would_separate: str

    def as_json(self) -> dict[str, Any]:
        """The pair for a report."""
        return {"pair": list(self.pair), "distance": self.distance, "would_separate": self.would_separate}


@dataclass(frozen=True)
class Limits:
    """The limits of all effects, by name.

    distances: the distance of every pair of effects, in sigma. alike: the pairs that the data cannot tell apart.
    untestable: the reasons why effects cannot be tested, by name.
    """

    effects: Mapping[str, EffectLimits]
    distances: Mapping[tuple[str, str], float]
    alike: tuple[Alike, ...]
    untestable: Mapping[str, str]

    def after_refit(self, effect: Effect, fitted: Mapping[str, tuple[float, float]]) -> Limits:
        """The same limits, with excluded_95 of an effect from a full refit. fitted: value and error by parameter."""
        positive = {parameter.name: parameter.positive for parameter in effect.parameters}
        parameters = tuple(
            replace(one, excluded_95=upper_limit(*fitted[one.name], positive[one.name]))
            if one.name in fitted
            else one
            for one in self.effects[effect.name].parameters
        )
        return replace(self, effects={**self.effects, effect.name: EffectLimits(parameters)})

    def as_json(self, *, observed: bool = True) -> dict[str, Any]:
        """`limits`, `alike` and `untestable` as in a report. observed: as in `ParameterLimits`."""
        return {
            "limits": {name: one.as_json(observed=observed) for name, one in self.effects.items()},
            "alike": [one.as_json() for one in self.alike],
            "untestable": [{"name": name, "why": why} for name, why in self.untestable.items()],
        }


def limits(
    model: LinearModel,
    *,
    threshold: float,
    temperature: float,
    prior: Mapping[Kind, float] = PRIOR,
    observed: bool = True,
    fields: FieldColumns | None = None,
) -> Limits:
    """The limits of all effects.

    threshold: the smallest probability of a hypothesis in the answer set. temperature, prior: the temperature and the
    prior of the posterior. observed: whether the residuals of the model come from real data. Only then they can exclude
    strengths. fields: the columns of the fields of the model, if they exist already.
    """
    every = model.evidence.effects
    endless = [e.name for e in every if not all(math.isfinite(p.likely) for p in e.parameters)]
    evidence = replace(model.evidence, effects=tuple(e for e in every if e.name not in endless))
    hypotheses = _Hypotheses(replace(model, evidence=evidence), prior, fields or FieldColumns(model.evidence))
    margin = partial(_margin, threshold=threshold, temperature=temperature)
    effects = {}
    for effect in evidence.effects:
        strengths = hypotheses.strengths(effect, margin)
        excluded = hypotheses.excluded(effect) if observed else [None] * len(strengths)
        rows = zip(effect.parameters, strengths, excluded, strict=False)
        effects[effect.name] = EffectLimits(
            tuple(
                ParameterLimits(RMS if effect.field else p.name, p.unit, p.likely, *limit)
                for p, *limit in rows
            )
        )
    settled_by = {effect.name: effect.settled_by for effect in evidence.effects}
    distances = hypotheses.distances(effects)
    alike = (
        Alike(pair, distance, "; or ".join(dict.fromkeys(settled_by[name] for name in pair)))
        for pair, distance in distances.items()
        if distance < ALIKE
    )
    untestable = evidence.untestable | dict.fromkeys(endless, ENDLESS)
    return Limits(effects, distances, tuple(sorted(alike, key=lambda one: one.distance)), untestable)


def _margin(log_odds: Matrix, threshold: float, temperature: float) -> Vector:
    """One number for each strength: 0 or more if the first hypothesis belongs to the answer and "no effect" does not.

    Otherwise the number is negative. log_odds: (hypotheses, strengths), ln of the weight of each hypothesis divided by the
    weight of "no effect". threshold, temperature: as in `limits`.
    """
    against = np.pad(log_odds / temperature, ((0, 1), (0, 0)))
    whole = logsumexp(against, axis=0)
    # The most probable hypothesis always belongs to the answer.
    first = np.maximum(against[0] - against[1:].max(axis=0), against[0] - whole - math.log(threshold))
    return np.asarray(np.minimum(whole + math.log(threshold), first))


@dataclass(frozen=True, eq=False)
class _Hypothesis:
    """A hypothesis, and the eigenvalues of Eq. (1).

    columns: its columns in `normal`, the normal matrix of all columns. widths: the widths of the prior (scales,
    columns). offset: o_h of Eq. (2). one_sided: whether it has a single parameter, which cannot be negative.
    """

    columns: NDArray[np.intp]
    widths: Matrix
    offset: float
    normal: Matrix
    one_sided: bool = False

    @cached_property
    def modes(self) -> list[tuple[Vector, Matrix]]:
        """For each scale of the prior: the eigenvalues l of W N_HH W, and V^T W.

        Every effect is compared with the same rivals, so the eigenvalues are computed once for each hypothesis.
        """
        inner = self.normal[np.ix_(self.columns, self.columns)]
        modes = []
        for widths in self.widths:
            values, vectors = np.linalg.eigh(inner * np.outer(widths, widths))
            modes.append((np.maximum(values, 0.0), vectors.T * widths))
        return modes


class _Hypotheses:
    """The normal matrix of all columns, and the hypotheses about the cause."""

    def __init__(self, model: LinearModel, prior: Mapping[Kind, float], columns: FieldColumns) -> None:
        evidence = self._evidence = model.evidence
        directions, fields = widest_fields(evidence, columns)
        self._likelihood = Likelihood(model).with_further(directions)
        self._columns = {e.name: list(evidence.columns_of(e.name).values()) for e in evidence.effects}
        unknown = [[evidence.size + k for k in field] for field in fields]
        shown = sorted({c for columns in (*self._columns.values(), *unknown) for c in columns})
        self._number = {column: k for k, column in enumerate(shown)}
        self._normal = self._likelihood.normal(shown)
        single = math.log(prior["single"] / max(len(evidence.effects), 1) / prior["none"])
        self._log_prior = {effect.name: single - math.log(effect.trials) for effect in evidence.effects}
        self._single = {effect.name: self._acting(effect) for effect in evidence.effects}
        offset = math.log(prior["unknown"] / len(unknown) / prior["none"])
        scales = LIKELY * np.array(SCALES)[:, None]
        self._unknown = [
            _Hypothesis(self._numbers(one), np.tile(scales, len(one)), offset, self._normal)
            for one in unknown
        ]

    def _numbers(self, columns: Sequence[int]) -> NDArray[np.intp]:
        """The numbers of columns of the evidence in the normal matrix."""
        return np.array([self._number[column] for column in columns], dtype=np.intp)

    def _acting(self, effect: Effect, part: Sequence[int] | None = None) -> _Hypothesis:
        """The hypothesis that an effect acts alone. part: the columns of the parameters that may act; None: all."""
        columns = self._columns[effect.name] if part is None else part
        prior = self._evidence.prior
        offset = self._log_prior[effect.name] - MEASURED * self._evidence.numbers_of(columns) / 2
        widths = np.array(SCALES)[:, None] * prior.likely[list(columns)]
        one_sided = len(columns) == 1 and bool(prior.positive[columns[0]])
        return _Hypothesis(self._numbers(columns), widths, offset, self._normal, one_sided)

    def _of_strength(self, columns: Sequence[int]) -> tuple[Matrix, float]:
        """For a strength of 1 of the parameters in these columns: the change of the scores (columns of N, columns), and its
        mean chi2. The strength of several parameters is the standard deviation of the first one."""
        likely, numbers = self._evidence.prior.likely[list(columns)], self._numbers(columns)
        return self._normal[:, numbers] * (likely / likely[0]), float(np.diag(self._normal)[numbers].mean())

    # --- strengths that would be found ------------------------------------------------------------------

    def strengths(self, effect: Effect, margin: Callable[[Matrix], Vector]) -> list[float | None]:
        """found_90 of every parameter of an effect. If the effect is a random field: that of its rms."""
        columns, prior = self._columns[effect.name], self._evidence.prior
        others = [*(h for name, h in self._single.items() if name != effect.name), *self._unknown]
        found = []
        for part in [columns] if effect.field else [[column] for column in columns]:
            change, seen = self._of_strength(part)
            own, rivals, sided = [self._single[effect.name]], others, 0.0
            if not effect.field:
                # A fit leaves out a positive parameter if its fitted value is negative. If the true value is 0, this happens in half
                # of all cases. ln E is therefore the mean of two values: with all parameters, and without those that may be left out.
                own += [self._acting(effect, [c for c in columns if c in part or not prior.positive[c]])]
                sided = math.log(2) if prior.positive[part[0]] else 0.0
                # A rival that would have to be negative cannot act.
                rivals = [h for h in others if not (h.one_sided and change[h.columns[0], 0] <= 0)]
            odds = [_odds_of(h, change, self._likelihood.gained, effect.field) for h in (*own, *rivals)]

            def margin_at(
                strengths: Vector, odds: Any = odds, own: int = len(own), more: float = sided
            ) -> Vector:
                every = np.array([one(strengths) for one in odds])
                return margin(np.vstack([every[:own].mean(axis=0) + more, every[own:]]))

            most = CREDIBLE * float(prior.likely[part[0]])
            found.append(_first_found(margin_at, 1 / math.sqrt(seen), most) if seen > 0 else None)
        return found

    # --- strengths that are excluded ----------------------------------------------------------------------

    def excluded(self, effect: Effect) -> list[float | None]:
        """The 95 % quantile of each parameter. If the effect is a random field: that of its rms."""
        columns = self._columns[effect.name]
        if effect.field:
            return [self._excluded_rms(columns)]
        weighed = self._likelihood.weigh([columns])
        values = dict(zip(weighed.columns, weighed.values.tolist(), strict=True))
        out: list[float | None] = []
        for column, parameter in zip(columns, effect.parameters, strict=False):
            acting = [c for c in columns if c in values or c == column]
            found, covariance = self._likelihood.fitted([acting], [values.get(c, 0.0) for c in acting])
            own = acting.index(column)
            sigma = math.sqrt(max(float(covariance[own, own]), 0.0))
            out.append(upper_limit(float(found[own]), sigma, parameter.positive))
        return out

    def _excluded_rms(self, columns: Sequence[int]) -> float | None:
        """The 95 % quantile of the standard deviation t of the coefficients of a random field, for a constant prior of t.

        ln L(t) is the sum of (z^2 t^2 l / (1 + t^2 l) - ln(1 + t^2 l)) / 2. l are the eigenvalues of S N S for t = 1.
        z are the scores in units of their noise without the field.
        """
        likely = self._evidence.prior.likely[list(columns)]
        found, covariance = self._likelihood.fitted([columns], np.zeros(len(columns)).tolist())
        shape = likely / likely[0]
        precision = np.linalg.pinv(covariance, hermitian=True)
        score = (
            precision @ found
        )  # the prior of the fit is a part of the precision, and does not shift the score
        information = precision - np.diag(likely**-2.0)
        values, vectors = np.linalg.eigh(information * np.outer(shape, shape))
        seen = values > WEAKEST * max(float(values[-1]), 1e-300)
        if not seen.any():
            return None
        size = values[seen]
        z2 = (vectors[:, seen].T @ (shape * score)) ** 2 / size
        unit = 1 / math.sqrt(float(size.max()))
        tried = unit * np.concatenate([[0.0], np.geomspace(1e-2, 1e5, 2000)])
        grown = tried[:, None] ** 2 * size
        log_like = ((z2 * grown / (1 + grown)) - np.log1p(grown)).sum(axis=1) / 2
        likelihood = np.exp(log_like - log_like.max())
        steps = np.diff(tried) * (likelihood[1:] + likelihood[:-1]) / 2
        total = np.concatenate([[0.0], np.cumsum(steps)])
        return float(np.interp(EXCLUDED * total[-1], total, tried))

    # --- effects that look alike --------------------------------------------------------------------------

    def distances(self, effects: Mapping[str, EffectLimits]) -> dict[tuple[str, str], float]:
        """The distance of every pair of effects: the smaller of both directions."""
        out = {}
        for one, other in itertools.combinations(self._evidence.effects, 2):
            both = (
                self._distance(one, other, effects[one.name].leading),
                self._distance(other, one, effects[other.name].leading),
            )
            known = [distance for distance in both if distance is not None]
            if known:
                out[one.name, other.name] = min(known)
        return out

    def _distance(self, acting: Effect, fitted: Effect, at: ParameterLimits) -> float | None:
        """The square root of the chi2 that remains if `fitted` is fitted to the change by `acting` with the strength found_90."""
        if at.found_90 is None:
            return None
        rival, prior = self._single[fitted.name], self._evidence.prior
        inner = self._normal[np.ix_(rival.columns, rival.columns)] + np.diag(rival.widths[-1] ** -2.0)
        columns = self._columns[acting.name]
        if not acting.field:
            columns = [columns[[parameter.name for parameter in acting.parameters].index(at.name)]]
        change = at.found_90 * self._of_strength(columns)[0]
        likely = prior.likely[columns]
        own = float(np.diag(change[self._numbers(columns)]) @ (at.found_90 * likely / likely[0]))
        change = change[rival.columns]
        if acting.field:
            explained = float(np.sum(change * np.linalg.solve(inner, change)))
        else:
            signs = (1.0,) if prior.positive[columns[0]] else (1.0, -1.0)
            positive = prior.positive[self._columns[fitted.name]]
            explained = max(_explained(inner, sign * change[:, 0], positive) for sign in signs)
        return math.sqrt(max(own - explained, 0.0))


def _explained(inner: Matrix, score: Vector, positive: NDArray[np.bool_]) -> float:
    """The decrease of chi2 by a fit; parameters that cannot be negative stay at 0 or above."""
    values = np.linalg.solve(inner, score)
    if (values[positive] < 0).any():
        # A parameter of any sign is the difference of two that are not negative.
        lower = np.linalg.cholesky(inner)
        design = np.concatenate([lower.T, -lower.T[:, ~positive]], axis=1)
        found, _ = nnls(design, np.linalg.solve(lower, score))
        return float(np.sum((design @ found) ** 2))
    return float(score @ values)


def _odds_of(
    hypothesis: _Hypothesis, change: Matrix, gained: Callable[[Vector], Vector], random: bool
) -> Callable[[Vector], Vector]:
    """A function of the strength: Eq. (2) with the 1 - FOUND quantile of q_h.

    change: the columns of N that belong to the true effect (columns of N, columns of the effect). random: whether the effect is
    a random field. gained: the gain of ln L by a decrease of chi2.
    """
    spread, sums = [], []
    for values, along in hypothesis.modes:
        spread.append(float(np.log1p(values).sum()))
        sums.append(cumulants(values, along @ change[hypothesis.columns], random=random))
    offsets = hypothesis.offset - np.array(spread) / 2

    def odds(strengths: Vector) -> Vector:
        powers = strengths[:, None] ** (2 * np.arange(4))
        found = [
            offset + gained(quantile_of_sum(powers @ c.T, 1 - FOUND))
            for offset, c in zip(offsets, sums, strict=True)
        ]
        return np.asarray(np.logaddexp.reduce(found) - math.log(len(found)))

    return odds


def cumulants(values: Vector, score: Matrix, *, random: bool) -> Matrix:
    """c_1, c_2, c_3 of Eq. (1) as polynomials of the squared strength (3, powers).

    score: V^T W N_HE (eigenvectors, columns of the true effect). random: whether the effect is a random field; otherwise it
    has one column.
    """
    out = np.zeros((3, 4))
    shrink = 1 / (1 + values)
    noise, size = values * shrink, shrink * (score**2).sum(axis=1)
    for r in (1, 2, 3):
        out[r - 1, :2] = np.sum(noise**r), r * np.sum(noise ** (r - 1) * size)
    if random:
        field = shrink[:, None] * (score @ score.T)
        out[1, 2] = np.sum(field * field.T)
        out[2, 2] = 3 * np.sum((noise[:, None] * field) * field.T)
        out[2, 3] = np.sum((field @ field) * field.T)
    return out


def quantile_of_sum(cumulants: Matrix, probability: float) -> Vector:
    """The quantile of a weighted sum of noncentral chi2 variables, at least 0. cumulants: (strengths, 3)."""
    first, second, third = np.maximum(cumulants, 1e-300).T
    freedom = second * (second / third) ** 2
    share = 2 / (9 * freedom)
    quantile = freedom * np.maximum(1 - share + float(ndtri(probability)) * np.sqrt(share), 0.0) ** 3
    return np.asarray(np.maximum(first + (quantile - freedom) * third / second, 0.0))


def _first_found(margin: Callable[[Vector], Vector], unit: float, most: float) -> float | None:
    """The smallest strength, up to `most`, for which `margin` is at least 0; None if `margin` stays below 0.

    unit: the error of the strength.
    """
    if most <= WEAKEST_TRIED * unit:
        return None
    tried = np.geomspace(WEAKEST_TRIED * unit, min(STRONGEST_TRIED * unit, most), TRIED)
    reached = np.flatnonzero(margin(tried) >= 0)
    if reached.size == 0:
        return None
    first = int(reached[0])
    between = np.geomspace(tried[max(first - 1, 0)], tried[first], TRIED)
    return float(between[np.flatnonzero(margin(between) >= 0)[0]])


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
