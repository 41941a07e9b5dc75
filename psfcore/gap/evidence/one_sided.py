"""The evidence of parameters that cannot be negative.

The prior of such a parameter is half a Gaussian. If its best value is 0, ln L falls with the slope g <= 0 from there, and the
integral over the parameter multiplies the evidence by

    2 / (w K^1/2) exp(b^2 / 2) Phi(b),    K = N + w^-2,    b = g K^-1/2                   Eq. (1)

N is the normal matrix of this parameter with all others free, w the width of its prior, and Phi the normal distribution
function. The correlations between several such parameters are neglected.

If an effect has several of these parameters, for example the light from each side of the field, usually only some of them act.
The number of parameters that act is then any number from 1 to all with the same prior probability, and so is each choice
of so many parameters. If the effect has other parameters too, this number may also be 0. The odds of a parameter, o, are the evidence if it acts divided by the evidence if it is 0. With
e_k the elementary symmetric polynomial of degree k of the odds of the P parameters, the factor is

    sum_k e_k(o) / (M binomial(P, k)),    k = 1 ... P (M = P) or k = 0 ... P (M = P + 1)   Eq. (2)

The odds of a parameter at 0 are Eq. (1). For a parameter with the best value m above 0 and the error s they are the
Savage-Dickey ratio (Dickey 1971, Ann. Math. Stat. 42, 204): the density of the prior at 0 divided by that of the posterior,
2 s Phi(m / s) exp(m^2 / (2 s^2)) / w.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln, log_ndtr

Vector = NDArray[np.float64]


def log_odds_at_zero(slope: Vector, normal: Vector, width: Vector) -> Vector:
    """The logarithm of the odds of each parameter whose best value is 0, Eq. (1). The arguments have one entry for each.

    slope, normal: the slope of ln L and the curvature of -ln L at the value 0. A slope above 0, which remains if a parameter was
    set to 0 before the others, counts as 0. width: the width of the prior.
    """
    total = np.maximum(normal, 0.0) + width**-2.0
    above = np.minimum(slope, 0.0) / np.sqrt(total)
    return np.asarray(math.log(2) - np.log(width * np.sqrt(total)) + above**2 / 2 + log_ndtr(above))


def log_odds_above_zero(best: Vector, error: Vector, width: Vector) -> Vector:
    """The logarithm of the odds of each parameter whose best value is above 0 (Savage-Dickey ratio).

    best, error: the best value and its error. width: the width of the prior.
    """
    above = best / error
    return np.asarray(math.log(2) + np.log(error / width) + log_ndtr(above) + above**2 / 2)


def log_of_any_number(log_odds: Vector, least: int = 1) -> float:
    """The logarithm of Eq. (2): the evidence if some of the parameters act, divided by the evidence if all are 0.

    log_odds: the logarithm of the odds of each parameter. least: the least number of parameters that act, 0 or 1.
    """
    count = log_odds.size
    sums = np.full(count + 1, -np.inf)  # ln e_k of the odds so far
    sums[0] = 0.0
    for odds in log_odds:
        sums[1:] = np.logaddexp(sums[1:], sums[:-1] + odds)
    k = np.arange(least, count + 1)
    log_choices = gammaln(count + 1) - gammaln(k + 1) - gammaln(count - k + 1)
    return float(np.logaddexp.reduce(sums[k] - log_choices) - math.log(k.size))
