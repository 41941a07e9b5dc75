"""The threshold of the answer: its coverage on further cases, coverages that are refused, and the shipped calibration."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.gap.verdict.calibration import COVERAGE, Calibration, shipped_calibration, true_share
from psfcore.gap.verdict.posterior import NONE, UNKNOWN, Names


@pytest.mark.parametrize("coverage", [0.5, 0.9])
def test_further_cases_are_covered_as_stated(coverage: float) -> None:
    """Split-conformal coverage over many calibrations: at least as stated, and above it by 1 / (n + 1) at most."""
    rng = np.random.default_rng(7)
    held = []
    for _ in range(400):
        shares = rng.beta(2, 1, 49 + 20)
        least = Calibration(1.0, tuple(shares[:49]), {}).threshold(coverage)
        held.append(np.mean(shares[49:] >= least))
    assert coverage - 0.01 < np.mean(held) < coverage + 1 / 50 + 0.01


def test_the_answer_holds_the_hypotheses_above_the_threshold() -> None:
    calibrated = Calibration(1.0, tuple(0.05 * n for n in range(1, 20)), {})
    shares = {("a",): 0.5, NONE: 0.3, ("a", "b"): 0.15, UNKNOWN: 0.05}
    assert calibrated.answer(shares, 0.9) == (("a",), NONE, ("a", "b"))
    assert calibrated.answer(shares, 0.5) == (("a",),)
    assert calibrated.answer({("a",): 0.1, NONE: 0.08}, 0.05) == (("a",),)


@pytest.mark.parametrize("coverage", [0.0, 1.0, 0.96, -1.0])
def test_a_coverage_without_enough_cases_is_refused(coverage: float) -> None:
    with pytest.raises(DataError, match=r"at most 0\.950, for which 19 simulated cases") as raised:
        Calibration(1.0, tuple(0.05 * n for n in range(1, 20)), {}).threshold(coverage)
    assert raised.value.code == "bad-coverage"


def test_the_true_cause_is_in_a_hypothesis_with_all_its_effects() -> None:
    shares = {("a",): 0.5, ("a", "b"): 0.2, ("b", "c"): 0.1, UNKNOWN: 0.2}
    assert true_share(shares, ("a",)) == 0.5
    assert true_share(shares, ("b",)) == 0.2
    assert true_share(shares, ("a", "c")) == 0.0
    assert true_share(shares, UNKNOWN) == 0.2


def test_the_answer_holds_at_least_the_most_probable_hypothesis() -> None:
    """Also if every hypothesis is less probable than the threshold."""
    sure = Calibration(1.0, (0.99,) * 19, {})
    for shares in ({("a",): 0.4, NONE: 0.35, UNKNOWN: 0.25}, {NONE: 0.98, ("a",): 0.02}):
        assert sure.answer(shares, 0.9) == (next(iter(shares)),)


def test_a_larger_coverage_gives_no_smaller_answer() -> None:
    rng = np.random.default_rng(3)
    calibrated = Calibration(1.0, tuple(rng.beta(2, 1, 59)), {})
    shares = dict(zip((NONE, UNKNOWN, ("a",), ("b",), ("a", "b")), rng.dirichlet(np.ones(5)), strict=True))
    before: set[Names] = set()
    for coverage in (1e-12, 0.5, 0.7, 0.9, 0.95, 0.98):
        answer = set(calibrated.answer(shares, coverage))
        assert before <= answer
        before = answer
    assert len(before) > 1


def test_the_calibration_as_json_says_how_it_was_made() -> None:
    made = Calibration(1.5, (0.2, 0.4), {"seed": 3, "holds_for": "transits like these"})
    assert made.to_json() == {
        "cases": 2,
        "temperature": 1.5,
        "seed": 3,
        "holds_for": "transits like these",
    }


def test_the_shipped_calibration_says_how_it_was_made_and_has_enough_cases() -> None:
    made = shipped_calibration()
    assert made.about["command"].startswith("python -m studies.gap_calibration ")
    assert f"--seed {made.about['seed']} " in made.about["command"]
    assert made.about["version"] and made.about["holds_for"].endswith(".")
    assert 0.5 <= made.temperature <= 10.0
    assert all(0.0 <= share <= 1.0 + 1e-9 for share in made.true_shares)  # sums of rounded probabilities
    # Cases that could not be made are missing; a threshold from fewer than fifty is rough.
    assert len(made.true_shares) >= 50
    assert made.threshold(0.95) <= made.threshold(COVERAGE) <= made.threshold(0.5)
