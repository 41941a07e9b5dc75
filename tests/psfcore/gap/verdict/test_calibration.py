"""The threshold of the answer: its coverage on further cases, and coverages that cannot be had."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.gap.verdict.calibration import Calibration, true_share
from psfcore.gap.verdict.posterior import NONE, UNKNOWN


@pytest.mark.parametrize("coverage", [0.5, 0.9])
def test_further_cases_are_covered_as_stated(coverage: float) -> None:
    """Split-conformal coverage over many calibrations: at least as stated, and above it by 1 / (n + 1) at most."""
    rng = np.random.default_rng(7)
    held = []
    for _ in range(400):
        shares = rng.beta(2, 1, 49 + 20)
        least = Calibration(tuple(shares[:49])).threshold(coverage)
        held.append(np.mean(shares[49:] >= least))
    assert coverage - 0.01 < np.mean(held) < coverage + 1 / 50 + 0.01


def test_the_answer_holds_the_hypotheses_above_the_threshold() -> None:
    calibrated = Calibration(tuple(0.05 * n for n in range(1, 20)))
    shares = {("a",): 0.5, NONE: 0.3, ("a", "b"): 0.15, UNKNOWN: 0.05}
    assert calibrated.answer(shares, 0.9) == (("a",), NONE, ("a", "b"))
    assert calibrated.answer(shares, 0.5) == (("a",),)
    assert calibrated.answer({("a",): 0.1, NONE: 0.08}, 0.05) == (("a",),)


@pytest.mark.parametrize("coverage", [0.0, 1.0, 0.96, -1.0])
def test_a_coverage_without_enough_cases_is_refused(coverage: float) -> None:
    with pytest.raises(DataError, match=r"at most 0\.950, for which 19 simulated cases") as raised:
        Calibration(tuple(0.05 * n for n in range(1, 20))).threshold(coverage)
    assert raised.value.code == "bad-coverage"


def test_the_true_cause_is_in_a_hypothesis_with_all_its_effects() -> None:
    shares = {("a",): 0.5, ("a", "b"): 0.2, ("b", "c"): 0.1, UNKNOWN: 0.2}
    assert true_share(shares, ("a",)) == 0.5
    assert true_share(shares, ("b",)) == 0.2
    assert true_share(shares, ("a", "c")) == 0.0
    assert true_share(shares, UNKNOWN) == 0.2
