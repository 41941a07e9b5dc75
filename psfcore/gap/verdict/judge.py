"""The verdict: whether there is a gap, and which effect causes it.

Terms:

- floor: a relative error, common to all cells of a disc, that allows for unknown causes (`linear_model`, Eq. (2)).
- gain of an effect: the decrease of chi2 when its parameters are fitted together with the PSF.
- rival of an effect: any other effect or probe that is tested on the same data.
- probe: a pattern that is typical of gaps of unknown cause (`library.probes`). No verdict names a probe.
- measured effect: an effect whose change of the images was measured in the unocculted field itself (`Change.numbers`).
- answer: the effects that the verdict names as the cause of the gap.

Effects are compared by their score: the gain, minus what their parameters and a search over many positions would gain
from noise alone:

    score = gain - PENALTY parameters - cost of a random field - 2 ln trials       Eq. (1)

The verdict follows these rules:

- There is a gap if a p-value, corrected for the number of tests, is below ALARM. The tests are: the patterns that any gap
  produces (`patterns`), the means of the discs, all cells, the unocculted blocks, and the gains of the effects.
- An effect is tied with the best one if the two scores differ by less than TIE, or by less than TIE_SHARE of the best
  gain. The limit is wider if the best effect searched for a position. An effect that predicts held-out images clearly
  worse is not tied.
- An effect is called enough (it explains the gap) in two cases. In the first case, the residuals after the effect have a
  p-value of at least ENOUGH, where the template may have a relative error TEMPLATE_ERROR. In the second case, less than
  LEFT_SHARE of the gap remains, and no rival has a score close to that of the effect. The second case allows for an
  effect whose template is slightly wrong.
- A second effect is named with the first one if its additional gain is large enough. It must exceed the gain that a
  search in noise gives, and the gain that an error of the first template gives. The second effect gets no credit for what
  a full refit of the first effect explains.
- The linear model holds only for a small gap. If the best effect is not enough in the linear model, it is added to the
  model in a full refit, and the residuals of that refit are judged. If no single effect is enough, all pairs are tried.
- Closing much of a gap does not identify its cause, because a wrong effect can do that too. The verdict is `unknown` if
  no effect and no pair is enough, or if a probe has a clearly higher score. It is `inconclusive` if a probe has a slightly
  higher score and explains more, or if the gain of the effect is not significant enough.
- The verdict is made again with half the floor and with twice the floor. These repetitions accept p-values that are larger
  by the factor LENIENT. If they name other effects, the answer contains the effects of all three verdicts, or the verdict
  is `inconclusive`. It is also `inconclusive` if the model with the answer predicts held-out images worse than the model
  without any effect.
- An effect is excluded if it explains in a full refit less than half of what it explains in the linear model. The verdict
  is then made without this effect. If a pair fails this test, the verdict is `inconclusive`.
- A measured effect fits the unocculted field whatever the cause. If an effect of few parameters gains nearly as much, it
  is preferred. If the scores of all other effects, except measured ones, are below UNRIVALLED times the best score, the
  measured effect is the answer, however much it leaves in the unocculted field. A gap in the discs is then judged
  separately, with the measured effect in the model. One or two effects can be named with it. If none can be named, and
  the positions of all occulters are reliable, the verdict is `inconclusive`.
- Effects that could replace one member of a pair are named too. If there are many of them, only the other member is
  named.
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

FLOORS = (0.5, 2.0)  # factors by which the floor is multiplied to repeat the verdict
ALARM = 0.005  # a gap is claimed below this p-value, corrected for the number of tests
CONFIDENT = 1e-3  # largest p-value of an effect that the verdict names, corrected for the number of effects
ENOUGH = 1e-3  # smallest p-value of the residuals after an effect that is enough
PENALTY = 2.0  # cost of one parameter in the score
TIE = 9.0  # effects whose scores differ by less are tied
HELD_OUT_SIGMA = 1.0  # an effect is clearly worse on held-out images beyond this number of standard errors
TIE_SHARE = 0.03  # effects are tied within this fraction of the best gain: no template is more exact
LEFT_SHARE = 0.15  # an effect explains the gap if less than this fraction of the gap remains
BEHIND = 0.85  # a rival is close if its score exceeds this fraction of the best score
# If the best effect searched for its position, effects above this fraction of its score are tied with it: such an effect
# fits any gap to some degree.
NEAR_BEHIND = 0.7
UNRIVALLED = 0.1  # a measured effect is unrivalled if effects that were not measured stay below this fraction of its score
# An effect with at least this number of trials searched for its position in the whole field.
MANY_PLACES = 100
MOST_SECONDS = 2  # no second effect is named if more than this number of effects could be the second one
CLEAR = 12.0  # difference of scores by which a pair is clearly better than one effect, or a probe than all effects
TEMPLATE_ERROR = 0.05  # relative error of an effect's template
# Chi2 of the unocculted field may exceed its degrees of freedom by this fraction without a gap.
UNOCCULTED_WIDTH = 0.03
# With the other two floors, the p-values of a gap and of its cause may be larger by this factor.
LENIENT = 5.0
BY_CHANCE = 0.01  # a probe explains more if noise gives its additional gain with a probability below this
MOST_AMISS = 2  # most effects that failed refits may exclude; also the most tied effects that are refitted
# With fewer images no image can be held out, and a gap may exist although the images do not show it.
LEAST_IMAGES = 6


@dataclass(frozen=True)
class Freedom:
    """The gain of an effect from noise alone: the largest of `trials` chi2 variables with this mean and half variance."""

    mean: float
    half_variance: float
    trials: float

    def beside(self, first: Freedom) -> Freedom:
        """The distribution of the additional gain from noise, compared with the fit `first`, whose effects this fit contains."""
        return Freedom(
            max(self.mean - first.mean, 1.0),
            max(self.half_variance - first.half_variance, 1.0),
            max(self.trials / first.trials, 1.0),
        )

    def p_value(self, gain: float) -> float:
        """The probability that noise alone gains at least `gain`; from a chi2 distribution with this mean and variance."""
        if self.half_variance <= 0:
            return 1.0
        share = self.mean / self.half_variance
        return min(1.0, self.trials * float(chdtrc(self.mean * share, max(gain, 0.0) * share)))


@dataclass(frozen=True, eq=False)
class Tried:
    """The linear fit of one effect, or of several effects, together with the PSF.

    named: whether a verdict may name all these effects; false for a probe. values: value, error and unit of each parameter;
    the key is "parameter", or "effect.parameter" if there are several effects. gain: the decrease of chi2. score: Eq. (1).
    p_value: of the gain. freedom: the gain from noise alone. step: the fit.
    The others are set only where the residuals were judged. left_p_value: p-value of the residuals in patterns, means, cells
    and unocculted blocks. left_share: excess of chi2 over its degrees of freedom that remains there, as a fraction of the
    excess without the effect; the largest of the significant ones. explains: whether less than LEFT_SHARE remains of the
    strongest excess. left_for_real: `left_chi2` of the full refit; None without a refit, or if its images differ.
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
        """The names of the effects, as the report writes them."""
        return label_of(self.names)


