"""The verdict: each row of its table, from posteriors made by hand; few images; probabilities of effects; a temperature."""

from __future__ import annotations

import math
from collections.abc import Mapping

import pytest

from psfcore.errors import DataError
from psfcore.gap.verdict.calibration import Calibration
from psfcore.gap.verdict.posterior import NONE, UNKNOWN, Names, Posterior
from psfcore.gap.verdict.verdict import LEAST_IMAGES, Judgement, of_effects, verdict_of

A, B, C, AB, AC = ("a",), ("b",), ("c",), ("a", "b"), ("a", "c")
ORDERS: dict[Names, float] = {("x",): 0.7, ("time",): 0.3}


def posterior_of(shares: Mapping[Names, float]) -> Posterior:
    return Posterior({names: math.log(share) for names, share in shares.items()}, {}, ORDERS)


def judged(
    shares: Mapping[Names, float],
    *,
    least: float = 0.1,
    temperature: float = 1.0,
    images: int = 12,
    coverage: float = 0.9,
) -> Judgement:
    """The verdict of a posterior. least: the probability that a hypothesis of the answer set needs."""
    calibration = Calibration(temperature, (least,) * 9, {})
    return verdict_of(posterior_of(shares), calibration, images=images, coverage=coverage)


def test_no_gap_as_the_most_probable_hypothesis_is_the_verdict_none() -> None:
    for shares in ({NONE: 0.95, A: 0.05}, {NONE: 0.5, A: 0.3, UNKNOWN: 0.2}):
        found = judged(shares)
        assert (found.verdict, found.answer) == ("none", ())
        assert found.members[0] == NONE
    assert found.members == (NONE, A, UNKNOWN) and found.named == (
        A,
    )  # the set still says what is not excluded


def test_an_unknown_cause_alone_is_the_verdict_unknown() -> None:
    found = judged({UNKNOWN: 0.93, A: 0.05, NONE: 0.02})
    assert (found.verdict, found.answer, found.members) == ("unknown", (), (UNKNOWN,))
    assert found.best == A and found.named == ()
    assert found.orders == ORDERS


@pytest.mark.parametrize("names", [A, AB])
def test_one_hypothesis_that_names_effects_is_attributed(names: Names) -> None:
    found = judged({names: 0.93, UNKNOWN: 0.04, NONE: 0.03})
    assert (found.verdict, found.answer, found.members) == ("attributed", names, (names,))
    assert found.best == names
    assert found.tied == found.certain == ()


def test_several_hypotheses_that_name_effects_are_a_tie() -> None:
    found = judged({B: 0.5, A: 0.45, UNKNOWN: 0.05})
    assert (found.verdict, found.answer) == ("tie", ("b", "a"))
    assert found.tied == ("b", "a") and found.certain == ()


def test_improbable_members_of_the_set_do_not_change_the_verdict() -> None:
    found = judged({A: 0.97, UNKNOWN: 0.02, NONE: 0.01}, least=0.005)
    assert found.members == (A, UNKNOWN, NONE) and found.deciding == (A,)
    assert (found.verdict, found.answer) == ("attributed", A)
    found = judged({A: 0.6, B: 0.35, UNKNOWN: 0.05}, least=0.005)
    assert found.deciding == (A, B) and found.verdict == "tie"


def test_an_effect_in_every_member_of_a_tie_is_certain() -> None:
    found = judged({AB: 0.5, AC: 0.45, UNKNOWN: 0.05})
    assert (found.verdict, found.answer) == ("tie", ("a", "b", "c"))
    assert found.certain == ("a",) and found.tied == ("b", "c")


