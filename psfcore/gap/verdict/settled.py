"""The settled posterior: the linear model is replaced by full refits where it is not exact enough.

A plausible hypothesis is refitted if an error of its template (`likelihood.USUAL_ERROR`), or the curvature of the PSF
(`likelihood.CURVATURE`), would be visible in the data. The most probable hypothesis comes first. Before several effects are refitted together, the most probable of them is
refitted alone, for two reasons: this refit also gives the evidence of all pairs with this effect; and a strong effect
that is not linear can make a pair look more probable than the effect alone. The refits end when no plausible hypothesis needs a
refit, or after MOST_REFITS refits.

A field of an unknown cause has no template error. It may therefore be more probable than a strong effect that is the true
cause, until this effect is refitted. So the plausible hypotheses are those that are plausible if the cause is not unknown.

The report names the effects of a hypothesis that is more probable than all others together. Its refit is made even if the
linear model is exact enough, and if this refit fails, the hypothesis is excluded. If it succeeds, the evidence of the linear
model stays: the evidence of a refit scatters by a few units, and the other hypotheses have no refit.

If the refit of a pair fails, the triples with this pair are excluded too. A refit that did not settle counts for nothing: the
evidence of the linear model stays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

from psfcore.gap.evidence.likelihood import Weighed
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.verdict.posterior import NONE, UNKNOWN, Names, Posterior, kind_of, posterior

MOST_REFITS = 3  # for example, an effect alone, a pair that contains it, and a rival
VISIBLE = 9.0  # an error of the first order is visible if it adds this much to chi2
PLAUSIBLE = 0.02
LEADING = 0.5

# A function that makes a full refit of a hypothesis. It returns the evidence of this hypothesis, and of the other
# hypotheses that the refit also tests; None if the refit failed; nothing if the error of the first order is still larger than the
# number that it gets.
Refit = Callable[[Names, float], "Mapping[Names, Weighed] | None"]


def settled_posterior(model: LinearModel, refit: Refit | None) -> tuple[Posterior, tuple[Names, ...]]:
    """Two results: the posterior after the full refits, and the hypotheses whose refit failed. The posterior excludes
    these.

    refit: makes the full refit of a hypothesis. If it is None, the posterior is that of the linear model.
    """
    effects = len(model.evidence.effects)
    found = posterior(model)
    failed: list[Names] = []
    done: set[Names] = set()
    if refit is None:
        return found, ()
    for _ in range(MOST_REFITS):
        inexact = _to_refit(found, done)
        chosen = inexact or _leading(found, done)
        if chosen is None:
            break
        done.add(chosen)
        real = refit(chosen, max(VISIBLE, found.visible_error.get(chosen, 0.0)))
        if real is None:  # the images do not contain the effects as the linear fit states them
            failed.append(chosen)
            found = _without_failed(found, chosen)
        elif real and inexact is not None:
            # The refit of a hypothesis itself is more exact than its evidence at the refit of another one.
            new = {names: weighed for names, weighed in real.items() if names == chosen or names not in done}
            found = _without_stale(found, chosen, done, new).with_evidence(new, effects)
    return found, tuple(failed)


def _without_failed(found: Posterior, chosen: Names) -> Posterior:
    """The posterior without a hypothesis whose refit failed. The linear evidence of a triple that contains this pair is not
    trusted either."""
    return replace(
        found,
        log_weights={
            names: weight
            for names, weight in found.log_weights.items()
            if names != chosen and not (len(chosen) > 1 and set(chosen) < set(names))
        },
    )


def _without_stale(
    found: Posterior, refitted: Names, done: set[Names], real: Mapping[Names, Weighed]
) -> Posterior:
    """The posterior without the linear evidence that a refit of one effect contradicts.

    The refit weighs this effect alone, its pairs, and the triples of the best pair. The linear model overestimates the
    other triples with this effect, if the effect is strong. A triple that was refitted itself stays.
    """
    if len(refitted) > 1:
        return found
    return replace(
        found,
        log_weights={
            names: weight
            for names, weight in found.log_weights.items()
            if not (kind_of(names) == "triple" and set(refitted) < set(names))
            or names in real
            or names in done
        },
    )


def _to_refit(found: Posterior, done: set[Names]) -> Names | None:
    """The most probable hypothesis for which the linear model is not exact enough, or one of its effects."""
    probabilities = found.probabilities()
    of_others = max(1.0 - probabilities[UNKNOWN], 1e-300)
    for names, share in probabilities.items():
        if share < PLAUSIBLE * of_others:
            return None
        if names in (NONE, UNKNOWN) or names in done or found.visible_error.get(names, 0.0) <= VISIBLE:
            continue
        alone = [(name,) for name in names]
        if len(alone) > 1 and not done.intersection(alone):
            return max(alone, key=lambda one: found.log_weights.get(one, -math.inf))
        return names
    return None


def _leading(found: Posterior, done: set[Names]) -> Names | None:
    """The hypothesis that is more probable than all others together, if it names effects and was not refitted yet."""
    names, share = next(iter(found.probabilities().items()))
    return names if share > LEADING and names not in (NONE, UNKNOWN) and names not in done else None