def label_of(names: Sequence[str]) -> str:
    """Names of effects, as the report writes them."""
    return " + ".join(names)


@dataclass(frozen=True, eq=False)
class Judgement:
    """A verdict with one floor, or the final verdict.

    answer: the effects that the verdict names; for `inconclusive`, the effects of the best fit, which are not certain enough,
    or empty. tried: fits of all effects except probes, in this order: pairs of the answer, single effects with the best
    first, fits that failed in a full refit. amiss: labels of the fits that failed in a full refit. probes: fits of the
    probes, best first. best: the fit with the best effects. certain: for a tie, the effects that act together with any of
    the tied effects; empty if each tied effect acts alone. discs_unexplained: for `inconclusive`, whether the reason is a
    gap in the discs that the best effect does not explain.
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
        """For a tie, the effects that these data cannot separate; empty for other verdicts."""
        return (
            tuple(name for name in self.answer if name not in self.certain) if self.verdict == "tie" else ()
        )


# A function that makes a full refit with the effects of a fit. It returns the linear model at the refit, in which the
# columns of the effects follow the columns of the PSF; None if the refit failed.
Refitter = Callable[[Tried], LinearModel | None]


def no_refit(tried: Tried) -> LinearModel | None:
    """A Refitter that makes no full refit and returns None."""
    return None


def judge(model: LinearModel, refit: Refitter = no_refit, beyond: Refitter = no_refit) -> Judgement:
    """The final verdict: made with the floor of the model, and confirmed with two other floors.

    refit: returns the linear model at a full refit with these effects. beyond: returns the same model with the rest of the
    library added, in which the effects of the refit are always fitted. Each is called at most once for the same effects.
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
        # The full refit does not confirm the linear fit of this effect: judge the other effects.
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
    """Two results: the tie without the single effects that fail in a full refit, and the fits of these effects.

    At most MOST_AMISS of the tied effects are refitted, in addition to the best one.
    """
    alone = [t for t in found.tried if t is not found.best and len(t.names) == 1 and t.label in found.answer]
    fallen = [tried for tried in alone[:MOST_AMISS] if _fails_for_real(model, tried, refit)]
    answer = tuple(name for name in found.answer if name not in _labels(fallen))
    return replace(found, verdict="tie" if len(answer) > 1 else "attributed", answer=answer), fallen


