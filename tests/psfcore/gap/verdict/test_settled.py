"""The settled posterior: which hypotheses are refitted, in which order, and how many."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import pytest

from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.likelihood import Weighed
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.verdict.posterior import NONE, UNKNOWN, Form, Names, Posterior, posterior, without_idle
from psfcore.gap.verdict.refits import MOST_REFITS, VISIBLE, settled_posterior
from tests.psfcore.gap.linear_models import with_residuals
from tests.psfcore.gap.posteriors import form_of, of_evidence, weighed

OFFSET: Names = ("dark_offset",)
A, B, AB, AC, ABC = ("a",), ("b",), ("a", "b"), ("a", "c"), ("a", "b", "c")
MODEL = cast(LinearModel, SimpleNamespace())

Settle = Callable[..., tuple[Posterior, list[Names], set[Names]]]


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


@pytest.fixture
def settle() -> Settle:
    """A function that settles a posterior of the linear model: ln of the evidence by hypothesis, the evidence by refitted
    hypothesis, and the visible error of every template. It returns the posterior, the refitted hypotheses and the excluded ones."""

    def settled_from(
        logs: Mapping[Names, float], refit: Refitted, visible: float = 2 * VISIBLE
    ) -> tuple[Posterior, list[Names], set[Names]]:
        others = dict.fromkeys(((name,) for name in "abc"), -1e4)
        linear = of_evidence(others | {UNKNOWN: -50.0} | dict(logs), visible)
        found = settled_posterior(linear, refit)
        return found, refit.asked, set(linear.hypotheses) - set(found.hypotheses)

    return settled_from


def best_of(found: Posterior) -> Names:
    return next(iter(without_idle(found.probabilities())))


def test_a_strong_effect_is_refitted_and_a_weak_one_is_not(evidence: Evidence) -> None:
    strong = replace(with_residuals(evidence, {"dark_offset": 300.0}), scale_error=0.1)
    linear = posterior(strong)
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
    settled_posterior(posterior(weak), refit)
    assert refit.asked == []


def test_before_a_pair_the_more_probable_of_its_effects_is_refitted_alone(settle: Settle) -> None:
    """A strong effect that is not linear: at its own refit the effect alone is enough."""
    refit = Refitted({A: {A: 60.0, AB: 59.0, AC: 58.0}})
    found, asked, excluded = settle({NONE: 0.0, A: 30.0, B: 20.0, AB: 40.0}, refit)
    assert asked == [A] and not excluded and best_of(found) == A


def test_a_second_strong_effect_leads_to_the_refit_of_the_pair(settle: Settle) -> None:
    """At the refit of b the pair is still better; the error of the template of a is visible there."""
    refit = Refitted({B: {B: 35.0, AB: weighed(55.0, 2 * VISIBLE)}, AB: {AB: 50.0}})
    found, asked, _ = settle({NONE: 0.0, A: 30.0, B: 35.0, AB: 40.0}, refit)
    assert asked == [B, AB] and best_of(found) == AB


def test_a_pair_is_refitted_although_the_refit_of_its_effect_alone_failed(settle: Settle) -> None:
    logs = {NONE: 0.0, A: 30.0, B: 20.0, AB: 40.0, ABC: 10.0}
    found, asked, excluded = settle(logs, Refitted({AB: {AB: 45.0}}))
    assert asked == [A, AB] and excluded == {A}
    assert A not in found.log_weights and next(iter(found.probabilities())) == AB
    assert ABC in found.log_weights  # the refit of a pair does not contradict its triples


def test_a_refit_of_one_effect_replaces_all_its_triples(settle: Settle) -> None:
    """The linear model overestimates the triples with a strong effect; its refit weighs only those of the best pair."""
    refit = Refitted({A: {A: 20.0, AB: 19.0, AC: 18.0}, B: {B: 20.0}})
    found, _, _ = settle({NONE: 0.0, A: 30.0, B: 20.0, AB: 35.0, ABC: 38.0}, refit)
    assert ABC not in found.log_weights and best_of(found) in (A, B)
    assert {NONE, B, AB} <= set(found.log_weights)


def test_a_pair_keeps_the_evidence_of_its_own_refit(settle: Settle) -> None:
    """After the refit of the pair, the refit of one of its effects states a less exact evidence of the pair."""
    refit = Refitted({AB: {AB: 38.5}, B: {B: 38.0, AB: 90.0}})
    found, asked, excluded = settle({NONE: 0.0, A: 39.0, B: 38.0, AB: 45.0}, refit)
    assert asked == [A, AB, B] and excluded == {A}
    assert found.log_weights[AB] < 40.0


def test_triples_with_a_pair_whose_refit_failed_are_left_out(settle: Settle) -> None:
    refit = Refitted({A: {A: 30.0, AB: 45.0, ABC: 44.0}})
    found, asked, excluded = settle({NONE: 0.0, A: 30.0, B: 20.0, AB: 45.0, ABC: 44.0}, refit)
    assert asked[:2] == [A, AB] and excluded == {AB, ABC}
    assert next(iter(found.probabilities())) == A


def test_the_number_of_refits_is_bounded(settle: Settle) -> None:
    """Many effects of equal probability, and no refit changes anything. Improbable or invisible ones need no refit."""
    names = [(f"effect_{k}",) for k in range(3 * MOST_REFITS)]
    _, asked, _ = settle(
        {NONE: 0.0} | dict.fromkeys(names, 30.0), Refitted({one: {one: 30.0} for one in names})
    )
    assert len(asked) == len(set(asked)) == MOST_REFITS
    for log, visible in ((-6.0, 2 * VISIBLE), (0.5, VISIBLE / 2)):
        assert settle({NONE: 0.0, A: log}, Refitted({}), visible)[1] == [], log


def test_a_refit_that_did_not_settle_counts_for_nothing(settle: Settle) -> None:
    refit = Refitted({A: {}})
    found, asked, excluded = settle({NONE: 0.0, A: 30.0, B: 20.0}, refit, 3 * VISIBLE)
    assert not excluded and next(iter(found.probabilities())) == A
    assert asked == [A] and refit.bounds == [3 * VISIBLE], "not made again"


def test_a_field_that_leads_is_refitted_and_stays_if_its_refit_fails(settle: Settle) -> None:
    """The plausible effects are refitted too: the field may only stand for the error of their templates."""
    logs = {NONE: 0.0, A: 30.0, UNKNOWN: 60.0}
    found, asked, excluded = settle(logs, Refitted({A: {A: 90.0}}))
    assert asked == [UNKNOWN, A] and not excluded and best_of(found) == A
    found, asked, excluded = settle(logs, Refitted({A: {A: 30.0}}))
    assert asked == [UNKNOWN, A]
    assert not excluded and best_of(found) == UNKNOWN


def test_a_leading_effect_is_refitted_although_its_error_is_invisible(settle: Settle) -> None:
    """The report would name it. It keeps its evidence if the refit succeeds, and is left out if it fails."""
    logs = {NONE: 0.0, A: 30.0}
    found, asked, excluded = settle(logs, Refitted({A: {A: -30.0, AB: 90.0}}), VISIBLE / 2)
    assert asked == [A] and not excluded
    assert next(iter(found.probabilities())) == A and AB not in found.log_weights
    found, asked, excluded = settle(logs, Refitted({}), VISIBLE / 2)
    assert asked == [A] and excluded == {A}
    assert next(iter(found.probabilities())) == NONE
