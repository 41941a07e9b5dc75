"""The verdict: is there a gap, and which effect causes it.

Effects are compared by their gain (the decrease of chi2), minus what their parameters and a search over many places gain
from noise:

    score = gain - PENALTY parameters - cost of a random field - 2 ln trials       Eq. (1)

- There is a gap if the patterns that any gap makes (`patterns`), the discs' means, all cells, the unocculted blocks or an
  effect's gain have a p-value below ALARM, corrected for the number of tests.
- An effect is tied with the best one if its score is within TIE, or within TIE_SHARE of the best gain (more if a place
  was searched for), unless it predicts held-out images clearly worse.
- An effect is enough if its residuals have a p-value of at least ENOUGH, with an error TEMPLATE_ERROR of its form
  allowed; or if less than LEFT_SHARE of the gap remains and no rival comes near, because its form may be slightly wrong.
- A second effect is named together with it if it gains more than a search and the error of form allow, and more than a
  full refit of the first explains by itself, if one was made.
- The linear model holds only for a small gap. If the best effect is not enough in it, the effect is added to the model
  in a full refit, and the residuals of that refit are judged. Pairs are searched exhaustively if no single effect is
  enough.
- Closing much of a gap does not identify its cause, because a wrong effect does that too. The verdict is `unknown` if no
  effect and no pair is enough, or if a probe (a pattern of unknown cause) does clearly better. It is `inconclusive` if a
  probe does slightly better and explains more, or if the effect's own gain is not significant enough.
- The verdict is repeated with half and twice the floor, where gap and effect may be LENIENT times more probable by
  chance. If it changes, the answer holds both results, or the verdict is `inconclusive`. It is also `inconclusive` if
  the answer predicts held-out images worse than no effect does.
- An effect that explains in a full refit less than half of what it explains to first order is excluded, and the verdict
  is made without it. If a pair fails so, the verdict is `inconclusive`.
- An effect that was measured in the unocculted field fits that field whatever the cause. An effect of few parameters that
  gains nearly as much takes precedence. If nothing else comes near, the measured effect is the answer, however much it
  leaves in that field. A gap in the discs is then judged separately, with that effect in the model: one or two effects
  are named with it. If none can be named and all occulters' places are reliable, the verdict is `inconclusive`.
- Effects that could replace one member of a pair are named too. If many could, only the other member is named.
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

FLOORS = (0.5, 2.0)  # factors of the floor with which the verdict is repeated
ALARM = 0.005
CONFIDENT = 1e-3  # largest p-value of a named effect, corrected for the number of effects
ENOUGH = 1e-3
PENALTY = 2.0
TIE = 9.0
HELD_OUT_SIGMA = 1.0  # by so many standard errors an effect is clearly worse on held-out images
TIE_SHARE = 0.03  # of the best gain: no effect's form is exact enough to separate two effects by less
LEFT_SHARE = 0.15
BEHIND = 0.85  # of the best score: the most that a rival may reach
NEAR_BEHIND = 0.7  # the same for an effect whose place was searched for: it fits any gap to some degree
UNRIVALLED = 0.1  # of the best score: the most of any other effect if the best is unrivalled
MANY_PLACES = 100
MOST_SECONDS = 2  # candidates for a second effect; if there are more, none is named
CLEAR = 12.0  # a pair must beat a single insufficient effect by this score, and a probe must beat all effects by it
TEMPLATE_ERROR = 0.05
UNOCCULTED_WIDTH = 0.03  # tolerance of chi2 per degree of freedom of the unocculted field without a gap
LENIENT = 5.0  # under the other floors, p-values of a gap and of its cause may be larger by this factor
BY_CHANCE = (
    0.01  # a probe explains more if noise gives its further parameters such a gain less often than this
)
MOST_AMISS = 2  # answers that may fail in a full refit before the search stops; also the tied effects that are refitted
LEAST_IMAGES = (
    6  # with fewer images none can be held out, and no visible gap does not mean that there is none
)


@dataclass(frozen=True)
class Freedom:
    """How much noise alone gains: the largest of `trials` chi2 variables with this mean and half variance."""

    mean: float
    half_variance: float
    trials: float

    def beside(self, first: Freedom) -> Freedom:
        """The additional freedom compared with a first that is contained in this one."""
        return Freedom(
            max(self.mean - first.mean, 1.0),
            max(self.half_variance - first.half_variance, 1.0),
            max(self.trials / first.trials, 1.0),
        )

    def p_value(self, gain: float) -> float:
        """The probability that noise gains as much, from a chi2 distribution with the same mean and variance."""
        if self.half_variance <= 0:
            return 1.0
        share = self.mean / self.half_variance
        return min(1.0, self.trials * float(chdtrc(self.mean * share, max(gain, 0.0) * share)))


@dataclass(frozen=True, eq=False)
class Tried:
    """One effect, or several together, fitted together with the PSF.

    values: value, error and unit by "parameter", or "effect.parameter" if there are several effects. gain: the decrease of
    chi2. p_value: of the gain. left_p_value: p-value of the residuals in patterns, cells and unocculted blocks. left_share:
    the largest fraction of the original excess that remains there; both are None if they were not needed. explains:
    whether little remains of the strongest excess. left_for_real: `left_chi2` of a full refit; None if there was no refit,
    or if it has other images.
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
        """The names as in a report."""
        return label_of(self.names)


