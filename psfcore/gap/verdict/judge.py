"""The verdict: is there a gap, and which effect causes it.

Gains of effects are compared after what their parameters, and a search over many places, gain from noise:

    score = gain - PENALTY parameters - cost of a field - 2 ln trials       Eq. (1)

There is a gap where patterns that any gap makes (`patterns`), the discs' means, all cells, the lit blocks or an effect's
gain are less likely than ALARM, counted for how many were looked at. What lies within TIE of the best effect, or
within TIE_SHARE of its gain, cannot be told from it (more widely where a place was searched for), unless it does
clearly worse on images held out of its fit.
An effect is enough where what it leaves is not less likely than ENOUGH, its own forward change taken to be right to
TEMPLATE_ERROR, or where that is less than LEFT_SHARE of the gap and no rival comes near: an effect whose form is not quite the
sky's. Another is named beside it where it gains more than a search and that error let it, and more than the first's
real refit, where one was made, explains by itself.
The linear model is good for a small gap alone: the best effect that is not enough in it is added to the model for
real, and what that leaves is looked at. Pairs are searched exhaustively where no single effect is enough.
Closing much of a gap identifies nothing, for a wrong effect does that too: where no effect and no pair is enough, or
where a probe, a form of unknown cause, does clearly better, the verdict is unknown; where it does a little better
and explains more, or the effect's own gain is not unlikely enough, inconclusive. It is repeated with half and twice
the floor, where gap and effect may be LENIENT times likelier; where it flips, the answer holds both, or is inconclusive.
So it is where the answer predicts images held out of its fit worse than nothing does. An effect that in the model for
real explains less than half of what it does to first order is no answer: the verdict is given without it, and where a
pair does, it is inconclusive. What was measured in the lit parts
fits them whatever the cause: an effect of few numbers that gains nearly as much goes before it, and where nothing else
comes near it is the answer, however much it leaves there. A gap of the discs is judged beside it by itself: one effect
or two are named with it, and where none can be and every occulter was found well, the verdict is inconclusive. Of a
pair, what would do in place of one is named too; where many would, the other alone.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from psfcore.gap.effect import Effect
from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.linear_model import LinearModel, Step
from psfcore.gap.verdict.closure import fall, hold_out, time_blocks

Vector = NDArray[np.float64]
Verdict = Literal["none", "attributed", "tie", "unknown", "inconclusive"]

FLOORS = (0.5, 2.0)  # the verdict is repeated with
ALARM = 0.005
CONFIDENT = 1e-3  # of an effect that is named, counted for how many were tried
ENOUGH = 1e-3
PENALTY = 2.0
TIE = 9.0
HELD_OUT_SIGMA = 1.0  # by so many standard errors an effect does clearly worse on images held out
TIE_SHARE = 0.03  # of the best gain: no effect's form is so exact that less would tell two apart
LEFT_SHARE = 0.15
BEHIND = 0.85  # of the best score: what a rival may reach at most
NEAR_BEHIND = 0.7  # of the best score: a form whose place was searched for fits anything a little
UNRIVALLED = 0.1  # of the best score: below it no rival comes near
MANY_PLACES = 100
MOST_SECONDS = 2  # that may act beside an effect that explains most: of more none is named
CLEAR = 12.0  # by which a pair must beat a single effect that is not enough, and a probe all effects
TEMPLATE_ERROR = 0.05
UNOCCULTED_WIDTH = 0.03  # chi2 a degree of freedom that the lit parts may be off by where there is no gap
LENIENT = 5.0  # times likelier: what shows a gap, and names its cause, may be so under the other floors
BY_CHANCE = 0.01  # a probe's greater gain is less likely than this to come of its further numbers alone
MOST_AMISS = (
    2  # answers that may fail in the model for real before no more is said, and so many of a tie are asked
)
LEAST_IMAGES = 6  # with fewer nothing can be held out, and that nothing shows says nothing


@dataclass(frozen=True)
class Freedom:
    """How much noise alone gains: a chi2 of this mean and half variance, the largest of so many trials."""

    mean: float
    half_variance: float
    trials: float

    def beside(self, first: Freedom) -> Freedom:
        """What this has more than a first that is a part of it."""
        return Freedom(
            max(self.mean - first.mean, 1.0),
            max(self.half_variance - first.half_variance, 1.0),
            max(self.trials / first.trials, 1.0),
        )

    def p_value(self, gain: float) -> float:
        """How often noise gains as much, by a chi2 whose degrees of freedom have the same mean and variance."""
        if self.half_variance <= 0:
            return 1.0
        share = self.mean / self.half_variance
        return min(1.0, self.trials * float(chdtrc(self.mean * share, max(gain, 0.0) * share)))


@dataclass(frozen=True, eq=False)
class Tried:
    """One effect, or some together, fitted beside the PSF: values and errors by "effect.parameter", its gain, what is left.

    p_value: of the gain. left_p_value: of what the patterns, the cells and the lit blocks still show, and left_share:
    the largest share of what they showed before; none where it was not worth asking. explains: whether of what showed
    most, little is left. left_for_real: `left_chi2` of a real refit; none where none was asked for, or it is not of the
    same images.
    """

    names: tuple[str, ...]
    named: bool
    values: dict[str, tuple[float, float, str]]
    gain: float
    score: float
    p_value: float
    freedom: Freedom
    step: Step
    left_p_value: float | None = None
    left_share: float | None = None
    explains: bool = False
    left_for_real: Vector | None = None

    @property
    def label(self) -> str:
        """The names as a report has them."""
        return label_of(self.names)


def label_of(names: Sequence[str]) -> str:
    """Names of effects as a report has them."""
    return " + ".join(names)


@dataclass(frozen=True, eq=False)
class Judgement:
    """A verdict under one floor. tried: named effects, best first, the answer's pairs before them and what failed in the
    model for real behind, whose labels amiss holds. probes: best first.

    answer: of `inconclusive` what would be one, for what fits best and is not sure enough; often none.
    certain: of a tie the effects that act whichever of the others does beside them; none where one of them does alone.
    discs_unexplained: of `inconclusive`, whether it is because the discs show a gap that the best does not answer for.
    """

    verdict: Verdict
    answer: tuple[str, ...]
    p_value: float
    tried: tuple[Tried, ...]
    probes: tuple[Tried, ...]
    best: Tried | None
    certain: tuple[str, ...] = ()
    amiss: tuple[str, ...] = ()
    discs_unexplained: bool = False

    @property
    def tied(self) -> tuple[str, ...]:
        """Of a tie the effects that cannot be told apart."""
        return (
            tuple(name for name in self.answer if name not in self.certain) if self.verdict == "tie" else ()
        )


# The model about a real refit with an effect in it, its columns beside the PSF's; none where there is no such fit.
Refitter = Callable[[Tried], LinearModel | None]


def no_refit(tried: Tried) -> LinearModel | None:
    """Where no effect is added to the model for real."""
    return None


def judge(model: LinearModel, refit: Refitter = no_refit, beyond: Refitter = no_refit) -> Judgement:
    """The verdict under the model's floor, and twice with others.

    refit, beyond: the model about a real refit with one effect or some, and the same with the effect always fitted and
    the rest of the library beside it. Each is asked at most once for the same.
    """
    once, further = _once(refit), _once(beyond)
    found = first = _judge(model, once, further)
    amiss: list[Tried] = []
    while (
        refit is not no_refit and found.answer and (best := found.best) and _fails_for_real(model, best, once)
    ):
        if len(amiss) == MOST_AMISS or len(best.names) > 1:
            found = replace(found, verdict="inconclusive", answer=(), certain=())
            return replace(found, amiss=(*_labels(amiss), best.label), tried=(*found.tried, *amiss))
        # What it does to first order it does not do in the model for real: the others are asked.
        amiss.append(best)
        gone = {name for tried in amiss for name in tried.names}
        others = tuple(effect for effect in model.evidence.effects if effect.name not in gone)
        model = replace(model, evidence=replace(model.evidence, effects=others))
        found = replace(_judge(model, once, further), p_value=first.p_value)
    found = _confirmed(model, found, once, further)
    if amiss and found.verdict == "none":
        found = replace(found, verdict="inconclusive")
    if refit is not no_refit and found.verdict == "tie" and not found.certain:
        found, fallen = _without_those_that_fail(model, found, once)
        amiss += fallen
    rest = (tried for tried in found.tried if tried not in amiss)
    return replace(found, amiss=_labels(amiss), tried=(*rest, *amiss))


def _labels(tried: Sequence[Tried]) -> tuple[str, ...]:
    return tuple(one.label for one in tried)


def _without_those_that_fail(
    model: LinearModel, found: Judgement, refit: Refitter
) -> tuple[Judgement, list[Tried]]:
    """A tie without those of its single effects that fail in the model for real, and these; of MOST_AMISS it is asked."""
    alone = [t for t in found.tried if t is not found.best and len(t.names) == 1 and t.label in found.answer]
    fallen = [tried for tried in alone[:MOST_AMISS] if _fails_for_real(model, tried, refit)]
    answer = tuple(name for name in found.answer if name not in _labels(fallen))
    return replace(found, verdict="tie" if len(answer) > 1 else "attributed", answer=answer), fallen


def _confirmed(model: LinearModel, found: Judgement, once: Refitter, further: Refitter) -> Judgement:
    """A verdict under the model's floor, as it stands on images held out and under other floors."""
    if found.answer and _worse_held_out(model, found, once):
        return replace(found, verdict="inconclusive")
    if found.verdict == "none" and len(model.evidence.discs) < LEAST_IMAGES:
        return replace(found, verdict="inconclusive")
    if found.verdict in ("none", "inconclusive"):
        return found
    others = [_judge(replace(model, floor=model.floor * factor), once, further, LENIENT) for factor in FLOORS]
    if any(other.verdict in ("none", "inconclusive") for other in others):
        of_discs = any(other.discs_unexplained for other in others)
        return replace(found, verdict="inconclusive", discs_unexplained=of_discs)
    if any((other.verdict == "unknown") != (found.verdict == "unknown") for other in others):
        return replace(found, verdict="inconclusive")
    every = (found, *others)
    answers = {name for one in every for name in one.answer}
    if len({_acting(one) for one in every}) > 1 or answers == set(found.answer):
        return found
    certain = set.intersection(*(set(one.answer) - set(one.tied) for one in every))
    return replace(found, verdict="tie", answer=tuple(sorted(answers)), certain=tuple(sorted(certain)))