@pytest.mark.parametrize(
    ("shares", "members", "answer"),
    [
        ({A: 0.6, NONE: 0.35, UNKNOWN: 0.05}, (A, NONE), A),
        ({A: 0.6, UNKNOWN: 0.35, NONE: 0.05}, (A, UNKNOWN), A),
        ({UNKNOWN: 0.6, B: 0.2, A: 0.15, NONE: 0.05}, (UNKNOWN, B, A), B),
        # The most probable hypothesis that names effects is stated, although it is not in the set.
        ({UNKNOWN: 0.6, NONE: 0.35, A: 0.05}, (UNKNOWN, NONE), A),
        ({UNKNOWN: 0.6, NONE: 0.4}, (UNKNOWN, NONE), ()),
    ],
)
def test_anything_else_is_inconclusive(
    shares: dict[Names, float], members: tuple[Names, ...], answer: Names
) -> None:
    found = judged(shares)
    assert (found.verdict, found.members, found.answer) == ("inconclusive", members, answer)
    assert found.tied == found.certain == ()


def test_few_images_cannot_exclude_a_gap_but_may_show_one() -> None:
    clean = {NONE: 0.95, A: 0.05}
    assert judged(clean, images=LEAST_IMAGES).verdict == "none"
    few = judged(clean, images=LEAST_IMAGES - 1)
    assert (few.verdict, few.answer, few.members) == ("inconclusive", (), (NONE,))
    assert judged({A: 0.95, NONE: 0.05}, images=LEAST_IMAGES - 1).verdict == "attributed"


def test_the_probability_of_an_effect_is_the_sum_over_the_hypotheses_that_contain_it() -> None:
    shares = {NONE: 0.1, UNKNOWN: 0.05, A: 0.52, B: 0.15, C: 0.02, AB: 0.09, AC: 0.07}
    wanted = {"none": 0.1, "unknown": 0.05, "a": 0.68, "b": 0.24, "c": 0.09}
    assert of_effects(shares) == pytest.approx(wanted)
    assert list(of_effects(shares))[:2] == ["none", "unknown"]
    # An effect that the data do not show beside another one keeps its probability, although its pair is counted to the other.
    found = judged(shares)
    assert found.effects == pytest.approx(wanted)
    assert AB not in found.hypotheses and AC not in found.hypotheses
    assert found.hypotheses[A] == pytest.approx(0.68) and sum(found.hypotheses.values()) == pytest.approx(1)


def test_the_hypotheses_are_in_the_order_of_their_probability() -> None:
    found = judged({NONE: 0.1, A: 0.5, UNKNOWN: 0.15, B: 0.25})
    assert list(found.hypotheses) == [A, B, UNKNOWN, NONE] and found.members == (A, B, UNKNOWN, NONE)


def test_a_temperature_makes_the_set_larger() -> None:
    shares = {A: 0.95, B: 0.03, NONE: 0.02}
    assert judged(shares).verdict == "attributed"
    warm = judged(shares, temperature=3.0)
    assert warm.members == (A, B, NONE) and warm.verdict == "inconclusive"
    assert warm.hypotheses[A] / warm.hypotheses[B] == pytest.approx((0.95 / 0.03) ** (1 / 3))


def test_the_set_has_the_coverage_that_was_asked_for() -> None:
    shares = {A: 0.6, B: 0.3, NONE: 0.1}
    calibration = Calibration(1.0, (0.05, *(0.25,) * 4, *(0.5,) * 4), {})
    members = {
        coverage: verdict_of(posterior_of(shares), calibration, images=12, coverage=coverage)
        for coverage in (0.3, 0.6, 0.9)
    }
    assert {coverage: one.members for coverage, one in members.items()} == {
        0.3: (A,),
        0.6: (A, B),
        0.9: (A, B, NONE),
    }
    assert all(one.coverage == coverage for coverage, one in members.items())
    with pytest.raises(DataError) as raised:
        verdict_of(posterior_of(shares), calibration, images=12, coverage=0.95)
    assert raised.value.code == "bad-coverage"


def test_without_a_hypothesis_that_names_effects_there_is_no_best() -> None:
    """The refits of all of them failed."""
    found = verdict_of(
        posterior_of({NONE: 0.3, UNKNOWN: 0.7}), Calibration(1.0, (0.1,) * 9, {}), images=12, failed=(A, B)
    )
    assert found.best is None and found.answer == () and found.failed == (A, B)
