"""The settled posterior: which hypotheses are refitted, in which order, and how many."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.fields import FieldColumns
from psfcore.gap.evidence.likelihood import Weighed
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.verdict.posterior import NONE, UNKNOWN, Form, Names, Posterior, posterior, without_idle
from psfcore.gap.verdict.refits import MOST_REFITS, VISIBLE, settled_posterior
from tests.psfcore.gap.linear_models import with_residuals
from tests.psfcore.gap.posteriors import form_of, of_evidence, weighed

OFFSET: Names = ("dark_offset",)
A, B, AB, AC, ABC = ("a",), ("b",), ("a", "b"), ("a", "c"), ("a", "b", "c")
MODEL = cast(LinearModel, SimpleNamespace())


class Refitted:
    """Records which hypotheses were refitted, and with which bounds. evidence: by refitted hypothesis; a missing one has failed."""

    def __init__(self, evidence: Mapping[Names, Mapping[Names, Weighed | float]]) -> None:
        self.evidence, self.asked, self.bounds = evidence, list[Names](), list[float]()

    def __call__(self, form: Form, most_visible: float) -> tuple[Mapping[Form, Weighed], LinearModel] | None:
        names = form.names(tuple(dict.fromkeys((*"abc", *form.effects))))
        self.asked.append(names)
        self.bounds.append(most_visible)
        found = self.evidence.get(names)
        if found is None:
            return None
        real = {n: log if isinstance(log, Weighed) else weighed(log) for n, log in found.items()}
        return {form_of(names): one for names, one in real.items()}, MODEL


def settled(
    logs: Mapping[Names, float], refit: Refitted, visible: float = 2 * VISIBLE
) -> tuple[Posterior, set[Names]]:
    """The settled posterior of a linear model, and the hypotheses that it leaves out.

    logs: ln of the evidence by hypothesis. visible: the visible error of every template.
    """
    others = dict.fromkeys(((name,) for name in "abc"), -1e4)
    linear = of_evidence(others | {UNKNOWN: -50.0} | dict(logs), visible)
    found = settled_posterior(linear, refit)
    return found, set(linear.hypotheses) - set(found.hypotheses)


def test_a_strong_effect_is_refitted_and_a_weak_one_is_not(evidence: Evidence, columns: FieldColumns) -> None:
    strong = replace(with_residuals(evidence, {"dark_offset": 300.0}), scale_error=0.1)
    linear = posterior(strong, columns)
    assert linear.forms[Form(OFFSET)].visible_error > VISIBLE
    refit = Refitted({OFFSET: {OFFSET: -1e6}})
    found = settled_posterior(linear, refit)
    assert refit.asked[0] == OFFSET and OFFSET in found.hypotheses
    assert len(set(refit.asked)) == len(refit.asked)
    assert OFFSET not in list(found.probabilities())[:2]  # the evidence of the refit counts
    # A hypothesis whose refit fails is left out.
    found = settled_posterior(linear, Refitted({}))
    assert OFFSET not in found.probabilities()
    assert sum(without_idle(found.probabilities()).values()) == pytest.approx(1.0)
    refit = Refitted({})
    weak = replace(with_residuals(evidence, {}, noise=0.5), scale_error=0.1)
    settled_posterior(posterior(weak, columns), refit)
    assert refit.asked == []


# ln of the evidence in the linear model; that of each refit, without those that fail; the visible error of the templates; the
# refits in their order, the hypotheses that are left out, and the most probable one.
Row = tuple[dict[Names, float], dict[Names, Any], float, list[Names], set[Names], Names]
PAIR: dict[Names, float] = {NONE: 0.0, A: 30.0, B: 20.0, AB: 40.0}
STRONG = 2 * VISIBLE
ROWS: list[Row] = [
    # Before a pair, the more probable of its effects is refitted alone, and may be enough.
    (PAIR, {A: {A: 60.0, AB: 59.0, AC: 58.0}}, STRONG, [A], set(), A),
    # At the refit of b the pair is still better; the error of the template of a is visible there.
    (PAIR | {B: 35.0}, {B: {B: 35.0, AB: weighed(55.0, STRONG)}, AB: {AB: 50.0}}, STRONG, [B, AB], set(), AB),
    # A pair is refitted although the refit of its effect alone failed; its own refit does not contradict its triples.
    (PAIR | {ABC: 10.0}, {AB: {AB: 45.0}}, STRONG, [A, AB], {A}, AB),
    # A pair keeps the evidence of its own refit: a later refit of one of its effects states a less exact one.
    (
        PAIR | {A: 39.0, B: 38.0, AB: 45.0},
        {AB: {AB: 38.0}, B: {B: 38.0, AB: 90.0}},
        STRONG,
        [A, AB, B],
        {A},
        B,
    ),
    # A refit that did not settle counts for nothing and is not made again.
    ({NONE: 0.0, A: 30.0, B: 20.0}, {A: {}}, 3 * VISIBLE, [A], set(), A),
    # Beside a field that leads the plausible effects are refitted too: it may only stand for the error of their templates. It
    # stays if its own refit fails.
    ({NONE: 0.0, A: 30.0, UNKNOWN: 60.0}, {A: {A: 90.0}}, STRONG, [UNKNOWN, A], set(), A),
    ({NONE: 0.0, A: 30.0, UNKNOWN: 60.0}, {A: {A: 30.0}}, STRONG, [UNKNOWN, A], set(), UNKNOWN),
    # A leading effect is refitted although its error is invisible, and keeps its evidence if the refit succeeds.
    ({NONE: 0.0, A: 30.0}, {A: {A: -30.0, AB: 90.0}}, VISIBLE / 2, [A], set(), A),
    ({NONE: 0.0, A: 30.0}, {}, VISIBLE / 2, [A], {A}, NONE),
    # Improbable effects, and invisible ones that do not lead, need no refit.
    ({NONE: 0.0, A: -6.0}, {}, STRONG, [], set(), NONE),
    ({NONE: 0.0, A: 0.5}, {}, VISIBLE / 2, [], set(), NONE),
]


def test_which_hypotheses_are_refitted_and_what_remains() -> None:
    for logs, evidence, visible, asked, excluded, best in ROWS:
        refit = Refitted(evidence)
        found, gone = settled(logs, refit, visible)
        assert (refit.asked, gone) == (asked, excluded), logs
        assert next(iter(without_idle(found.probabilities()))) == best, logs
        assert evidence != {A: {}} or refit.bounds == [3 * VISIBLE]
        assert ABC not in logs or ABC in found.log_weights
    # Many effects of equal probability, and no refit changes anything.
    names = [(f"effect_{k}",) for k in range(3 * MOST_REFITS)]
    refit = Refitted({one: {one: 30.0} for one in names})
    settled({NONE: 0.0} | dict.fromkeys(names, 30.0), refit)
    assert len(refit.asked) == len(set(refit.asked)) == MOST_REFITS


def test_triples_follow_the_refits_of_their_effects() -> None:
    """The linear model overestimates the triples with a strong effect; its refit weighs only those of the best pair."""
    logs = PAIR | {AB: 35.0, ABC: 38.0}
    found, _ = settled(logs, Refitted({A: {A: 20.0, AB: 19.0, AC: 18.0}, B: {B: 20.0}}))
    assert ABC not in found.log_weights and {NONE, B, AB} <= set(found.log_weights)
    # Triples with a pair whose refit failed are left out.
    refit = Refitted({A: {A: 30.0, AB: 45.0, ABC: 44.0}})
    found, gone = settled(PAIR | {AB: 45.0, ABC: 44.0}, refit)
    assert refit.asked[:2] == [A, AB] and gone == {AB, ABC}
    assert next(iter(found.probabilities())) == A
