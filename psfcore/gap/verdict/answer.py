"""The answer: which cause explains the gap, at the level at which the data are sure.

The hypotheses are no cause, one form (`closed_form.Form`), and two forms of different families; also two forms and the
Sun, because the Sun always may change. Their prior: NONE, ONE and TWO; families are equally likely; within a family,
half of the weight belongs to the effects of the library and half to other forms. A family without fields has other
forms too, which no hypothesis describes.

**Two priors of the Sun.** In the first, the blocks change independently. In the second, the Sun also changes the
brightness of large areas, like a gain that changes with place and time, and the edges of the discs, because it changes
the places at which the occulters are found. The probability of a hypothesis is the mean over both; where they disagree,
the answer is the tie "the Sun, or an instrument that changes with time".

**Detection.** A gap is detected if something is more than FLOOR times as probable as no cause. Otherwise there is no
cause in the answer.

**Causes.** The first cause is the smallest group of labels of which at least one acts with the probability `level`,
given that something acts (a minimal hitting set, as in consistency-based diagnosis: de Kleer and Williams 1987,
Artificial Intelligence 32, 97). A label is an effect of the library, or "another form" of a family. An effect of the
library takes the probability of the other forms of its family if it is more probable than they are; they take its
probability if they are more than BEATEN times as probable. A further cause is told if hypotheses with so many causes
together have the probability FURTHER.

| the causes | verdict | answer |
|---|---|---|
| none, and at least LEAST_IMAGES images | none | - |
| each is one label, at least one an effect | attributed | the effects; and "unknown" for another form beside them |
| each is one label, none an effect | unknown | - |
| the alternatives of each are effects | tie | all of them |
| anything else | inconclusive | the most probable effects |
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeVar

import numpy as np
from scipy.special import logsumexp

from psfcore.gap.effect import Stage
from psfcore.gap.evidence.closed_form import (
    FORM_ERROR,
    SUNS,
    VISIBLE,
    ClosedForm,
    Form,
    Inexact,
    Sun,
    Variant,
)
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.evidence.tree import FAMILIES, Family

Verdict = Literal["none", "attributed", "tie", "unknown", "inconclusive"]
Level = Literal["name", "family", "stage", "open"]
Hypothesis = tuple[Form, ...]
Label = tuple[str, str | None]  # a family, and an effect of the library; None: another form of the family
Labels = frozenset[Label]
Key = TypeVar("Key")

NONE, ONE, TWO = 0.34, 0.44, 0.22
AND_SUN = 0.1  # prior probability that the Sun acts beside two forms
FLOOR = 20.0
FURTHER = (0.75, 0.9)  # for a second and a third cause
BEATEN = 9.0
IDLE = 0.5  # a further cause that makes a hypothesis less probable by this factor does not act
LEAST_IMAGES = 6
LEADING, OF_LIBRARY = (
    8,
    7,
)  # forms that are weighed in pairs: the most probable ones, and those of the library
FIRST_OF_PAIR = 5  # one form of a pair is among this number of most probable forms
TRIPLES = 4  # the best pairs, beside which the Sun is weighed
# Families that the Sun causes beside the changes of the blocks: it changes large areas, and the place where an occulter
# is found.
COHERENT = ("gain_time", "gain_place_time", "core", "edge", "edge_time")
UNKNOWN = "unknown"


@dataclass(frozen=True)
class Alternative:
    """One label of a cause.

    Attributes
    ----------
    probability
        The probability that this cause acts, if there is a gap.
    """

    family: Family
    effect: str | None
    probability: float

    @property
    def stage(self) -> Stage:
        """The stage of its family."""
        return self.family.stage

    @property
    def words(self) -> str:
        """The label as text."""
        return (
            f"another form of {self.family.words}" if self.effect is None else self.effect.replace("_", " ")
        )


@dataclass(frozen=True, eq=False)
class Cause:
    """One cause, as a list of alternatives of which one is true, the most probable first."""

    alternatives: tuple[Alternative, ...]

    @property
    def level(self) -> Level:
        """The level at which the cause is sure."""
        if len(self.alternatives) == 1:
            return "family" if self.alternatives[0].effect is None else "name"
        if len({one.family.name for one in self.alternatives}) == 1:
            return "family"
        return "stage" if len({one.stage for one in self.alternatives}) == 1 else "open"

    @property
    def effects(self) -> tuple[str, ...]:
        """The effects among the alternatives."""
        return tuple(one.effect for one in self.alternatives if one.effect is not None)


@dataclass(frozen=True, eq=False)
class Answer:
    """The answer of a diagnosis.

    Attributes
    ----------
    causes
        The first cause, and the causes that act beside it; empty if no gap is detected.
    verdict, named
        Verdict and named causes, as in the table above.
    none
        The probability of no cause.
    hypotheses
        The probability of each set of labels, the most probable first.
    variants, evidence
        The best variant of each form, and the ln E of each form alone.
    closed
        The closed form with the final noise.
    level
        The probability that at least one label of the group of a cause acts.
    """

    causes: tuple[Cause, ...]
    verdict: Verdict
    named: tuple[str, ...]
    none: float
    hypotheses: Mapping[Labels, float]
    variants: Mapping[Form, Variant | None]
    closed: ClosedForm
    level: float
    evidence: Mapping[Form, float]

    @cached_property
    def labels(self) -> dict[Label, float]:
        """The probability that each label acts, the most probable first."""
        return _sorted(_of_labels(self.hypotheses))

    def variant(self, label: Label) -> Variant | None:
        """The best variant of the most probable form of a label; None for the Sun."""
        own = [form for form in self.evidence if label_of(form) == label]
        return self.variants[max(own, key=lambda form: self.evidence[form])]


def label_of(form: Form) -> Label:
    """The label of a form."""
    return form.family, form.effect


def answer_of(model: LinearModel, level: float) -> Answer:
    """The answer for a linear model.

    Parameters
    ----------
    level
        The probability that at least one label of the group of a cause acts.
    """
    weighed = _Weighed(ClosedForm(model))
    best = weighed.best
    exact = weighed.variants_of(best)
    if exact:
        values, _ = weighed.closed.fitted(exact, weighed.sun_of(best))
        columns = np.concatenate([one.columns for one in exact])
        seen = float(values @ weighed.closed.normal(columns) @ values)
        if FORM_ERROR**2 * seen > VISIBLE:
            inexact, fields = Inexact(tuple(exact), values), weighed.closed.columns
            del weighed  # its matrices, before those of the next closed form are made
            weighed = _Weighed(ClosedForm(model, fields, inexact=inexact))
            best = weighed.best
    left = weighed.closed.chi2_left(weighed.variants_of(best), weighed.sun_of(best))
    if max(left) > 1:
        weighed.closed.misfit = (max(left[0], 1.0), max(left[1], 1.0))
        weighed = _Weighed(weighed.closed)
    weighed.closed.forget_suns()
    shares = weighed.probabilities()
    by_label = sums((frozenset(map(label_of, forms)), share) for forms, share in shares.items())
    causes = causes_of(by_label, level)
    return Answer(
        causes,
        *verdict_of(causes, len(model.evidence.discs)),
        none=shares.get((), 0.0),
        hypotheses=_sorted(by_label),
        variants=weighed.variants,
        closed=weighed.closed,
        level=level,
        evidence=weighed.alone,
    )


class _Weighed:
    """ln E of every hypothesis of a closed form.

    alone: of each form. variants: the best variant of each form. together: of two or three forms, in their best
    variants. The forms of every key have the order of `in_order`, so a part of a key is a key as well.
    """

    def __init__(self, closed: ClosedForm) -> None:
        self.closed = closed
        each = {form: closed.of_form(form) for form in closed.forms}
        self.alone = {form: float(log_evidence[0]) for form, (log_evidence, _) in each.items()}
        self.variants = {form: variant for form, (_, variant) in each.items()}
        order = sorted(self.alone, key=lambda form: -self.alone[form])
        families = dict.fromkeys(form.family for form in order)
        short = [
            *order[:LEADING],
            *[form for form in order if form.effect is not None][:OF_LIBRARY],
            *(next(form for form in order if form.family == family) for family in families),
        ]
        self._short = dict.fromkeys(short)
        self.together: dict[Hypothesis, float] = {}
        for pair in itertools.combinations(self._short, 2):
            if set(pair).intersection(order[:FIRST_OF_PAIR]) and _may_act_together(*pair):
                suns: Sequence[Sun | None] = SUNS if any(form.is_sun for form in pair) else (None,)
                self.together[pair] = float(closed.together(self.variants_of(pair), suns)[0])
        self._add_triples()

    def in_order(self, *forms: Form) -> Hypothesis:
        """The hypothesis that these forms act together: in the order in which they were chosen to be weighed."""
        return tuple(form for form in self._short if form in forms)

    def variants_of(self, forms: Hypothesis) -> list[Variant]:
        """The best variants of the forms of a hypothesis, without the Sun, which has none."""
        return [one for one in (self.variants[form] for form in forms) if one is not None]

    def _add_triples(self) -> None:
        """Two forms and the Sun: for the best pairs, if the Sun is in one of them or beside them."""
        sun = next((form for form in self._short if form.is_sun), None)
        if sun is None:
            return
        order = sorted(self.together, key=lambda pair: -self.together[pair])[:TRIPLES]
        beside = [form for pair in order if sun in pair for form in pair if form is not sun]
        pairs = dict.fromkeys(pair for pair in order if sun not in pair)
        for one, other in itertools.product(beside, self._short):
            if other is not sun and _may_act_together(one, other):
                pairs[self.in_order(one, other)] = None
        leading = self.sun_of(next((pair for pair in order if sun in pair), (sun,)))
        for pair in pairs:
            # One of the Suns has nearly all of the probability, so the mean over them is its share.
            value = float(self.closed.together(self.variants_of(pair), [leading])[0]) - math.log(len(SUNS))
            self.together[self.in_order(*pair, sun)] = value

    @property
    def best(self) -> Hypothesis:
        """The hypothesis with the largest evidence; a further cause must gain 3."""
        every = {(form,): value for form, value in self.alone.items()} | {
            forms: value - 3.0 * (len(forms) - 1) for forms, value in self.together.items()
        }
        best = max(every, key=lambda forms: every[forms])
        return best if every[best] > 0 else ()

    def sun_of(self, forms: Hypothesis) -> Sun | None:
        """The most probable Sun of a hypothesis; None if the Sun does not act in it."""
        if not any(form.is_sun for form in forms):
            return None
        variants = self.variants_of(forms)
        return max(SUNS, key=lambda sun: float(self.closed.together(variants, [sun])[0]))

    def probabilities(self) -> dict[Hypothesis, float]:
        """The probability of every hypothesis: the mean over the two priors of the Sun."""
        prior = prior_of(list(self.alone))
        weights: dict[Hypothesis, float] = {(): math.log(NONE)}
        for form, value in self.alone.items():
            weights[(form,)] = math.log(ONE * prior[form]) + value
        for forms, value in self.together.items():
            one, other, *_ = sorted(forms, key=lambda form: len(forms) > 2 and form.is_sun)
            more = math.log(AND_SUN) if len(forms) > 2 else 0.0
            weights[forms] = math.log(2 * TWO * prior[one] * prior[other]) + more + value
        sun = next((form for form in self.alone if form.is_sun), None)
        coherent = dict(weights)
        if sun is not None:
            for forms, weight in weights.items():
                rest = tuple(form for form in forms if form.is_sun or form.family not in COHERENT)
                if sun in forms and rest != forms:
                    gained = self.alone[sun] if rest == (sun,) else self.together.get(rest, -math.inf)
                    before = weights.get(rest, -math.inf)
                    # The change of large areas belongs to the Sun, so it costs no further cause.
                    raised = before - gained + self.together[forms] if math.isfinite(gained) else weight
                    coherent[rest] = float(np.logaddexp(coherent.get(rest, -math.inf), raised))
                    coherent.pop(forms)
        each = [_without_idle(_normalised(one)) for one in (weights, coherent)]
        return sums((forms, share / 2) for one in each for forms, share in one.items())


def _may_act_together(one: Form, other: Form) -> bool:
    """Whether two forms can be two causes: of one family only two effects of the library can."""
    return label_of(one) != label_of(other) and (
        one.family != other.family or (one.field is None and other.field is None)
    )


def prior_of(forms: Sequence[Form]) -> dict[Form, float]:
    """The prior probability of each form, if one cause acts."""
    families = {form.family for form in forms}
    alike = Counter((form.family, form.field is None) for form in forms)
    return {form: 0.5 / alike[form.family, form.field is None] / len(families) for form in forms}


def _normalised(weights: Mapping[Hypothesis, float]) -> dict[Hypothesis, float]:
    whole = logsumexp(list(weights.values()))
    return {forms: math.exp(weight - whole) for forms, weight in weights.items()}


def _without_idle(shares: Mapping[Hypothesis, float]) -> dict[Hypothesis, float]:
    """The probabilities, with those of hypotheses with a cause that does not act added to the hypothesis without it."""
    out = dict(shares)
    for forms in sorted(shares, key=len, reverse=True):
        fewer = [
            part for n in range(1, len(forms)) for part in itertools.combinations(forms, n) if part in out
        ]
        likelier = max(fewer, key=lambda part: shares[part], default=None)
        if likelier is not None and shares[forms] <= IDLE * shares[likelier]:
            out[likelier] += out.pop(forms)
    return out


def sums(pairs: Iterable[tuple[Key, float]]) -> dict[Key, float]:
    """The sum of the shares of each key."""
    out: dict[Key, float] = {}
    for key, share in pairs:
        out[key] = out.get(key, 0.0) + share
    return out


def _sorted(shares: Mapping[Key, float]) -> dict[Key, float]:
    return dict(sorted(shares.items(), key=lambda one: -one[1]))


def _of_labels(shares: Mapping[Labels, float]) -> dict[Label, float]:
    # Equally probable labels have the same order in every process.
    return sums((label, share) for labels, share in shares.items() for label in sorted(labels, key=str))


def causes_of(shares: Mapping[Labels, float], level: float) -> tuple[Cause, ...]:
    """The causes of the answer.

    Parameters
    ----------
    shares
        The probability of each set of labels.
    """
    none = shares.get(frozenset(), 0.0)
    if none * (1 + FLOOR) > 1:
        return ()
    some = {labels: share / (1 - none) for labels, share in _settled(shares).items() if labels}
    whole, found, rest = _of_labels(some), list[Cause](), some
    for number, least in enumerate((0.0, *FURTHER), 1):
        if sum(share for labels, share in some.items() if len(labels) >= number) < least:
            break
        group = smallest_group(rest, level)
        if not group:
            break
        # The group is in the order in which it was found, and later members may be more probable than earlier ones.
        told = [group[0], *sorted(group[1:], key=lambda label: -whole[label])]
        found.append(
            Cause(tuple(Alternative(FAMILIES[one[0]], one[1], min(whole[one], 1.0)) for one in told))
        )
        rest = sums(
            (labels - {next((x for x in group if x in labels), None)}, share)
            for labels, share in rest.items()
            if len(labels) > 1 or not labels & set(group)
        )
        rest = {labels: share for labels, share in rest.items() if labels}
    return tuple(found)


def smallest_group(shares: Mapping[Labels, float], level: float) -> list[Label]:
    """The smallest group of labels of which at least one acts with the probability `level`; found greedily."""
    left, total, hit, group = dict(shares), sum(shares.values()), 0.0, []
    while left and hit < level * total:
        gain = _of_labels(left)
        label = max(gain, key=lambda one: gain[one])
        group.append(label)
        hit += gain[label]
        left = {labels: share for labels, share in left.items() if label not in labels}
    return group


def _settled(shares: Mapping[Labels, float]) -> dict[Labels, float]:
    """The probabilities after the effects and the other forms of each family have settled who is named."""
    whole = _of_labels(shares)
    becomes: dict[Label, Label] = {}
    for family in {family for family, _ in whole}:
        other: Label = (family, None)
        names = [label for label in whole if label[0] == family and label != other]
        if not names or other not in whole:
            continue
        best = max(names, key=lambda label: whole[label])
        if whole[best] >= whole[other]:
            becomes[other] = best
        becomes |= {label: other for label in names if whole[label] * BEATEN < whole[other]}
    return sums(
        (frozenset(becomes.get(label, label) for label in labels), share) for labels, share in shares.items()
    )


def verdict_of(causes: Collection[Cause], images: int) -> tuple[Verdict, tuple[str, ...]]:
    """The verdict, and the effects that it names."""
    if not causes:
        return ("none" if images >= LEAST_IMAGES else "inconclusive"), ()
    effects = tuple(dict.fromkeys(name for cause in causes for name in cause.effects))
    if all(len(cause.alternatives) == 1 for cause in causes):
        if not effects:
            return "unknown", ()
        other = any(not cause.effects for cause in causes)
        return "attributed", (*effects, *((UNKNOWN,) if other else ()))
    if all(len(cause.effects) == len(cause.alternatives) for cause in causes):
        return "tie", effects
    first = tuple(dict.fromkeys(cause.effects[0] for cause in causes if cause.effects))
    return "inconclusive", first
