"""The answer sets of an ideal observer: how small sets can be that contain the true cause in 90 % of these cases.

The ideal observer (`bounds`) knows the noise, the form of every effect, and how often each kind of cause occurs in the set of
cases. For every hypothesis h, ideal.json (gap-ideal/1) states chi2_h, the chi2 of the noise-free gap that h leaves, and the cost
of its freedom to adapt to the data. With a random number z_h of a normal distribution, the observer's probability of h is

    p(h) ~ prior(h) exp(-cost_h / 2 - chi2_h / 2 + sqrt(chi2_h) z_h)                                 Eq. (1)

because ln of the likelihood ratio of h and the truth is Normal(-chi2_h / 2, chi2_h). The z_h of different hypotheses are taken
as independent. Hypotheses of one kind share the prior probability of this kind. An unknown cause leaves nothing, and adapts to
the data as freely as the most flexible effect of the library. A pair that is less probable than one of its effects alone counts as
this effect, because the data do not show the other one.

A set contains the hypotheses whose probability is at least a threshold. The threshold is the one with which the sets of all
cases contain the true cause with the stated coverage. Sets with one threshold are the smallest sets, on average, that have this
coverage (Sadinle, Lei & Wasserman 2019, J. Am. Stat. Assoc. 114, 223). A calibrated diagnosis therefore cannot have smaller
ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Effects = frozenset[str]

COVERAGE = 0.9
DRAWS = 50  # realisations of the noise for each case
UNKNOWN: Effects = frozenset(["unknown"])
NONE: Effects = frozenset()


@dataclass(frozen=True)
class IdealCase:
    """A case. kind: "clean", "single", "pair" or "unknown". required: the effects that an answer must contain. ideal: the
    content of ideal.json; None for clean data, for which no hypothesis leaves anything."""

    kind: str
    required: tuple[str, ...]
    ideal: Mapping[str, Any] | None


def mean_sizes(cases: Sequence[IdealCase], coverage: float = COVERAGE, seed: int = 0) -> list[float]:
    """The mean number of members of the ideal observer's set for each case. Empty if no case has an ideal.json.

    seed: of the noise. Clean data have the costs that the hypotheses have in the other cases, on average.
    """
    known = [case.ideal for case in cases if case.ideal is not None]
    if not known:
        return []
    usual = _mean_costs(known)
    priors = {kind: sum(case.kind == kind for case in cases) / len(cases) for kind in {c.kind for c in cases}}
    rng = np.random.default_rng(seed)
    shares: list[list[NDArray[np.float64]]] = []
    true: list[float] = []
    for case in cases:
        here = []
        for _ in range(DRAWS):
            found = _probabilities(case, usual, priors, rng)
            here.append(np.array(list(found.values())))
            true.append(_true_share(found, case))
        shares.append(here)
    threshold = float(np.quantile(true, 1 - coverage))
    return [float(np.mean([max((some >= threshold).sum(), 1) for some in here])) for here in shares]


def _mean_costs(known: Sequence[Mapping[str, Any]]) -> dict[Effects, float]:
    costs: dict[Effects, list[float]] = {}
    for ideal in known:
        for one in ideal["hypotheses"]:
            costs.setdefault(frozenset(one["effects"]), []).append(float(one["cost"]))
    return {effects: float(np.mean(some)) for effects, some in costs.items()}


def _probabilities(
    case: IdealCase,
    usual: Mapping[Effects, float],
    priors: Mapping[str, float],
    rng: np.random.Generator,
) -> dict[Effects, float]:
    """Eq. (1) for one realisation of the noise, with the idle pairs merged into their effects."""
    left = {effects: (0.0, cost) for effects, cost in usual.items()}
    if case.ideal is not None:
        left = {
            frozenset(one["effects"]): (float(one["chi2"]), float(one["cost"]))
            for one in case.ideal["hypotheses"]
        }
    free = max((cost for effects, (_, cost) in left.items() if len(effects) == 1), default=0.0)
    left = {**left, UNKNOWN: (0.0, free)}
    kinds = [_kind(effects) for effects in left]
    prior = np.array([priors.get(kind, 0.0) / kinds.count(kind) for kind in kinds])
    chi2, cost = np.array(list(left.values())).T
    log_weights = -cost / 2 - chi2 / 2 + np.sqrt(chi2) * rng.standard_normal(chi2.size)
    weights = prior * np.exp(log_weights - log_weights[prior > 0].max())
    found = dict(zip(left, (weights / weights.sum()).tolist(), strict=True))
    for pair in [effects for effects in found if len(effects) == 2]:
        alone = max((frozenset([name]) for name in pair), key=lambda one: found.get(one, 0.0))
        if found.get(alone, 0.0) >= found[pair]:
            found[alone] += found.pop(pair)
    return found


def _kind(effects: Effects) -> str:
    if effects == UNKNOWN:
        return "unknown"
    return ("clean", "single", "pair")[len(effects)]


def _true_share(found: Mapping[Effects, float], case: IdealCase) -> float:
    """The probability of the true cause; of several hypotheses that contain it, the largest."""
    if case.kind == "unknown":
        return found[UNKNOWN]
    if case.kind == "clean":
        return found[NONE]
    required = frozenset(case.required)
    return max((share for effects, share in found.items() if required <= effects), default=0.0)