def label_of(names: Sequence[str]) -> str:
    """Names of effects as in a report."""
    return " + ".join(names)


@dataclass(frozen=True, eq=False)
class Judgement:
    """A verdict under one floor.

    tried: named effects, best first; the answer's pairs come before them, and those that failed in a full refit come last,
    with their labels in amiss. probes: best first. answer: for `inconclusive`, the best fit that is not certain enough;
    often empty. certain: for a tie, the effects that act together with any of the tied ones; empty if each tied effect acts
    alone. discs_unexplained: for `inconclusive`, whether the reason is a gap in the discs that the best effect does not
    explain.
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
        """For a tie, the effects that cannot be told apart."""
        return (
            tuple(name for name in self.answer if name not in self.certain) if self.verdict == "tie" else ()
        )


# Returns the model of a full refit with an effect in it, whose columns follow those of the PSF; None if the fit failed.
Refitter = Callable[[Tried], LinearModel | None]


def no_refit(tried: Tried) -> LinearModel | None:
    """Use this where no full refits are made."""
    return None


def judge(model: LinearModel, refit: Refitter = no_refit, beyond: Refitter = no_refit) -> Judgement:
    """The verdict under the model's floor, confirmed with two other floors.

    refit: returns the model of a full refit with one or several effects. beyond: returns the same model with these effects
    always fitted and the rest of the library added. Each is called at most once for the same effects.
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
        # The full refit does not confirm the linear fit: judge the other effects.
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
    """A tie without the single effects that fail in a full refit, and these effects; at most MOST_AMISS are refitted."""
    alone = [t for t in found.tried if t is not found.best and len(t.names) == 1 and t.label in found.answer]
    fallen = [tried for tried in alone[:MOST_AMISS] if _fails_for_real(model, tried, refit)]
    answer = tuple(name for name in found.answer if name not in _labels(fallen))
    return replace(found, verdict="tie" if len(answer) > 1 else "attributed", answer=answer), fallen


def _confirmed(model: LinearModel, found: Judgement, once: Refitter, further: Refitter) -> Judgement:
    """The verdict under the model's floor after the tests on held-out images and under other floors."""
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
    """Whether a full refit explains less than half of what an effect explains in the linear model, or cannot be made.

    The comparison uses the discs or the unocculted field, whichever the effect explains more of.
    """
    real = refit(tried)
    if real is None:
        return True
    # A refit locates the discs again and may lose one.
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
    """Whether the answer predicts held-out images worse than no effect does, so that it fits only by its freedom."""
    scheme = time_blocks(model)
    before = hold_out(model, (), scheme)
    if found.best is None or before is None:
        return False
    if model.evidence.all_unocculted.freedom and not before.unocculted_expected.any():
        return False  # few images: no fold has two neighbours, so the unocculted blocks are not tested
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
    """The verdict under one floor. lenient: factor on the p-values below which a gap and an effect count as significant."""
    evidence = model.evidence
    every = [fitted(model, (effect,)) for effect in evidence.effects]
    named = sorted((t for t in every if t.named), key=lambda t: -t.score)
    probes = tuple(sorted((t for t in every if not t.named), key=lambda t: -t.score))
    before = _left(model, model.base, np.zeros(len(model.base.columns)))
    p_gap = _p_of_gap(before, named)
    if p_gap > lenient * ALARM or not named:
        return Judgement("none", (), p_gap, tuple(named), probes, named[0] if named else None)
    # An effect that was measured in the unocculted field fits it whatever the cause: its score does not count as a rival.
    measured = {t.label for t in named if evidence.numbers_of(_own(model, t))}
    outdone = measured if _few_numbers_do(named, measured) else set()
    others, failed = _held_out_first(model, [t for t in named if t.label not in outdone])
    named = [*others, *(t for t in named if t.label in outdone)]
    failed |= outdone
    best = named[0] = _with_left(model, named[0], before, refit)
    # So does a probe that was measured there: it counts only against another such effect, or if it explains clearly more.
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
            # The Sun changes faster than the images follow: much remains in the unocculted field, and the discs' places,
            # found by comparison with neighbouring images, are wrong.
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
    """Whether the best effect was measured in the unocculted field, and an effect of few parameters gains nearly as much.

    Such an effect would not gain so much if it were not the cause.
    """
    best = named[0]
    rivals = (t.gain for t in named if t.label not in measured)
    return best.label in measured and max(rivals, default=0.0) >= (1 - LEFT_SHARE) * best.gain


