"""The verdict: one word and the named effects, read off the answer set of the posterior.

The answer set contains the hypotheses whose probability is at least the threshold of the calibration (`calibration`). Its most
probable members that together have at least the probability `coverage` decide the verdict; the other members are possible,
but improbable:

| the deciding members | verdict | named effects |
|---|---|---|
| "no gap" is the most probable one | none | - |
| all contain "unknown", and one of them is "unknown" alone | unknown | - |
| one hypothesis, which names effects | attributed | its effects; also "unknown", if it contains it |
| several hypotheses, which all name effects | tie | the effects of all of them |
| anything else | inconclusive | the effects of the most probable hypothesis that names effects |

A name must earn itself: if the effects of the best named hypothesis close less than EARNED of the gap on held-out images (the upper
end of the 90 % interval), "unknown" joins the answer set, and the verdict is `inconclusive`.

With fewer than LEAST_IMAGES images, the verdict is `inconclusive` instead of `none`: no image can be held out, and a gap may
exist although the images do not show it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

from psfcore.gap.evidence.fields import UNKNOWN as UNKNOWN_NAME
from psfcore.gap.verdict.calibration import COVERAGE, Calibration
from psfcore.gap.verdict.closure import Interval
from psfcore.gap.verdict.posterior import NONE, UNKNOWN, Form, Names, Posterior, known_effects, without_idle

Verdict = Literal["none", "attributed", "tie", "unknown", "inconclusive"]

LEAST_IMAGES = 6
# The interval of the closure by a true effect ends near 1, even if its lower end is low because the data are few. In 144 simulated cases
# (seed 37), it ended at 1 or above in all 33 cases whose named effects contained the true ones, and at 0.82 and 0.92 in two of seven
# other cases.
EARNED = 0.95


@dataclass(frozen=True, eq=False)
class Judgement:
    """The verdict of a diagnosis, and the probabilities from which it follows.

    answer: the effects that the verdict names. For `inconclusive`, these are the effects of the most probable
    hypothesis that names effects, and they are not certain; empty if there is no such hypothesis. members: the answer
    set, the most probable hypothesis first. deciding: the members that
    decide the verdict. coverage: the coverage of the answer set.
    hypotheses: the probability of each hypothesis, the most probable first, after `posterior.without_idle`. effects: the
    probability that each effect acts, alone or with another; also of "none" and "unknown". posterior: the forms of the hypotheses.
    """

    verdict: Verdict
    answer: Names
    members: tuple[Names, ...]
    deciding: tuple[Names, ...]
    coverage: float
    hypotheses: Mapping[Names, float]
    effects: Mapping[str, float]
    posterior: Posterior

    @property
    def named(self) -> tuple[Names, ...]:
        """The deciding members that name effects, the most probable first."""
        return tuple(names for names in self.deciding if names not in (NONE, UNKNOWN))

    @property
    def best(self) -> Names | None:
        """The most probable hypothesis that names effects, whether or not it is in the set; None if all of them failed."""
        return next((names for names in self.hypotheses if names not in (NONE, UNKNOWN)), None)

    def form(self, names: Names) -> Form:
        """The most probable form of a hypothesis that can be refitted; if there is none, its effects without the field."""
        forms = [form for form in self.posterior.hypotheses[names] if form.refittable]
        return max(
            forms, key=self.posterior.hypotheses[names].__getitem__, default=Form(known_effects(names))
        )

    @property
    def certain(self) -> Names:
        """For a tie, the effects that all deciding members contain; empty for other verdicts."""
        if self.verdict != "tie":
            return ()
        return tuple(name for name in self.answer if all(name in names for names in self.named))

    @property
    def tied(self) -> Names:
        """For a tie, the effects that these data cannot separate; empty for other verdicts."""
        return (
            () if self.verdict != "tie" else tuple(name for name in self.answer if name not in self.certain)
        )


def verdict_of(
    found: Posterior,
    calibration: Calibration,
    *,
    images: int,
    coverage: float = COVERAGE,
) -> Judgement:
    """The verdict of a posterior. images: the number of images with a disc. Raises DataError "bad-coverage"."""
    raw = found.probabilities(calibration.temperature)
    hypotheses = without_idle(raw)
    members = calibration.answer(hypotheses, coverage)
    deciding = _deciding(members, hypotheses, coverage)
    named = [names for names in deciding if names not in (NONE, UNKNOWN)]
    best = next((names for names in hypotheses if names not in (NONE, UNKNOWN)), NONE)
    verdict: Verdict = "inconclusive"
    answer = best if members[0] != NONE else NONE
    if members[0] == NONE:
        verdict = "none" if images >= LEAST_IMAGES else "inconclusive"
    elif UNKNOWN in deciding and all(UNKNOWN_NAME in names for names in deciding):
        verdict, answer = "unknown", NONE
    elif len(named) == len(deciding):
        verdict = "attributed" if len(deciding) == 1 else "tie"
        answer = tuple(dict.fromkeys(name for names in named for name in names))
    return Judgement(
        verdict=verdict,
        answer=answer,
        members=members,
        deciding=deciding,
        coverage=coverage,
        hypotheses=hypotheses,
        effects=of_effects(raw),
        posterior=found,
    )


def earned(judged: Judgement, closure: Interval | None) -> Judgement:
    """The judgement, with "unknown" in the set if the named effects close too little of the gap.

    closure: of the best named hypothesis; None if the discs show no gap, or if no image can be held out.
    """
    if judged.verdict not in ("attributed", "tie") or closure is None or closure.high >= EARNED:
        return judged
    if any(UNKNOWN_NAME in names for names in judged.deciding):
        return judged
    members = judged.members if UNKNOWN in judged.members else (*judged.members, UNKNOWN)
    return replace(
        judged,
        verdict="inconclusive",
        members=members,
        deciding=(*judged.deciding, UNKNOWN),
        answer=judged.best or NONE,
    )


def _deciding(
    members: tuple[Names, ...], hypotheses: Mapping[Names, float], coverage: float
) -> tuple[Names, ...]:
    """The most probable members that together have at least the probability `coverage`; all members if they have less."""
    together = 0.0
    for count, names in enumerate(members, 1):
        together += hypotheses[names]
        if together >= coverage:
            return members[:count]
    return members


def of_effects(hypotheses: Mapping[Names, float]) -> dict[str, float]:
    """The probability that each effect acts: the sum over the hypotheses that contain it. "none" and "unknown" come first."""
    out = {"none": hypotheses.get(NONE, 0.0), UNKNOWN_NAME: 0.0}
    for names, share in hypotheses.items():
        for name in names:
            out[name] = out.get(name, 0.0) + share
    return out