def _fails_for_real(model: LinearModel, tried: Tried, refit: Refitter) -> bool:
    """Whether of what an effect explains in the linear model, wherever that is most, a real refit explains less than half,
    or cannot be made."""
    real = refit(tried)
    if real is None:
        return True
    # A refit finds the discs anew and may lose one.
    both = set(model.evidence.images) & set(real.evidence.images)
    real = replace(real, floor=model.floor)
    nothing, linear = (left_chi2(model, step, both) for step in (model.base, tried.step))
    added = left_chi2(real, real.fit(real.evidence.of_effects), both)
    most = int(np.argmax(nothing - linear))
    explained = float(nothing[most] - linear[most])
    return explained > 0 and float(nothing[most] - added[most]) < explained / 2


def _acting(found: Judgement) -> int:
    """How many effects act."""
    return 0 if found.best is None else len(found.best.names)


def _worse_held_out(model: LinearModel, found: Judgement, refit: Refitter) -> bool:
    """Whether the answer says less than nothing of images held out of its fit, so that it fits by its freedom alone."""
    scheme = time_blocks(model)
    before = hold_out(model, (), scheme)
    if found.best is None or before is None:
        return False
    if model.evidence.all_unocculted.freedom and not before.unocculted_expected.any():
        return False  # few images: no two neighbours in one fold, so that nothing is asked of what the lit blocks show
    linear = hold_out(model, found.best.step.columns[len(model.evidence.base) :], scheme)
    if linear is not None and fall(before, linear) > 0:
        return False
    real = refit(found.best)
    after = None if real is None else hold_out(real, real.evidence.of_effects, scheme)
    tried = [one for one in (linear, after) if one is not None]
    return bool(tried) and all(fall(before, one) <= 0 for one in tried)