def _confirmed(model: LinearModel, found: Judgement, once: Refitter, further: Refitter) -> Judgement:
    """The verdict `found` after the test on held-out images and the repetition with the other floors."""
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
    """Whether the full refit with an effect fails, or explains less than half of what the linear model explains.

    "Explains" means the decrease of chi2, either in the discs or in the unocculted field: where the linear model explains
    more.
    """
    real = refit(tried)
    if real is None:
        return True
    # A refit locates the discs again and may drop an image.
    both = set(model.evidence.images) & set(real.evidence.images)
    real = replace(real, floor=model.floor)
    nothing, linear = (left_chi2(model, step, both) for step in (model.base, tried.step))
    added = left_chi2(real, real.fit(real.evidence.of_effects), both)
    most = int(np.argmax(nothing - linear))
    explained = float(nothing[most] - linear[most])
    return explained > 0 and float(nothing[most] - added[most]) < explained / 2


def _acting(found: Judgement) -> int:
    """The number of effects in the best fit."""
    return 0 if found.best is None else len(found.best.names)


def _worse_held_out(model: LinearModel, found: Judgement, refit: Refitter) -> bool:
    """Whether the model with the best effects predicts held-out images worse than the model without any effect.

    If so, the effects fit well only because of their free parameters.
    """
    scheme = time_blocks(model)
    before = hold_out(model, (), scheme)
    if found.best is None or before is None:
        return False
    if model.evidence.all_unocculted.freedom and not before.unocculted_expected.any():
        return False  # no fold leaves two fitted images of a pointing: the unocculted blocks are not tested
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
    """The verdict with the floor of the model.

    lenient: factor on the p-values below which a gap and an effect count as significant.
    """
    evidence = model.evidence
    every = [fitted(model, (effect,)) for effect in evidence.effects]
    named = sorted((t for t in every if t.named), key=lambda t: -t.score)
    probes = tuple(sorted((t for t in every if not t.named), key=lambda t: -t.score))
    before = _left(model, model.base, np.zeros(len(model.base.columns)))
    p_gap = _p_of_gap(before, named)
    if p_gap > lenient * ALARM or not named:
        return Judgement("none", (), p_gap, tuple(named), probes, named[0] if named else None)
    # A measured effect fits the unocculted field whatever the cause, so it does not count as a rival.
    measured = {t.label for t in named if evidence.numbers_of(_own(model, t))}
    outdone = measured if _few_numbers_do(named, measured) else set()
    others, failed = _held_out_first(model, [t for t in named if t.label not in outdone])
    named = [*others, *(t for t in named if t.label in outdone)]
    failed |= outdone
    best = named[0] = _with_left(model, named[0], before, refit)
    # A measured probe also fits it: the probe counts only against a measured effect, or if it explains clearly more.
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
            # The Sun changes faster than the cadence of the images. Much of the gap then remains in the unocculted field,
            # and the fitted positions of the discs are wrong, because they depend on neighbouring images.
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
    """Whether the best effect is a measured effect, and an effect that was not measured gains nearly as much.

    The second effect has few parameters. It could not gain nearly as much if it were not the cause.
    """
    best = named[0]
    rivals = (t.gain for t in named if t.label not in measured)
    return best.label in measured and max(rivals, default=0.0) >= (1 - LEFT_SHARE) * best.gain


def _held_out_first(model: LinearModel, named: Sequence[Tried]) -> tuple[list[Tried], set[str]]:
    """Two results: the effects sorted again, and the labels of the effects that are clearly worse on held-out images.

    Several effects may have about the best score. Among them, those come first that predict held-out images about as well
    as the best one does. Those that predict these images clearly worse fit well only because of their free parameters.
    """
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
    # The standard error of a difference of deviance D between two models is about 2 sqrt(D). Its largest value is that for
    # the best effect compared with no effect. Within this error an effect comes later in the order; beyond it, the effect
    # fails.
    by_chance = HELD_OUT_SIGMA * 2 * math.sqrt(max(most, 0.0))
    failed = {label for label, down in falls.items() if down < most - max(nearly, by_chance)}

    def place(tried: Tried) -> tuple[bool, bool, float]:
        last = tried not in alike or tried.label in failed
        return last, not last and falls[tried.label] < most - nearly, -tried.score

    return sorted(named, key=place), failed


