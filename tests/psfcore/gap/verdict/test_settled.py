"""The settled posterior: which hypotheses are refitted, in which order, and how many."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.likelihood import Weighed
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.verdict import settled
from psfcore.gap.verdict.posterior import NONE, UNKNOWN, Names, Posterior, posterior, without_idle
from psfcore.gap.verdict.settled import MOST_REFITS, VISIBLE, settled_posterior
from tests.psfcore.gap.linear_models import with_residuals

OFFSET: Names = ("dark_offset",)
A, B, AB, AC, ABC = ("a",), ("b",), ("a", "b"), ("a", "c"), ("a", "b", "c")
EFFECTS = 3
MODEL = cast(LinearModel, SimpleNamespace(evidence=SimpleNamespace(effects=(None,) * EFFECTS)))

Start = Callable[..., None]


def weighed(log_evidence: float, visible_error: float = 0.0) -> Weighed:
    return Weighed(log_evidence, (), np.zeros(0), visible_error)


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch) -> Start:
    """A function that sets the posterior of the linear model: ln of the evidence by hypothesis; every template error is visible."""

    def set_to(logs: Mapping[Names, float], visible: float = 2 * VISIBLE) -> None:
        evidence = {names: weighed(log, visible if names else 0.0) for names, log in logs.items()}
        linear = Posterior({UNKNOWN: -50.0}, {}, {}).with_evidence(evidence, EFFECTS)
        monkeypatch.setattr(settled, "posterior", lambda model: linear)

    return set_to


class Refitted:
    """Records which hypotheses were refitted. evidence: by refitted hypothesis; a missing one has failed."""

    def __init__(self, evidence: Mapping[Names, Mapping[Names, float]]) -> None:
        self.evidence, self.asked = evidence, list[Names]()

    def __call__(self, names: Names, most_visible: float) -> Mapping[Names, Weighed] | None:
        self.asked.append(names)
        found = self.evidence.get(names)
        return None if found is None else {one: weighed(log) for one, log in found.items()}


def strong_offset(evidence: Evidence) -> LinearModel:
    return replace(with_residuals(evidence, {"dark_offset": 300.0}), scale_error=0.1)


def test_a_strong_effect_is_refitted_and_the_evidence_of_the_refit_counts(evidence: Evidence) -> None:
    refit = Refitted({OFFSET: {OFFSET: -1e6}})
    model = strong_offset(evidence)
    assert posterior(model).visible_error[OFFSET] > VISIBLE
    found, failed = settled_posterior(model, refit)
    assert refit.asked[0] == OFFSET and OFFSET not in failed
    assert len(set(refit.asked)) == len(refit.asked)
    assert OFFSET not in list(found.probabilities())[:2]


def test_a_hypothesis_whose_refit_fails_is_left_out(evidence: Evidence) -> None:
    found, failed = settled_posterior(strong_offset(evidence), lambda names, most_visible: None)
    assert failed[0] == OFFSET
    assert not set(failed) & set(found.probabilities())
    assert sum(without_idle(found.probabilities()).values()) == pytest.approx(1.0)


def test_a_weak_effect_needs_no_refit(evidence: Evidence) -> None:
    def refit(names: Names, most_visible: float) -> Mapping[Names, Weighed]:
        raise AssertionError(f"{names} was refitted")

    settled_posterior(replace(with_residuals(evidence, {}, noise=0.5), scale_error=0.1), refit)


def test_without_refits_the_posterior_is_that_of_the_linear_model(start: Start) -> None:
    start({NONE: 0.0, A: 30.0, AB: 40.0})
    found, failed = settled_posterior(MODEL, None)
    assert failed == () and next(iter(found.probabilities())) == AB


def test_before_a_pair_the_more_probable_of_its_effects_is_refitted_alone(start: Start) -> None:
    """A strong effect that is not linear: at its own refit the effect alone is enough."""
    start({NONE: 0.0, A: 30.0, B: 20.0, AB: 40.0})
    refit = Refitted({A: {A: 60.0, AB: 59.0, AC: 58.0}})
    found, failed = settled_posterior(MODEL, refit)
    assert refit.asked == [A] and failed == ()
    assert next(iter(without_idle(found.probabilities()))) == A


def test_a_second_strong_effect_leads_to_the_refit_of_the_pair(start: Start) -> None:
    start({NONE: 0.0, A: 30.0, B: 35.0, AB: 40.0})

    def refit(names: Names, most_visible: float) -> Mapping[Names, Weighed]:
        asked.append(names)
        # At the refit of b the pair is still better; the error of the template of a is visible there.
        return {B: weighed(35.0), AB: weighed(55.0, 2 * VISIBLE)} if names == B else {AB: weighed(50.0)}

    asked: list[Names] = []
    found, _ = settled_posterior(MODEL, refit)
    assert asked == [B, AB]
    assert next(iter(without_idle(found.probabilities()))) == AB


def test_a_pair_is_refitted_although_the_refit_of_its_effect_alone_failed(start: Start) -> None:
    start({NONE: 0.0, A: 30.0, B: 20.0, AB: 40.0})
    refit = Refitted({AB: {AB: 45.0}})
    found, failed = settled_posterior(MODEL, refit)
    assert refit.asked == [A, AB] and failed == (A,)
    assert A not in found.log_weights and next(iter(found.probabilities())) == AB


def test_a_refit_of_one_effect_replaces_all_its_triples(start: Start) -> None:
    """The linear model overestimates the triples with a strong effect; its refit weighs only those of the best pair."""
    start({NONE: 0.0, A: 30.0, B: 20.0, AB: 35.0, ABC: 38.0})
    refit = Refitted({A: {A: 20.0, AB: 19.0, AC: 18.0}, B: {B: 20.0}})
    found, _ = settled_posterior(MODEL, refit)
    assert ABC not in found.log_weights and next(iter(without_idle(found.probabilities()))) in (A, B)
    assert {NONE, B, AB} <= set(found.log_weights)


def test_a_pair_keeps_the_evidence_of_its_own_refit(start: Start) -> None:
    """After the refit of the pair, the refit of one of its effects states a less exact evidence of the pair."""
    start({NONE: 0.0, A: 39.0, B: 38.0, AB: 45.0})
    refit = Refitted({AB: {AB: 38.5}, B: {B: 38.0, AB: 90.0}})
    found, failed = settled_posterior(MODEL, refit)
    assert refit.asked == [A, AB, B] and failed == (A,)
    assert found.log_weights[AB] < 40.0


def test_triples_with_a_pair_whose_refit_failed_are_left_out(start: Start) -> None:
    start({NONE: 0.0, A: 30.0, B: 20.0, AB: 45.0, ABC: 44.0})
    refit = Refitted({A: {A: 30.0, AB: 45.0, ABC: 44.0}})
    found, failed = settled_posterior(MODEL, refit)
    assert refit.asked[:2] == [A, AB] and failed == (AB,)
    assert not {AB, ABC} & set(found.log_weights) and next(iter(found.probabilities())) == A


def test_the_number_of_refits_is_bounded(start: Start) -> None:
    """Many effects of equal probability, and no refit changes anything."""
    names = [(f"effect_{k}",) for k in range(3 * MOST_REFITS)]
    start({NONE: 0.0} | dict.fromkeys(names, 30.0))
    refit = Refitted({one: {one: 30.0} for one in names})
    settled_posterior(MODEL, refit)
    assert len(refit.asked) == len(set(refit.asked)) == MOST_REFITS


@pytest.mark.parametrize(("log", "visible"), [(-6.0, 2 * VISIBLE), (0.5, VISIBLE / 2)])
def test_an_improbable_effect_and_an_invisible_error_need_no_refit(
    start: Start, log: float, visible: float
) -> None:
    start({NONE: 0.0, A: log}, visible)
    refit = Refitted({})
    settled_posterior(MODEL, refit)
    assert refit.asked == []


def test_a_refit_that_did_not_settle_counts_for_nothing(start: Start) -> None:
    start({NONE: 0.0, A: 30.0, B: 20.0}, 3 * VISIBLE)
    bounds: list[float] = []

    def refit(names: Names, most_visible: float) -> Mapping[Names, Weighed]:
        bounds.append(most_visible)
        return {}

    found, failed = settled_posterior(MODEL, refit)
    assert failed == () and next(iter(found.probabilities())) == A
    assert bounds == [3 * VISIBLE], "not made again"


def test_a_leading_effect_keeps_its_evidence_if_its_refit_succeeds(start: Start) -> None:
    start({NONE: 0.0, A: 30.0}, VISIBLE / 2)
    refit = Refitted({A: {A: -30.0, AB: 90.0}})
    found, failed = settled_posterior(MODEL, refit)
    assert refit.asked == [A] and failed == ()
    assert next(iter(found.probabilities())) == A and AB not in found.log_weights


def test_a_leading_effect_is_refitted_although_its_error_is_invisible(start: Start) -> None:
    """The report would name it. Its refit fails, so that it is left out."""
    start({NONE: 0.0, A: 30.0}, VISIBLE / 2)
    refit = Refitted({})
    found, failed = settled_posterior(MODEL, refit)
    assert refit.asked == [A] and failed == (A,)
    assert next(iter(found.probabilities())) == NONE