def _once(ask: Refitter) -> Refitter:
    asked: dict[str, LinearModel | None] = {}

    def once(tried: Tried) -> LinearModel | None:
        if tried.label not in asked:
            asked[tried.label] = ask(tried)
        return asked[tried.label]

    return once


def _judge(model: LinearModel, refit: Refitter, beyond: Refitter, lenient: float = 1.0) -> Judgement:
    """lenient: how many times likelier than usual a gap and an effect may be to come by chance."""
    evidence = model.evidence
    every = [fitted(model, (effect,)) for effect in evidence.effects]
    named = sorted((t for t in every if t.named), key=lambda t: -t.score)
    probes = tuple(sorted((t for t in every if not t.named), key=lambda t: -t.score))
    before = _left(model, model.base, np.zeros(len(model.base.columns)))
    p_gap = _p_of_gap(before, named)
    if p_gap > lenient * ALARM or not named:
        return Judgement("none", (), p_gap, tuple(named), probes, named[0] if named else None)
    # What was measured in the lit parts fits them whatever the cause: it is behind where its score is.
    measured = {t.label for t in named if evidence.numbers_of(_own(model, t))}
    outdone = measured if _few_numbers_do(named, measured) else set()
    others, failed = _held_out_first(model, [t for t in named if t.label not in outdone])
    named = [*others, *(t for t in named if t.label in outdone)]
    failed |= outdone
    best = named[0] = _with_left(model, named[0], before, refit)
    # So does a probe that was measured there; it counts beside another such alone, or where it explains clearly more.
    fits_all = {t.label for t in probes if evidence.numbers_of(_own(model, t))}
    probes = tuple(
        t
        for t in probes
        if t.label not in fits_all or best.label in measured or best.gain < (1 - LEFT_SHARE) * t.gain
    )
    behind = measured | failed | (set() if best.label in measured else fits_all)
    others_near = [t for t in (*named[1:], *probes) if t.label not in behind]
    rivals = max((t.score for t in others_near), default=0.0)
    enough = _is_enough(best, rivals)
    if not enough and (best.explains or best.label in measured) and rivals < BEHIND * best.score:
        second = _beside(model, best, beyond)
        if second is not None:
            return replace(second, p_value=p_gap, tried=(*second.tried, *named), probes=probes)
        of_few = max((t.score for t in others_near if t.label not in fits_all), default=0.0)
        if best.label in measured and of_few < UNRIVALLED * best.score:
            # A Sun that changes faster than it is followed: much is left in the lit parts, and the discs' places,
            # found by what the neighbours show, are off.
            return Judgement("attributed", best.names, p_gap, tuple(named), probes, best)
    pair = _best_pair(model, best, before, refit, enough=enough)
    winner = pair or best
    if (not enough and pair is None) or best.p_value * len(named) > lenient * ALARM:
        return Judgement("unknown", (), p_gap, tuple(named), probes, best)
    to_beat = winner.score - CLEAR if not enough else max(winner.score - CLEAR, best.score + CLEAR)
    if probes and probes[0].score > to_beat:
        return Judgement("unknown", (), p_gap, tuple(named), probes, winner)
    if pair is None and (
        best.p_value * len(named) > lenient * CONFIDENT or (probes and _explains_more(probes[0], best))
    ):
        return Judgement("inconclusive", (), p_gap, tuple(named), probes, best)
    if pair is not None:
        instead = _in_place_of_one(model, pair)
        others_do = {name for one in instead.values() for name in one}
        if best.explains and instead.get(best.names[0]) == {} and len(others_do) + 1 > MOST_SECONDS:
            return Judgement("attributed", best.names, p_gap, tuple(named), probes, best)
        answer = tuple(sorted({*pair.names, *others_do}))
        certain = tuple(name for name in pair.names if others_do and not instead[name])
        verdict: Verdict = "tie" if others_do else "attributed"
        pairs = (pair, *(other for one in instead.values() for other in one.values()))
        return Judgement(verdict, answer, p_gap, (*pairs, *named), probes, pair, certain)
    alike = max(
        TIE, TIE_SHARE * best.gain, (1 - NEAR_BEHIND) * best.score if _searched(best, evidence) else 0.0
    )
    tied = [
        t.names[0]
        for t in named[1:]
        if t.label not in failed and best.score - t.score < (TIE if _freer(t, best, measured) else alike)
    ]
    if tied:
        return Judgement("tie", tuple(sorted({*best.names, *tied})), p_gap, tuple(named), probes, best)
    if probes and _searched(best, evidence) and best.score - probes[0].score < alike:
        return Judgement("unknown", (), p_gap, tuple(named), probes, best)
    return Judgement("attributed", best.names, p_gap, tuple(named), probes, best)