def _beside(model: LinearModel, best: Tried, beyond: Refitter) -> Judgement | None:
    """The verdict if the best effect explains most of the gap, but not all of it: does a second effect act?

    None if this cannot be decided. The verdict names the best effect alone if more than MOST_SECONDS effects could be the
    second. `tried` contains only the fits of the answer.
    This function also serves if the best effect is a measured effect that leaves much in the unocculted field. An example is
    a Sun that flickers faster than the cadence of the images. The discs do not show such an effect, so their residuals are
    judged separately: two further effects may act in the discs. If these cannot be identified, the verdict is
    `inconclusive`.
    """
    rest = beyond(best)
    if rest is None:
        return None
    effects = {effect.name: effect for effect in model.evidence.effects}
    still = tuple(effect for effect in rest.evidence.effects if effect.name in effects)
    rest = replace(rest, evidence=replace(rest.evidence, effects=still))
    unocculted = rest.evidence.steady_unocculted
    rest = replace(rest, floor=model.floor)
    # The template of the first effect is not exact, so a small part of its change remains in the unocculted field. This
    # scale prevents that another template fits this remainder by chance.
    excess = rest.left_unocculted(rest.base) - (
        unocculted.freedom - rest.evidence.numbers_of(rest.base.columns)
    )
    rest = replace(rest, unocculted_scale=rest.unocculted_scale * max(excess / CLEAR, 1.0))
    second = _judge(rest, no_refit, no_refit)
    if second.verdict == "none":
        return Judgement("attributed", best.names, second.p_value, (), (), best) if best.explains else None
    unocculted_alone = _unocculted_alone(model, best)
    if second.best is None or second.verdict not in ("attributed", "tie"):
        # If the positions of the occulters are reliable, changes in the unocculted field do not cause the gap in the discs.
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
    """The columns of the effects of a fit, without the columns that every fit contains."""
    return [column for column in tried.step.columns if column not in model.evidence.base]


def _unocculted_alone(model: LinearModel, tried: Tried) -> bool:
    """Whether the fit is that of a measured effect, and this effect changes no disc."""
    own = _own(model, tried)
    silent = all(not disc.jacobian[own].any() for disc in model.evidence.discs)
    return silent and model.evidence.numbers_of(own) > 0


def _explains_more(probe: Tried, best: Tried) -> bool:
    """Whether a probe has a higher score than the best effect and also explains more.

    A probe may have a higher score only because it has fewer parameters, as a simpler template of the same effect. It then
    does not explain more. The same holds if noise could give its additional parameters the additional gain.
    """
    more = probe.gain - best.gain
    numbers = max(len(probe.values) - len(best.values), 1)
    return probe.score > best.score and more > TIE and float(chdtrc(numbers, more)) < BY_CHANCE


def _freer(tried: Tried, best: Tried, measured: set[str]) -> bool:
    """Whether an effect is measured, or has more parameters than the best effect.

    If such an effect has a lower score, the reason is not that its template is inexact.
    """
    return tried.label in measured or len(tried.values) > len(best.values)


def _searched(tried: Tried, evidence: Evidence) -> bool:
    """Whether an effect of this fit searched for its position in the whole field."""
    return any(effect.trials >= MANY_PLACES for effect in evidence.effects if effect.name in tried.names)


def _is_enough(tried: Tried, rival_score: float) -> bool:
    assert tried.left_p_value is not None and tried.left_share is not None
    nearly = tried.left_share < LEFT_SHARE and rival_score < BEHIND * tried.score
    return tried.left_p_value >= ENOUGH or nearly


def _best_pair(
    model: LinearModel, best: Tried, before: _Left, refit: Refitter, *, enough: bool
) -> Tried | None:
    """The pair of effects that explains most of the gap.

    None if no pair is clearly better than the best single effect, or if significant residuals remain after the best pair.
    enough: whether the best single effect is enough; then only pairs with this effect are tried.
    """
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
    # Two inexact templates can fit almost anything. A pair is therefore accepted only if its residuals are not significant.
    return pair if (pair.left_p_value or 0.0) >= ENOUGH else None


