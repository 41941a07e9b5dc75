"""The settled posterior: the linear model is replaced by full refits where it is not exact enough.

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

from collections.abc import Callable, Mapping

from psfcore.gap.evidence.fields import UNKNOWN as UNKNOWN_NAME
from psfcore.gap.evidence.likelihood import Weighed
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.verdict.posterior import NONE, Form, Names, Posterior, kind_of

MOST_REFITS = 3  # for example, an effect alone, a pair that contains it, and a rival
VISIBLE = 9.0  # an error of the first order is visible if it adds this much to chi2
PLAUSIBLE = 0.02
LEADING = 0.5

# A function that makes a full refit of a form. It returns the evidence of this form, and of the other forms that the refit also
# tests, with the model in which they were weighed; None if the refit failed; no evidence if the error of the first order is still
# larger than the number that it gets.
Refit = Callable[[Form, float], "tuple[Mapping[Form, Weighed], LinearModel] | None"]


def settled_posterior(linear: Posterior, refit: Refit | None) -> tuple[Posterior, tuple[Names, ...]]:
    """Two results: the posterior after the full refits, and the hypotheses whose refit failed. The posterior excludes
    these.

    linear: the posterior of the linear model. refit: makes the full refit of a form. If it is None, the posterior stays as it is.
    """
    now = linear
    failed: list[Names] = []
    done: set[Form] = set()
    if refit is None:
        return now, ()
    for _ in range(MOST_REFITS):
        inexact = _to_refit(now, done)
        form = inexact or _leading(now, done)
        if form is None:
            break
        done.add(form)
        real = refit(form, max(VISIBLE, now.forms[form].visible_error))
        if real is None:  # the images do not contain the effects as the linear fit states them
            if form.field is None:
                failed.append(form.effects)
                now = now.without(_contradicted(now, form))
        elif real[0] and inexact is not None:
            # The refit of a form itself is more exact than its evidence at the refit of another one.
            new = {one: weighed for one, weighed in real[0].items() if one == form or one not in done}
            stale = [one for one in _stale(now, form) if one not in new and one not in done]
            now = now.without(stale).with_evidence(new, real[1])
    return now, tuple(failed)


def _contradicted(now: Posterior, failed: Form) -> list[Form]:
    """The forms that a failed refit excludes: this form, and if it is a pair, the triples that contain it, because their linear
    evidence is not trusted either."""
    own = set(failed.effects)
    return [form for form in now.forms if form == failed or (len(own) > 1 and own < set(form.effects))]


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