def _few_numbers_do(named: Sequence[Tried], measured: set[str]) -> bool:
    """Whether an effect of few numbers gains nearly as much as the best, which was measured in the lit parts: it would
    not unless it were the cause."""
    best = named[0]
    rivals = (t.gain for t in named if t.label not in measured)
    return best.label in measured and max(rivals, default=0.0) >= (1 - LEFT_SHARE) * best.gain


def _held_out_first(model: LinearModel, named: Sequence[Tried]) -> tuple[list[Tried], set[str]]:
    """Of effects that are about as good as the best, those first that are as good on images held out of their fit; and
    the labels of those that are clearly not: they fit by their freedom."""
    best = named[0]
    alike = [t for t in named if best.score - t.score < max(TIE, TIE_SHARE * best.gain)]
    scheme = time_blocks(model)
    before = hold_out(model, (), scheme)
    base = len(model.evidence.base)
    if len(alike) < 2 or before is None:
        return list(named), set()
    falls = {}
    for tried in alike:
        after = hold_out(model, tried.step.columns[base:], scheme)
        falls[tried.label] = 0.0 if after is None else fall(before, after)
    most = max(falls.values())
    nearly = max(TIE, TIE_SHARE * most)
    # The deviance of images that tell two models apart by so much is uncertain by twice its root: by no more than by
    # that of what the best is told apart from nothing by. Until it is beyond that an effect comes later, and no more.
    by_chance = HELD_OUT_SIGMA * 2 * math.sqrt(max(most, 0.0))
    failed = {label for label, down in falls.items() if down < most - max(nearly, by_chance)}

    def place(tried: Tried) -> tuple[bool, bool, float]:
        last = tried not in alike or tried.label in failed
        return last, not last and falls[tried.label] < most - nearly, -tried.score

    return sorted(named, key=place), failed