def _held_out_first(model: LinearModel, named: Sequence[Tried]) -> tuple[list[Tried], set[str]]:
    """Sort the effects, and return the labels of those that are clearly worse on held-out images.

    Of the effects with about the best score, those come first that predict held-out images as well as the best; those that
    are clearly worse fit only by their freedom.
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
    # A difference of deviance between two models has a standard error of about twice its root, at most that of the
    # difference between the best model and none. Within this error an effect only comes later; beyond it, it fails.
    by_chance = HELD_OUT_SIGMA * 2 * math.sqrt(max(most, 0.0))
    failed = {label for label, down in falls.items() if down < most - max(nearly, by_chance)}

    def place(tried: Tried) -> tuple[bool, bool, float]:
        last = tried not in alike or tried.label in failed
        return last, not last and falls[tried.label] < most - nearly, -tried.score

    return sorted(named, key=place), failed


def _beside(model: LinearModel, best: Tried, beyond: Refitter) -> Judgement | None:
    """The verdict when one effect explains most of a gap but not all: does a second effect act? None if this cannot be decided.

    It returns the first effect alone if more than MOST_SECONDS could be the second. `tried` holds only the answer's fits.
    The same applies if the best effect was measured in the unocculted field and leaves much there, as a Sun that flickers
    faster than the images follow. The discs do not show that effect, so their residuals are judged separately: two effects
    may act in them, and if they cannot be identified, the verdict is `inconclusive`.
    """
    rest = beyond(best)
    if rest is None:
        return None
    effects = {effect.name: effect for effect in model.evidence.effects}
    still = tuple(effect for effect in rest.evidence.effects if effect.name in effects)
    rest = replace(rest, evidence=replace(rest.evidence, effects=still))
    unocculted = rest.evidence.steady_unocculted
    rest = replace(rest, floor=model.floor)
    # The form of the first effect is not exact, so a little of what it explained remains in the unocculted field. This
    # scale prevents another form from fitting that remainder by chance.
    excess = rest.left_unocculted(rest.base) - (
        unocculted.freedom - rest.evidence.numbers_of(rest.base.columns)
    )
    rest = replace(rest, unocculted_scale=rest.unocculted_scale * max(excess / CLEAR, 1.0))
    second = _judge(rest, no_refit, no_refit)
    if second.verdict == "none":
        return Judgement("attributed", best.names, second.p_value, (), (), best) if best.explains else None
    unocculted_alone = _unocculted_alone(model, best)
    if second.best is None or second.verdict not in ("attributed", "tie"):
        # If the occulters' places are reliable, changes in the unocculted field do not cause the gap in the discs.
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
    """The columns of a fit that belong to its own effects, without those that are always fitted."""
    return [column for column in tried.step.columns if column not in model.evidence.base]


def _unocculted_alone(model: LinearModel, tried: Tried) -> bool:
    """Whether an effect was measured in the unocculted field and changes no disc."""
    own = _own(model, tried)
    silent = all(not disc.jacobian[own].any() for disc in model.evidence.discs)
    return silent and model.evidence.numbers_of(own) > 0


def _explains_more(probe: Tried, best: Tried) -> bool:
    """Whether a probe with a higher score explains more than the best effect.

    It does not if it leads only by having fewer parameters (a simpler form of the effect), or if noise could give its
    additional parameters the same gain.
    """
    more = probe.gain - best.gain
    numbers = max(len(probe.values) - len(best.values), 1)
    return probe.score > best.score and more > TIE and float(chdtrc(numbers, more)) < BY_CHANCE


def _freer(tried: Tried, best: Tried, measured: set[str]) -> bool:
    """Whether an effect has more freedom than the best: if it still does worse, an inexact form is not the reason."""
    return tried.label in measured or len(tried.values) > len(best.values)


def _searched(tried: Tried, evidence: Evidence) -> bool:
    """Whether an effect's place was searched for over the whole field."""
    return any(effect.trials >= MANY_PLACES for effect in evidence.effects if effect.name in tried.names)