def _second(model: LinearModel, best: Tried, pairs: Sequence[Tried]) -> Tried | None:
    """The pair that explains most in addition to an effect that is enough alone (`best`); all `pairs` contain this effect.

    None if noise, found by the search over the pairs, can give the additional gain, or if an error of the first template
    can: a fraction of what the first effect explains, computed for the discs and for the unocculted field. The second effect
    gets no credit for what a full refit of the first effect explains.
    """
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
    """chi2 after a fit: two values, for the discs of some images (None: all images) and for the unocculted field."""
    discs = zip(model.evidence.images, model.left(step), strict=True)
    left = sum(float(one @ one) for n, one in discs if images is None or n in images)
    return np.array([left, model.left_unocculted(step)])


def _in_place_of_one(model: LinearModel, pair: Tried) -> dict[str, dict[str, Tried]]:
    """The other effects that could replace one effect of a pair, because the new pair explains about as much.

    The result has, for each effect of the pair, the fits of the new pairs by the name of the replacement.
    """
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
    """Whether the fit of a pair still contains a parameter of the effect `name`."""
    return any(key.startswith(f"{name}.") for key in pair.values)


def fitted(model: LinearModel, effects: Sequence[Effect], *, any_sign: bool = False) -> Tried:
    """Fit the coordinates of the PSF together with these effects.

    A parameter that must be positive is left out if its fitted value is not positive. A parameter whose change was measured
    in the unocculted field is left out if its gain is smaller than the cost of the measured numbers. any_sign: keep all
    parameters, whatever their sign and gain.
    """
    columns = {
        column: (effect, parameter)
        for effect in effects
        # An effect that is fitted for each pointing may have fewer or more changes than parameters.
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
    """The column of a fit that gains least, among the columns that gain less than their measured numbers cost.

    None if every column gains at least as much as its measured numbers cost.
    """
    columns = step.columns[len(model.evidence.base) :]
    idle = {}
    for column in columns:
        numbers = model.evidence.numbers_of([column])
        gain = step.fall - model.fit([c for c in columns if c != column]).fall if numbers else 0.0
        if numbers and gain < PENALTY * (1 + numbers):
            idle[column] = gain
    return min(idle, key=lambda column: idle[column]) if idle else None


def _p_of_gap(left: _Left, named: Sequence[Tried]) -> float:
    """The p-value of a gap: the smallest p-value of all tests, times the number of tests.

    The tests are the patterns, means, cells and unocculted blocks, and the gains of single effects.
    """
    effects = min((t.p_value for t in named), default=1.0) * max(len(named), 1)
    tests = (*left.p_values, effects)
    return float(min(1.0, len(tests) * min(tests)))


@dataclass(frozen=True)
class _Left:
    """What remains after a fit: chi2 (`gains`) and its degrees of freedom, for each of four tests.

    The tests are: the patterns, the means of the discs, all cells, and the blocks of the unocculted field.
    """

    gains: tuple[float, ...]
    freedom: tuple[int, ...]

    @property
    def p_values(self) -> tuple[float, ...]:
        """The p-value of each test."""
        return tuple(float(chdtrc(k, gain)) for gain, k in zip(self.gains, self.freedom, strict=True))

    @property
    def p_value(self) -> float:
        """The smallest p-value, times the number of tests."""
        return min(1.0, len(self.gains) * min(self.p_values))

    def share_of(self, before: _Left) -> float:
        """The largest fraction of the excess that remains, among the tests that are still significant. before: without effect."""
        shares = [
            max(gain - k, 0.0) / max(gain_before - k_before, 1e-9)
            for gain, k, p, gain_before, k_before in zip(
                self.gains, self.freedom, self.p_values, before.gains, before.freedom, strict=True
            )
            if p < ENOUGH
        ]
        return max(shares, default=0.0)

    def of_most(self, before: _Left) -> float:
        """The fraction of the excess that remains in the test that had the largest excess without the effect."""
        excess = [gain - k for gain, k in zip(before.gains, before.freedom, strict=True)]
        most = int(np.argmax(excess))
        return max(self.gains[most] - self.freedom[most], 0.0) / max(excess[most], 1e-9)


def _with_left(model: LinearModel, tried: Tried, before: _Left, refit: Refitter) -> Tried:
    """The same fit, with its residuals judged: in the linear model and, if they are significant there, also after a full refit."""
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
    """What remains after a fit. unsure: errors of its parameters that change the cells as much as errors of the templates do."""
    here = list(step.columns)
    # An inexact template adds a covariance in the direction of its change of the cells. Reduce the residuals of each disc
    # in this direction.
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