def _beside(model: LinearModel, best: Tried, beyond: Refitter) -> Judgement | None:
    """The verdict where one effect explains most of a gap and not all: is another at work beside it? None where that
    cannot be said; the one alone where more than MOST_SECONDS could be the other. Its tried are the answer's alone.

    So too where the best was measured in the lit parts and leaves much there: a Sun that flickers faster than it is
    followed. The discs do not show that, and what they show is judged by itself: two effects may be at work there, and
    where it cannot be told which are, the verdict is inconclusive."""
    rest = beyond(best)
    if rest is None:
        return None
    effects = {effect.name: effect for effect in model.evidence.effects}
    still = tuple(effect for effect in rest.evidence.effects if effect.name in effects)
    rest = replace(rest, evidence=replace(rest.evidence, effects=still))
    unocculted = rest.evidence.steady_unocculted
    rest = replace(rest, floor=model.floor)
    # Of so much as the first explained in the lit parts a little is left, its form being not quite the sky's: no form
    # that fits this remainder by chance may come out of it.
    excess = rest.left_unocculted(rest.base) - (
        unocculted.freedom - rest.evidence.numbers_of(rest.base.columns)
    )
    rest = replace(rest, unocculted_scale=rest.unocculted_scale * max(excess / CLEAR, 1.0))
    second = _judge(rest, no_refit, no_refit)
    if second.verdict == "none":
        return Judgement("attributed", best.names, second.p_value, (), (), best) if best.explains else None
    unocculted_alone = _unocculted_alone(model, best)
    if second.best is None or second.verdict not in ("attributed", "tie"):
        # Occulters that are where they were found say that the discs' gap is not made by what changes in the lit parts.
        found_well = all(model.evidence.image_info[n].described for n in model.evidence.images)
        if not (unocculted_alone and found_well):
            return None
        return Judgement("inconclusive", (), second.p_value, (), (), best, discs_unexplained=True)
    if len(second.best.names) > 1 and not unocculted_alone:
        return None
    if len(second.answer) > MOST_SECONDS and best.explains:
        return Judgement("attributed", best.names, second.p_value, (), (), best)
    instead = [t.names for t in second.tried if len(t.names) > 1 and set(t.names) <= set(second.answer)]
    if len(second.best.names) == 1:
        instead = [(name,) for name in second.answer]
    beside = dict.fromkeys((second.best.names, *instead))
    joint = [fitted(model, [effects[name] for name in (*best.names, *names)]) for names in beside]
    if not all(_takes_part(name, one) for one in joint for name in one.names):
        return None
    pair, *others = joint
    pair = replace(pair, left_p_value=second.best.left_p_value, left_share=second.best.left_share)
    answer = tuple(sorted({*best.names, *second.answer}))
    certain = (*best.names, *second.certain) if second.verdict == "tie" else ()
    return Judgement(second.verdict, answer, second.p_value, (pair, *others), (), pair, certain)


