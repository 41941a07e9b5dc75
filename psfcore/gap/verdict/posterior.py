"""The posterior: a probability for every hypothesis about the cause of the gap.

The hypotheses are: no effect acts (`NONE`); one effect of the library acts; two effects act together; three effects act
together, of which two are the most probable pair; a cause outside the library acts (`UNKNOWN`, `evidence.discrepancy`).
`evidence.likelihood` computes the evidence E of each hypothesis:

    p(h) ~ prior(kind of h) / (number of hypotheses of this kind) * E(h)              Eq. (1)

The linear model holds only for a small effect. A full refit of a hypothesis therefore gives this hypothesis a new
evidence. If a single effect was refitted, all pairs with this effect get a new evidence too, and so do the triples of the
most probable of these pairs.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from psfcore.gap.effect import Effect
from psfcore.gap.evidence.discrepancy import ALTERNATIVES, discrepancy
from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.fields import Field, FieldColumns, FieldShape, fields_of
from psfcore.gap.evidence.likelihood import Likelihood, Weighed
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.verdict.same_data import with_same_data

Vector = NDArray[np.float64]
Names = tuple[str, ...]
Kind = Literal["none", "single", "pair", "triple", "unknown"]

NONE: Names = ()
UNKNOWN: Names = ("unknown",)  # no effect may have this name
KINDS: tuple[Kind, ...] = ("none", "single", "pair", "triple", "unknown")
# Prior probabilities of the kinds. Those of one effect and of an unknown cause maximise the mean logarithm of the probability of the true
# cause in 144 simulated cases (`studies.gap_calibration` computes them). With 0.4 for one effect and 0.15 for an
# unknown cause, answer sets of the same coverage have 3.4 members instead of 2.2.
PRIOR: Mapping[Kind, float] = {"none": 0.28, "single": 0.15, "pair": 0.08, "triple": 0.01, "unknown": 0.48}

# The data do not show a further effect if it makes a hypothesis less probable by this factor. The priors alone make a pair 0.06 times
# as probable as one of its effects. With the factor 1, pairs that are nearly as probable as one of their effects are not in the
# answer set; to cover 0.9 of the causes anyway, the sets must be larger: 3.7 members instead of 2.2 (144 simulated cases).
IDLE = 0.2


def kind_of(names: Names) -> Kind:
    """The kind of a hypothesis."""
    if names == UNKNOWN:
        return "unknown"
    return KINDS[min(len(names), 3)]


@dataclass(frozen=True, eq=False)
class Posterior:
    """The weights of all hypotheses.

    log_weights: ln of prior times evidence of each hypothesis, up to a common constant. visible_error: `Weighed.visible_error`
    by hypothesis. orders: the probability of each alternative of the discrepancy if the cause is unknown. fields: the same of
    each field. shape: the shape of the most probable field.
    """

    log_weights: dict[Names, float]
    visible_error: dict[Names, float]
    orders: dict[Names, float]
    fields: dict[Field, float] = dataclass_field(default_factory=dict)
    shape: FieldShape | None = None

    def probabilities(self, temperature: float = 1.0) -> dict[Names, float]:
        """The probability of each hypothesis, the most probable first. temperature: divides the logarithms of the weights."""
        names = list(self.log_weights)
        weights = np.array([self.log_weights[name] for name in names]) / temperature
        shares = np.exp(weights - logsumexp(weights))
        return _sorted(dict(zip(names, shares.tolist(), strict=True)))

    def with_evidence(self, evidence: Mapping[Names, Weighed], effects: int) -> Posterior:
        """The same posterior with a new evidence for the given hypotheses. effects: the number of effects in the library."""
        weights = {names: w.log_evidence + _log_prior(names, effects) for names, w in evidence.items()}
        errors = {names: w.visible_error for names, w in evidence.items()}
        return replace(
            self, log_weights=self.log_weights | weights, visible_error=self.visible_error | errors
        )


def without_idle(probabilities: Mapping[Names, float]) -> dict[Names, float]:
    """The probabilities, with the improbable pairs and triples merged into hypotheses with fewer effects.

    If a hypothesis is less probable than IDLE times the probability of one of its effects alone, or of two of its three effects,
    its probability is added to that hypothesis: the data then do not show the other effect. A hypothesis in the result
    means these effects alone, or together with an effect that the data do not show.
    """
    out = dict(probabilities)
    for names in sorted(probabilities, key=len, reverse=True):
        fewer = [part for n in range(1, len(names)) for part in itertools.combinations(names, n)]
        # A hypothesis whose refit failed is missing.
        likelier = max(
            (part for part in fewer if part in out), key=lambda part: probabilities[part], default=None
        )
        if likelier is not None and probabilities[names] <= IDLE * probabilities[likelier]:
            out[likelier] += out.pop(names)
    return _sorted(out)


def _sorted(probabilities: Mapping[Names, float]) -> dict[Names, float]:
    return dict(sorted(probabilities.items(), key=lambda one: -one[1]))


def posterior(model: LinearModel) -> Posterior:
    """The posterior in the linear model, without any full refit."""
    evidence = model.evidence
    likelihood = Likelihood(model)
    weighed = {names: weigh(likelihood, evidence, names) for names in _hypotheses(evidence.effects)}
    weighed |= _triples(likelihood, evidence, weighed, evidence.effects)
    further = discrepancy(evidence)
    with_polynomials = likelihood.with_further(further.directions)
    orders = {
        orders: with_polynomials.weigh([columns]).log_evidence
        for orders in ALTERNATIVES
        if (columns := further.columns(orders, evidence.size))
    }
    fields, shape = _of_fields(likelihood, evidence)
    logs = np.array([*orders.values(), *fields.values()])
    whole = float(logsumexp(logs))
    count = len(evidence.effects)
    shares = np.exp(logs - whole).tolist()
    return Posterior(
        {names: w.log_evidence + _log_prior(names, count) for names, w in weighed.items()}
        | {UNKNOWN: whole - math.log(logs.size) + _log_prior(UNKNOWN, count)},
        {names: w.visible_error for names, w in weighed.items()},
        dict(zip(orders, shares, strict=False)),
        dict(zip(fields, shares[len(orders) :], strict=True)),
        shape,
    )


def _of_fields(likelihood: Likelihood, evidence: Evidence) -> tuple[dict[Field, float], FieldShape]:
    """ln of the evidence of each field, and the shape of the most probable one."""
    columns = FieldColumns(evidence)
    found: dict[Field, Weighed] = {}
    best = -math.inf
    for field in fields_of(evidence):
        with_field = likelihood.with_further(columns.of(field))
        found[field] = weighed = with_field.weigh([with_field.further_columns])
        if weighed.log_evidence > best:
            best = weighed.log_evidence
            shape = columns.shown(field, *with_field.fitted(with_field.further_columns, weighed.values))
    return {field: weighed.log_evidence for field, weighed in found.items()}, shape


def _triples(
    likelihood: Likelihood,
    evidence: Evidence,
    weighed: Mapping[Names, Weighed],
    effects: Sequence[Effect],
    taken: Mapping[str, Sequence[float]] | None = None,
) -> dict[Names, Weighed]:
    """Weigh the triples that contain the most probable pair. taken: as in `at_refit`."""
    pairs = [names for names in weighed if kind_of(names) == "pair"]
    if not pairs:
        return {}
    best = max(pairs, key=lambda names: weighed[names].log_evidence)
    others = [effect.name for effect in effects if effect.name not in best]
    triples = [_in_order((*best, other), effects) for other in others]
    return {names: weigh(likelihood, evidence, names, taken) for names in triples}


def at_refit(
    refit: LinearModel,
    before: LinearModel,
    names: Names,
    taken: Mapping[str, Sequence[float]],
    moved: Vector,
    effects: Sequence[Effect],
) -> dict[Names, Weighed]:
    """The evidence from a full refit, for the refitted hypothesis and, after a refit of a single effect, for its pairs.

    refit: the linear model at the refit, with the effects that may act. before: the linear model without any effect.
    taken: the amounts of the parameters that the refit subtracted from the images, by effect. moved: the coordinates of
    the PSF of the refit minus those of the fit without any effect.
    """
    refit = replace(refit, evidence=with_same_data(before.evidence, refit.evidence, taken, moved))
    likelihood = Likelihood(refit)
    others = [e.name for e in effects if e.name not in names] if len(names) == 1 else []
    pairs = [_in_order((*names, other), effects) for other in others]
    found = {one: weigh(likelihood, refit.evidence, one, taken) for one in (names, *pairs)}
    return found | _triples(likelihood, refit.evidence, {one: found[one] for one in pairs}, effects, taken)


def weigh(
    likelihood: Likelihood,
    evidence: Evidence,
    names: Names,
    taken: Mapping[str, Sequence[float]] | None = None,
) -> Weighed:
    """Weigh the hypothesis that the effects `names` act together. taken: as in `at_refit`."""
    columns = [list(evidence.columns_of(name).values()) for name in names]
    before = taken or {}
    subtracted = [
        value
        for name, some in zip(names, columns, strict=True)
        for value in before.get(name, (0.0,) * len(some))
    ]
    templates = math.prod(evidence.templates.get(name, 1.0) for name in names)
    return likelihood.weigh(columns, templates=templates, subtracted=subtracted)


def _hypotheses(effects: Sequence[Effect]) -> list[Names]:
    names = [effect.name for effect in effects]
    return [NONE, *((name,) for name in names), *itertools.combinations(names, 2)]


def _in_order(names: Names, effects: Sequence[Effect]) -> Names:
    return tuple(effect.name for effect in effects if effect.name in names)


def _log_prior(names: Names, effects: int) -> float:
    count = {"single": effects, "pair": math.comb(effects, 2), "triple": math.comb(effects, 3)}
    kind = kind_of(names)
    return math.log(PRIOR[kind] / max(count.get(kind, 1), 1))
