"""The verdict: each row of its table, from posteriors made by hand; few images; a temperature; the calibration of the answer set."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.gap.evidence.fields import Field
from psfcore.gap.verdict.calibration import COVERAGE, Calibration, shipped_calibration, true_share
from psfcore.gap.verdict.closure import Interval
from psfcore.gap.verdict.posterior import NONE, UNKNOWN, Form, Names, Posterior
from psfcore.gap.verdict.verdict import EARNED, LEAST_IMAGES, Judgement, earned, of_effects, verdict_of
from tests.psfcore.gap.posteriors import of_weights, weighed

A, B, C, AB, AC = ("a",), ("b",), ("c",), ("a", "b"), ("a", "c")
AU, BU = ("a", "unknown"), ("b", "unknown")


def posterior_of(shares: Mapping[Names, float]) -> Posterior:
    return of_weights({names: math.log(share) for names, share in shares.items()})


def judged(
    shares: Mapping[Names, float], *, least: float = 0.1, temperature: float = 1.0, images: int = 12
) -> Judgement:
    """The verdict of a posterior. least: the probability that a hypothesis of the answer set needs."""
    return verdict_of(posterior_of(shares), Calibration(temperature, (least,) * 9, {}), images=images)


def test_the_verdict_of_every_kind_of_posterior() -> None:
    rows: list[tuple[dict[Names, float], str, Names, tuple[Names, ...]]] = [
        ({NONE: 0.95, A: 0.05}, "none", (), (NONE,)),
        # The set still says what is not excluded.
        ({NONE: 0.5, A: 0.3, UNKNOWN: 0.2}, "none", (), (NONE, A, UNKNOWN)),
        ({UNKNOWN: 0.93, A: 0.05, NONE: 0.02}, "unknown", (), (UNKNOWN,)),
        ({A: 0.93, UNKNOWN: 0.04, NONE: 0.03}, "attributed", A, (A,)),
        ({AB: 0.93, UNKNOWN: 0.04, NONE: 0.03}, "attributed", AB, (AB,)),
        ({B: 0.5, A: 0.45, UNKNOWN: 0.05}, "tie", ("b", "a"), (B, A)),
        ({AB: 0.5, AC: 0.45, UNKNOWN: 0.05}, "tie", ("a", "b", "c"), (AB, AC)),
        ({A: 0.6, NONE: 0.35, UNKNOWN: 0.05}, "inconclusive", A, (A, NONE)),
        ({A: 0.6, UNKNOWN: 0.35, NONE: 0.05}, "inconclusive", A, (A, UNKNOWN)),
        ({UNKNOWN: 0.6, B: 0.2, A: 0.15, NONE: 0.05}, "inconclusive", B, (UNKNOWN, B, A)),
        # The most probable hypothesis that names effects is stated, although it is not in the set.
        ({UNKNOWN: 0.6, NONE: 0.35, A: 0.05}, "inconclusive", A, (UNKNOWN, NONE)),
        ({UNKNOWN: 0.6, NONE: 0.4}, "inconclusive", (), (UNKNOWN, NONE)),
        # An effect beside an unknown cause.
        ({AU: 0.93, A: 0.04, UNKNOWN: 0.03}, "attributed", AU, (AU,)),
        ({AU: 0.5, BU: 0.45, NONE: 0.05}, "tie", ("a", "unknown", "b"), (AU, BU)),
        ({UNKNOWN: 0.6, AU: 0.35, NONE: 0.05}, "unknown", (), (UNKNOWN, AU)),
        ({AU: 0.6, A: 0.35, NONE: 0.05}, "tie", AU, (AU, A)),
    ]
    # An effect in every member of a tie is certain.
    tied: dict[tuple[Names, ...], tuple[Names, Names]] = {
        (B, A): (("b", "a"), ()),
        (AB, AC): (("b", "c"), A),
        (AU, BU): (("a", "b"), UNKNOWN),
        (AU, A): (UNKNOWN, A),
    }
    for shares, verdict, answer, members in rows:
        found = judged(shares)
        assert (found.verdict, found.answer, found.members) == (verdict, answer, members), shares
        assert (found.tied, found.certain) == (tied[members] if verdict == "tie" else ((), ())), shares
        assert list(found.hypotheses) == sorted(shares, key=lambda names: -shares[names])
        named = [names for names in members if names not in (NONE, UNKNOWN)]
        assert list(found.named) == named
        assert found.best == next((n for n in found.hypotheses if n not in (NONE, UNKNOWN)), None)
    found = judged({A: 0.97, UNKNOWN: 0.02, NONE: 0.01}, least=0.005)
    assert found.members == (A, UNKNOWN, NONE) and found.deciding == (A,)
    assert (found.verdict, found.answer) == ("attributed", A)
    found = judged({A: 0.6, B: 0.35, UNKNOWN: 0.05}, least=0.005)
    assert found.deciding == (A, B) and found.verdict == "tie"
    clean = {NONE: 0.95, A: 0.05}
    assert judged(clean, images=LEAST_IMAGES).verdict == "none"
    few = judged(clean, images=LEAST_IMAGES - 1)
    assert (few.verdict, few.answer, few.members) == ("inconclusive", (), (NONE,))
    assert judged({A: 0.95, NONE: 0.05}, images=LEAST_IMAGES - 1).verdict == "attributed"
    shares = {A: 0.95, B: 0.03, NONE: 0.02}
    assert judged(shares).verdict == "attributed"
    warm = judged(shares, temperature=3.0)
    assert warm.members == (A, B, NONE) and warm.verdict == "inconclusive"
    assert warm.hypotheses[A] / warm.hypotheses[B] == pytest.approx((0.95 / 0.03) ** (1 / 3))


def test_a_name_that_closes_too_little_is_not_named_alone() -> None:
    sure = judged({A: 0.93, UNKNOWN: 0.04, NONE: 0.03})
    for value, high, verdict in ((0.6, EARNED - 0.01, "inconclusive"), (-0.1, EARNED, "attributed")):
        found = earned(sure, Interval(value, -0.9, high))
        assert (found.verdict, found.answer) == (verdict, A)
        assert (UNKNOWN in found.members) == (UNKNOWN in found.deciding) == (verdict == "inconclusive")
    assert earned(sure, None) is sure, "the discs show no gap"
    low = Interval(0.0, 0.0, 0.0)
    for other in (judged({NONE: 0.95, A: 0.05}), judged({AU: 0.93, A: 0.04, UNKNOWN: 0.03})):
        assert earned(other, low) is other


def test_the_form_that_a_report_refits_is_one_that_images_can_show() -> None:
    formless, spot = Field(None, "each_disc", parts=("each_disc",)), Field("detector", "light", 0.2)
    logs = {Form(A): 0.0, Form(A, formless): 9.0, Form(A, spot): 7.0, Form(B): 0.0, Form(B, formless): 8.0}
    found = replace(
        judged({A: 0.9, NONE: 0.1}),
        posterior=Posterior({form: weighed(log) for form, log in logs.items()}, (*A, *B)),
    )
    assert found.posterior.leading(AU) == Form(A, formless) and found.form(AU) == Form(A, spot)
    assert found.form(BU) == Form(B), "no field of the hypothesis has a change of the images"


def test_the_probability_of_an_effect_is_the_sum_over_the_hypotheses_that_contain_it() -> None:
    shares = {NONE: 0.1, UNKNOWN: 0.05, A: 0.52, B: 0.15, C: 0.02, AB: 0.09, AC: 0.07}
    sums = {"none": 0.1, "unknown": 0.05, "a": 0.68, "b": 0.24, "c": 0.09}
    assert of_effects(shares) == pytest.approx(sums)
    assert list(of_effects(shares))[:2] == ["none", "unknown"]
    # An effect that the data do not show beside another one keeps its probability, although its pair is counted to the other.
    found = judged(shares)
    assert found.effects == pytest.approx(sums)
    assert AB not in found.hypotheses and AC not in found.hypotheses
    assert found.hypotheses[A] == pytest.approx(0.68) and sum(found.hypotheses.values()) == pytest.approx(1)


def test_the_set_has_the_coverage_that_was_asked_for() -> None:
    shares = posterior_of({A: 0.6, B: 0.3, NONE: 0.1})
    calibration = Calibration(1.0, (0.05, *(0.25,) * 4, *(0.5,) * 4), {})
    for coverage, members in ((0.3, (A,)), (0.6, (A, B)), (0.9, (A, B, NONE))):
        found = verdict_of(shares, calibration, images=12, coverage=coverage)
        assert (found.coverage, found.members) == (coverage, members)
    with pytest.raises(DataError, match="bad-coverage"):
        verdict_of(shares, calibration, images=12, coverage=0.95)
    # The refits of all hypotheses that name effects failed.
    nothing = posterior_of({NONE: 0.3, UNKNOWN: 0.7})
    found = verdict_of(nothing, calibration, images=12)
    assert (found.best, found.answer) == (None, ())
    calibration = Calibration(1.0, tuple(0.05 * n for n in range(1, 20)), {})
    shares = {A: 0.5, NONE: 0.3, AB: 0.15, UNKNOWN: 0.05}
    assert calibration.answer(shares, 0.9) == (A, NONE, AB)
    assert calibration.answer(shares, 0.5) == (A,)
    assert calibration.answer({A: 0.1, NONE: 0.08}, 0.05) == (A,)
    for coverage in (0.0, 1.0, 0.96, -1.0):
        with pytest.raises(DataError, match=r"bad-coverage: .* 0\.950"):
            calibration.threshold(coverage)
    # At least the most probable hypothesis, also if every one is less probable than the threshold.
    sure = Calibration(1.0, (0.99,) * 19, {})
    for shares in ({A: 0.4, NONE: 0.35, UNKNOWN: 0.25}, {NONE: 0.98, A: 0.02}):
        assert sure.answer(shares, 0.9) == (next(iter(shares)),)
    # A larger coverage gives no smaller answer.
    rng = np.random.default_rng(3)
    calibration = Calibration(1.0, tuple(rng.beta(2, 1, 59)), {})
    shares = dict(zip((NONE, UNKNOWN, A, B, AB), rng.dirichlet(np.ones(5)).tolist(), strict=True))
    answers = [set(calibration.answer(shares, c)) for c in (1e-12, 0.5, 0.7, 0.9, 0.95, 0.98)]
    assert all(small <= large for small, large in itertools.pairwise(answers))
    assert len(answers[-1]) > 1


def test_further_cases_are_covered_as_stated() -> None:
    """Split-conformal coverage over many calibrations: at least as stated, and above it by 1 / (n + 1) at most."""
    for coverage in (0.5, 0.9):
        rng = np.random.default_rng(7)
        held = []
        for _ in range(400):
            shares = rng.beta(2, 1, 49 + 20)
            least = Calibration(1.0, tuple(shares[:49]), {}).threshold(coverage)
            held.append(np.mean(shares[49:] >= least))
        assert coverage - 0.01 < np.mean(held) < coverage + 1 / 50 + 0.01


def test_the_calibration_says_how_it_was_made() -> None:
    about = {"seed": 3, "holds_for": "transits like these"}
    assert Calibration(1.5, (0.2, 0.4), about).to_json() == {"cases": 2, "temperature": 1.5} | about
    shipped = shipped_calibration()
    assert shipped.about["command"].startswith("python -m studies.gap_calibration ")
    assert f"--seed {shipped.about['seed']} " in shipped.about["command"]
    assert shipped.about["version"] and shipped.about["holds_for"].endswith(".")
    assert 0.5 <= shipped.temperature <= 10.0
    assert all(0.0 <= share <= 1.0 + 1e-9 for share in shipped.true_shares)  # sums of rounded probabilities
    # Cases that could not be made are missing; a threshold from fewer than fifty is rough.
    assert len(shipped.true_shares) >= 50
    assert shipped.threshold(0.95) <= shipped.threshold(COVERAGE) <= shipped.threshold(0.5)
    shares = {A: 0.5, AB: 0.2, ("b", "c"): 0.1, UNKNOWN: 0.2}
    for true, share in ((A, 0.5), (B, 0.2), (AC, 0.0), (UNKNOWN, 0.2)):
        assert true_share(shares, true) == share