def _own(model: LinearModel, tried: Tried) -> list[int]:
    """The columns of what was tried, without those that are fitted beside it whatever is."""
    return [column for column in tried.step.columns if column not in model.evidence.base]


def _unocculted_alone(model: LinearModel, tried: Tried) -> bool:
    """Whether an effect was measured in the lit parts and no disc answers to it."""
    own = _own(model, tried)
    silent = all(not disc.jacobian[own].any() for disc in model.evidence.discs)
    return silent and model.evidence.numbers_of(own) > 0


def _explains_more(probe: Tried, best: Tried) -> bool:
    """A probe that is ahead by having fewer numbers alone is a simpler form of the effect: it explains nothing more. Nor
    does one of many numbers that gains by them no more than noise lets it."""
    more = probe.gain - best.gain
    numbers = max(len(probe.values) - len(best.values), 1)
    return probe.score > best.score and more > TIE and float(chdtrc(numbers, more)) < BY_CHANCE


def _freer(tried: Tried, best: Tried, measured: set[str]) -> bool:
    """Whether an effect has more freedom than the best: if it does worse all the same, it is not its form that is amiss."""
    return tried.label in measured or len(tried.values) > len(best.values)


def _searched(tried: Tried, evidence: Evidence) -> bool:
    """Whether a place was looked for all over the field."""
    return any(effect.trials >= MANY_PLACES for effect in evidence.effects if effect.name in tried.names)


def _is_enough(tried: Tried, rival_score: float) -> bool:
    assert tried.left_p_value is not None and tried.left_share is not None
    nearly = tried.left_share < LEFT_SHARE and rival_score < BEHIND * tried.score
    return tried.left_p_value >= ENOUGH or nearly


def _best_pair(
    model: LinearModel, best: Tried, before: _Left, refit: Refitter, *, enough: bool
) -> Tried | None:
    """The pair of effects that explains most, if it is clearly better than one and leaves nothing."""
    couples = itertools.combinations((effect for effect in model.evidence.effects if effect.named), 2)
    if enough:
        with_best = (two for two in couples if best.names[0] in (two[0].name, two[1].name))
        pair = _second(model, best, [fitted(model, two) for two in with_best])
    else:
        pairs = (fitted(model, two) for two in couples)
        pair = max(pairs, key=lambda t: t.score, default=None)
        pair = None if pair is None or pair.score < best.score + CLEAR else pair
    if pair is None:
        return None
    pair = _with_left(model, pair, before, refit)
    # Two forms that are not quite right fit too much: of a pair nothing may be left.
    return pair if (pair.left_p_value or 0.0) >= ENOUGH else None


def _second(model: LinearModel, best: Tried, pairs: Sequence[Tried]) -> Tried | None:
    """Of pairs with an effect that is enough alone, the one that explains most more; none where that is within what a
    search finds in noise, or within what the first's own form may be wrong by: a share of what it explains in the discs,
    and one of what it explains in the lit parts. What the first alone explains in the model for real, and not to first
    order, is no second's."""
    alone, nothing = left_chi2(model, best.step), left_chi2(model, model.base)
    if best.left_for_real is not None:
        alone = np.minimum(alone, best.left_for_real)
    amiss = TEMPLATE_ERROR**2 * np.maximum(nothing - alone, 0.0)
    found: Tried | None = None
    most = 0.0
    for pair in pairs:
        second = next(name for name in pair.names if name not in best.names)
        beyond = float(np.maximum(alone - left_chi2(model, pair.step) - amiss, 0.0).sum())
        gain = min(pair.gain - best.gain, beyond)
        by_chance = pair.freedom.beside(best.freedom).p_value(gain) * len(pairs)
        lead = gain - (pair.gain - pair.score) + (best.gain - best.score)
        if by_chance < CONFIDENT and lead > max(TIE, most) and _takes_part(second, pair):
            found, most = pair, lead
    return found