def _is_enough(tried: Tried, rival_score: float) -> bool:
    assert tried.left_p_value is not None and tried.left_share is not None
    nearly = tried.left_share < LEFT_SHARE and rival_score < BEHIND * tried.score
    return tried.left_p_value >= ENOUGH or nearly


def _best_pair(
    model: LinearModel, best: Tried, before: _Left, refit: Refitter, *, enough: bool
) -> Tried | None:
    """The pair of effects that explains most, if it is clearly better than a single effect and leaves no significant residuals."""
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
    # Two inexact forms can fit almost anything, so a pair may leave no significant residuals.
    return pair if (pair.left_p_value or 0.0) >= ENOUGH else None


def _second(model: LinearModel, best: Tried, pairs: Sequence[Tried]) -> Tried | None:
    """Of the pairs that contain an effect that is enough alone, the one that explains most beyond it; None if that could be
    noise found by a search, or an error of the first effect's form (a fraction of what it explains in the discs, and of what
    it explains in the unocculted field). What a full refit of the first effect explains is not credited to a second.
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
    """chi2 after a step: of the discs, for some images (None: all), and of the unocculted field."""
    discs = zip(model.evidence.images, model.left(step), strict=True)
    left = sum(float(one @ one) for n, one in discs if images is None or n in images)
    return np.array([left, model.left_unocculted(step)])


def _in_place_of_one(model: LinearModel, pair: Tried) -> dict[str, dict[str, Tried]]:
    """For each effect of a pair, the other effects that explain about as much together with its partner: pairs by name."""
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
    """Whether the fit of a pair keeps any parameter of an effect."""
    return any(key.startswith(f"{name}.") for key in pair.values)


def fitted(model: LinearModel, effects: Sequence[Effect], *, any_sign: bool = False) -> Tried:
    """Fit the PSF's parameters together with these effects.

    A parameter that must be positive but would not be is left out, unless any_sign (a step may have either sign). A
    parameter whose change was measured in the unocculted field is left out if it gains less than that costs.
    """
    columns = {
        column: (effect, parameter)
        for effect in effects
        # An effect that is fitted per pointing has one change for each: fewer or more than its parameters.
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
    """Of the columns of a step that gain less than their measured numbers cost, the one that gains least; None if there is none."""
    columns = step.columns[len(model.evidence.base) :]
    idle = {}
    for column in columns:
        numbers = model.evidence.numbers_of([column])
        gain = step.fall - model.fit([c for c in columns if c != column]).fall if numbers else 0.0
        if numbers and gain < PENALTY * (1 + numbers):
            idle[column] = gain
    return min(idle, key=lambda column: idle[column]) if idle else None


def _p_of_gap(left: _Left, named: Sequence[Tried]) -> float:
    """The smallest of the p-values of patterns, means, cells, unocculted blocks and single effects, times their number."""
    effects = min((t.p_value for t in named), default=1.0) * max(len(named), 1)
    tests = (*left.p_values, effects)
    return float(min(1.0, len(tests) * min(tests)))


@dataclass(frozen=True)
class _Left:
    """The chi2 that a step leaves, and its degrees of freedom: along patterns, in the discs' means, in all cells, in the blocks."""

    gains: tuple[float, ...]
    freedom: tuple[int, ...]

    @property
    def p_values(self) -> tuple[float, ...]:
        """The p-value of each."""
        return tuple(float(chdtrc(k, gain)) for gain, k in zip(self.gains, self.freedom, strict=True))

    @property
    def p_value(self) -> float:
        """The smallest p-value, times their number."""
        return min(1.0, len(self.gains) * min(self.p_values))

    def share_of(self, before: _Left) -> float:
        """The largest remaining fraction of the excess, among those that are still significant."""
        shares = [
            max(gain - k, 0.0) / max(gain_before - k_before, 1e-9)
            for gain, k, p, gain_before, k_before in zip(
                self.gains, self.freedom, self.p_values, before.gains, before.freedom, strict=True
            )
            if p < ENOUGH
        ]
        return max(shares, default=0.0)

    def of_most(self, before: _Left) -> float:
        """The remaining fraction of what had the largest excess before."""
        excess = [gain - k for gain, k in zip(before.gains, before.freedom, strict=True)]
        most = int(np.argmax(excess))
        return max(self.gains[most] - self.freedom[most], 0.0) / max(excess[most], 1e-9)


def _with_left(model: LinearModel, tried: Tried, before: _Left, refit: Refitter) -> Tried:
    """The fit with its residuals judged: in the linear model and, if they are significant, after a full refit."""
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
    """The residuals of a step, if the Jacobian of its columns times `unsure` is the error of the effects' forms."""
    here = list(step.columns)
    # An inexact template adds a covariance along its own change of the cells: reduce that direction, disc by disc.
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
