"""The probability that an ideal observer names the true cause of a case, and nothing else.

The ideal observer knows the noise and the form of every effect. For every hypothesis h about the cause, ideal.json
(gap-ideal/1) states the chi2 of the noise-free gap that remains after h and all unknown quantities are fitted. For the
truth this chi2 is 0. Let lambda_h be this chi2 plus the cost of h minus the cost of the truth. Over noise realisations,

    chi2 of h - chi2 of the truth  ~  Normal(lambda_h, 4 lambda_h)                                   Eq. (1)

because this difference is twice the logarithm of a likelihood ratio of two Gaussians (Kay, Fundamentals of Statistical
Signal Processing II, 1998, section 4.3). A hypothesis with fewer effects than the truth is simpler, and only
significant data exclude it:

    P = Phi(sqrt(lambda_h) - z),   z = Phi^-1(1 - LEVEL / (2 M))                                     Eq. (2)

This is the power of a two-sided test of one among M effects (a noncentral chi2 of one degree of freedom, with the level
divided by M after Bonferroni): for 18 effects it is 0.5, 0.9 and 0.99 at lambda 9, 18 and 28. The hypotheses
with the same number of effects as the truth have the same prior probability as the truth. The observer names the one
with the smallest chi2. This is the truth with the probability

    P = integral of phi(u) product over h of Phi(u + sqrt(lambda_h / 2)) du                          Eq. (3)

For one rival this is Phi(sqrt(lambda) / 2). For M rivals at equal distances it is the forced choice between M + 1
alternatives, a maximum of Gaussian variables (Green and Swets, Signal Detection Theory and Psychophysics, 1966, chapter
2). Hypotheses with more effects than the truth are left out: they contain the truth, or are less probable. Hypotheses
that a right answer may name (`judged`) are left out too. The bound is the smallest of these values: Eq. (2) for each
hypothesis with fewer effects, and Eq. (3). A right answer need not name every true effect. If Eq. (2) finds such an
effect beside the others with a probability of one half or more, this effect counts as an effect of the truth, and a
rival must explain this effect too.

If the true effect is not in the library, every hypothesis of the library counts as a simpler hypothesis. The observer
names "unknown" if all of them are excluded. On clean data the ideal observer names an effect with the probability
LEVEL.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import log_ndtr, ndtr, ndtri

Effects = frozenset[str]

LEVEL = 0.05
_U = np.linspace(-9.0, 9.0, 721)
_PHI = np.exp(-0.5 * _U**2) / math.sqrt(2 * math.pi) * (_U[1] - _U[0])


@dataclass(frozen=True)
class Known:
    """What an ideal observer could know about a case.

    noncentrality: chi2 of the gap of noise-free images that remains after the PSF is refitted. rival: the smallest
    lambda_h of all hypotheses h that are not true; None for clean data. alone: the probability that the observer names
    the truth, and only the truth.
    """

    noncentrality: float
    rival: float | None
    alone: float


CLEAN = Known(0.0, None, 1 - LEVEL)


def known(ideal: dict[str, Any], required: Sequence[str], true: Sequence[str], *, in_library: bool) -> Known:
    """What an ideal observer could know about a case.

    ideal: the content of ideal.json (gap-ideal/1). required: the true effects that a right answer must contain. true:
    all true effects. in_library: whether the library contains the true effects.
    """
    left = {
        frozenset(one["effects"]): (float(one["chi2"]), float(one["cost"])) for one in ideal["hypotheses"]
    }
    among = max(sum(len(h) == 1 for h in left), 1)
    shown = _shown(left, frozenset(required), frozenset(true), among)
    own_cost = left[shown][1] if in_library and shown in left else 0.0
    size = len(shown) if in_library else math.inf
    others = {
        h: max(chi2 + cost - own_cost, 0.0)
        for h, (chi2, cost) in left.items()
        if len(h) <= size and not (in_library and h >= frozenset(required))
    }
    simpler = [lam for h, lam in others.items() if len(h) < size]
    equal = [lam for h, lam in others.items() if len(h) == size]
    alone = min([excluded(lam, among) for lam in simpler] + [best_of(equal)])
    return Known(float(ideal["noncentrality"]), min(simpler + equal, default=None), alone)


def _shown(left: dict[Effects, tuple[float, float]], required: Effects, true: Effects, among: int) -> Effects:
    """The true effects that the ideal observer can find.

    They are all true effects if the observer can exclude, with a probability of at least 0.5, that only the required
    effects act. Otherwise they are only the required effects.
    """
    if required == true or required not in left or true not in left:
        return required
    gain = sum(left[required]) - sum(left[true])
    return true if excluded(max(gain, 0.0), among) >= 0.5 else required


def excluded(lam: float, among: int) -> float:
    """Eq. (2): the probability that a simpler hypothesis is excluded. among: M, the number of effects that are tested."""
    return float(ndtr(math.sqrt(lam) - ndtri(1 - LEVEL / (2 * among))))


def best_of(lams: Sequence[float]) -> float:
    """Eq. (3): the probability that the chi2 that the truth leaves is smaller than that of every rival; 1 without
    rivals."""
    if not lams:
        return 1.0
    above = _U[:, None] + np.sqrt(np.asarray(lams, dtype=np.float64) / 2)
    return float(min(np.sum(_PHI * np.exp(log_ndtr(above).sum(axis=1))), 1.0))