def left_chi2(model: LinearModel, step: Step, images: Collection[int] | None = None) -> Vector:
    """What a step leaves in the discs, of some images (none: all), and in the lit parts."""
    discs = zip(model.evidence.images, model.left(step), strict=True)
    left = sum(float(one @ one) for n, one in discs if images is None or n in images)
    return np.array([left, model.left_unocculted(step)])


def _in_place_of_one(model: LinearModel, pair: Tried) -> dict[str, dict[str, Tried]]:
    """For each effect of a pair those others that explain, beside the one that stays, about as much as it does: by name
    the pairs that they make."""
    effects = {effect.name: effect for effect in model.evidence.effects if effect.named}
    found: dict[str, dict[str, Tried]] = {name: {} for name in pair.names}
    for stays, goes in (pair.names, pair.names[::-1]):
        alone = fitted(model, (effects[stays],))
        adds = pair.score - alone.score
        alike = max(TIE, TIE_SHARE * (pair.gain - alone.gain))
        if effects[goes].trials >= MANY_PLACES:
            alike = max(alike, (1 - NEAR_BEHIND) * adds)
        for name in (name for name in effects if name not in pair.names):
            other = fitted(model, (effects[stays], effects[name]))
            if _takes_part(name, other) and pair.score - other.score < min(alike, adds):
                found[goes][name] = other
    return found


def _takes_part(name: str, pair: Tried) -> bool:
    """Whether any of an effect's numbers is left in a pair."""
    return any(key.startswith(f"{name}.") for key in pair.values)


def fitted(model: LinearModel, effects: Sequence[Effect], *, any_sign: bool = False) -> Tried:
    """The PSF's parameters with these effects.

    A parameter that can be positive alone and would not be is left out, unless any_sign: a step may have either. So
    is one whose change was measured in the lit parts and gains less than that costs.
    """
    columns = {
        column: (effect, parameter)
        for effect in effects
        # What is fitted by pointing has a change for each that there is: fewer or more than it has parameters.
        for column, parameter in zip(model.evidence.columns[effect.name], effect.parameters, strict=False)
    }
    step = model.fit(tuple(columns))
    base = len(model.evidence.base)
    while not any_sign:
        idle = _not_worth_its_numbers(model, step)
        if idle is not None:
            del columns[idle]
            step = model.fit(tuple(columns))
            continue
        below = {
            column: float(value)
            for column, value in zip(step.columns[base:], step.values[base:], strict=True)
            if columns[column][1].positive and value <= 0
        }
        if not below:
            break
        del columns[min(below, key=lambda column: below[column])]
        step = model.fit(tuple(columns))
    gain = model.gain(step)
    trials = math.prod(effect.trials for effect in effects)
    learned = model.learned(tuple(columns))
    free = len(columns) - learned.size + model.evidence.numbers_of(tuple(columns))
    shares = learned / (1 + learned)
    by_chance = Freedom(free + float(shares.sum()), free + float((shares**2).sum()), trials)
    sigma = np.sqrt(np.maximum(np.diag(step.covariance), 0.0))
    values = {}
    for k, (effect, parameter) in enumerate(columns.values(), base):
        label = parameter.name if len(effects) == 1 else f"{effect.name}.{parameter.name}"
        values[label] = (float(step.values[k]), float(sigma[k]), parameter.unit)
    return Tried(
        names=tuple(effect.name for effect in effects),
        named=all(effect.named for effect in effects),
        values=values,
        gain=gain,
        score=gain - PENALTY * free - float(np.log1p(learned).sum()) - 2 * math.log(trials),
        p_value=by_chance.p_value(gain),
        freedom=by_chance,
        step=step,
    )


def _not_worth_its_numbers(model: LinearModel, step: Step) -> int | None:
    """The column of a step that gains least of those that gain less than the numbers in them cost; none where none does."""
    columns = step.columns[len(model.evidence.base) :]
    idle = {}
    for column in columns:
        numbers = model.evidence.numbers_of([column])
        gain = step.fall - model.fit([c for c in columns if c != column]).fall if numbers else 0.0
        if numbers and gain < PENALTY * (1 + numbers):
            idle[column] = gain
    return min(idle, key=lambda column: idle[column]) if idle else None


def _p_of_gap(left: _Left, named: Sequence[Tried]) -> float:
    """The least of the p-values of patterns, cells, lit blocks and single effects, times how many they are."""
    effects = min((t.p_value for t in named), default=1.0) * max(len(named), 1)
    tests = (*left.p_values, effects)
    return float(min(1.0, len(tests) * min(tests)))


@dataclass(frozen=True)
class _Left:
    """What a step leaves, and of how many degrees of freedom: along patterns, in the discs' means, in all cells, in the
    lit blocks."""

    gains: tuple[float, ...]
    freedom: tuple[int, ...]

    @property
    def p_values(self) -> tuple[float, ...]:
        """Of each."""
        return tuple(float(chdtrc(k, gain)) for gain, k in zip(self.gains, self.freedom, strict=True))

    @property
    def p_value(self) -> float:
        """The least of them, counted for how many they are."""
        return min(1.0, len(self.gains) * min(self.p_values))

    def share_of(self, before: _Left) -> float:
        """The largest share of the excess that is left, of those that are not likely anyway."""
        shares = [
            max(gain - k, 0.0) / max(gain_before - k_before, 1e-9)
            for gain, k, p, gain_before, k_before in zip(
                self.gains, self.freedom, self.p_values, before.gains, before.freedom, strict=True
            )
            if p < ENOUGH
        ]
        return max(shares, default=0.0)

    def of_most(self, before: _Left) -> float:
        """Of what showed the largest excess before, the share of it that is left."""
        excess = [gain - k for gain, k in zip(before.gains, before.freedom, strict=True)]
        most = int(np.argmax(excess))
        return max(self.gains[most] - self.freedom[most], 0.0) / max(excess[most], 1e-9)


def _with_left(model: LinearModel, tried: Tried, before: _Left, refit: Refitter) -> Tried:
    """With what is left: in the linear model, and where that is too much, after a real refit."""
    unsure = np.array(tried.step.values) * TEMPLATE_ERROR
    unsure[: len(model.base.columns)] = 0.0
    left = _left(model, tried.step, unsure)
    for_real = None
    if left.p_value < ENOUGH and tried.values:
        again = refit(tried)
        if again is not None and again.evidence.size == unsure.size:
            again = replace(again, floor=model.floor)
            step = again.fit(again.evidence.of_effects)
            left = max(left, _left(again, step, unsure), key=lambda one: one.p_value)
            for_real = left_chi2(again, step) if again.evidence.images == model.evidence.images else None
    return replace(
        tried,
        left_p_value=left.p_value,
        left_share=left.share_of(before),
        explains=left.of_most(before) < LEFT_SHARE,
        left_for_real=for_real,
    )


def _left(model: LinearModel, step: Step, unsure: Vector) -> _Left:
    """What a step leaves, its columns' own answers unsure by so much."""
    here = list(step.columns)
    # An unsure template adds a covariance along its own answer: taken off along that direction, disc by disc.
    shrink = []
    for disc, left in zip(model.discs, model.left(step), strict=True):
        answer = disc.jacobian[here].T @ unsure
        length = float(answer @ answer)
        shrink.append(left - answer * float(answer @ left) / (1 + length))
    freedom = max(sum(left.size for left in shrink) - len(here), 1)
    cells = sum(float(left @ left) for left in shrink)
    gain, directions = model.gain_of_patterns(step, model.patterns, shrink)
    of_means, images = model.gain_of_patterns(step, model.means, shrink)
    unocculted = model.evidence.steady_unocculted
    moved = float(unsure @ unocculted.normal[np.ix_(here, here)] @ unsure) / model.unocculted_scale
    of_unocculted = max(model.left_unocculted(step) - moved, 0.0) / (1 + UNOCCULTED_WIDTH)
    of_unocculted_freedom = max(unocculted.freedom - model.evidence.numbers_of(here), 1)
    return _Left((gain, of_means, cells, of_unocculted), (directions, images, freedom, of_unocculted_freedom))
