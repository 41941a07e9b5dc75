"""What could be known about a case: the probabilities agree with simulated decisions and with known figures."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.special import ndtr

from psfcore.blind.bounds import CLEAN, LEVEL, best_of, excluded, known


def ideal(**left: float | tuple[float, float]) -> dict[str, Any]:
    """What hypotheses leave, by their effects joined by two underscores; "none" is no effect. A pair of numbers: chi2 and cost."""
    hypotheses = []
    for name, value in left.items():
        chi2, cost = value if isinstance(value, tuple) else (value, 0.0)
        effects = [] if name == "none" else name.split("__")
        hypotheses.append({"effects": effects, "chi2": chi2, "cost": cost})
    return {
        "schema": "gap-ideal/1",
        "noncentrality": hypotheses[0]["chi2"],
        "left_after_refit_pct": 3.0,
        "sampling_chi2": 0.0,
        "hypotheses": hypotheses,
        "untestable": {},
    }


def test_tests_and_decisions_have_the_power_of_simulated_ones() -> None:
    for among, textbook in ((1, {3.84: 0.5, 10.5: 0.9, 18.4: 0.99}), (18, {8.9: 0.5, 18.3: 0.9, 28.2: 0.99})):
        for lam, probability in textbook.items():
            assert excluded(lam, among) == pytest.approx(probability, abs=0.005), (among, lam)
    rng = np.random.default_rng(3)
    score = np.sqrt(12.0) + rng.standard_normal(200_000)
    threshold = -np.quantile(rng.standard_normal(2_000_000), LEVEL / (2 * 5))
    assert excluded(12.0, 5) == pytest.approx(float(np.mean(score > threshold)), abs=0.01)
    # Between two Gaussians; a guess; and among orthogonal templates of equal energy, whose squared distance is twice the energy.
    for lam in (0.0, 1.0, 7.0, 40.0):
        assert best_of([lam]) == pytest.approx(float(ndtr(np.sqrt(lam) / 2)), abs=1e-6)
    assert best_of([]) == 1.0
    assert best_of([0.0] * 9) == pytest.approx(0.1)  # a guess among ten
    rng = np.random.default_rng(4)
    energy, rivals = 3.0, 5
    scores = rng.standard_normal((200_000, rivals + 1))
    scores[:, 0] += np.sqrt(energy)
    right = float(np.mean(scores[:, 0] > scores[:, 1:].max(axis=1)))
    assert best_of([2 * energy] * rivals) == pytest.approx(right, abs=0.005)


def test_the_rivals_of_an_effect_of_a_pair_and_of_a_field() -> None:
    found = known(ideal(none=50.0, a=0.2, b=6.0, a__b=0.1), ["a"], ["a"], in_library=True)
    assert (found.noncentrality, found.rival) == (50.0, 6.0)
    assert found.alone == pytest.approx(float(ndtr(np.sqrt(6.0) / 2)), abs=1e-6)
    weak = known(ideal(none=5.0, a=0.2, b=4.9), ["a"], ["a"], in_library=True)
    assert weak.alone == pytest.approx(excluded(5.0, 2))
    # Of a pair: its effects alone and other pairs.
    left = ideal(none=90.0, a=40.0, b=12.0, c=80.0, a__b=0.5, a__c=35.0, b__c=11.0)
    found = known(left, ["b", "a"], ["a", "b"], in_library=True)
    assert found.rival == 11.0
    assert found.alone == pytest.approx(min(excluded(12.0, 3), best_of([35.0, 11.0])))
    sun = ideal(none=950.0, a=900.0, b=925.0, sun=50.0, a__b=890.0, a__sun=0.5, b__sun=20.0)
    found = known(sun, ["a"], ["a", "sun"], in_library=True)
    assert found.rival == 20.0  # another effect beside the same Sun, not another effect alone
    assert found.alone == pytest.approx(min(excluded(50.0, 3), best_of([20.0])))
    unseen = ideal(none=50.0, a=2.0, b=25.0, sun=49.0, a__sun=0.5, b__sun=20.0)
    assert known(unseen, ["a"], ["a", "sun"], in_library=True).rival == 25.0
    # Of a withheld effect every hypothesis is a rival.
    found = known(ideal(none=90.0, a=40.0, b=60.0, a__b=10.0), ["stripes"], ["stripes"], in_library=False)
    assert (found.rival, found.alone) == (10.0, pytest.approx(excluded(10.0, 2)))
    left = ideal(none=90.0, a=0.0, field=(2.0, 15.0))
    assert known(left, ["a"], ["a"], in_library=True).rival == pytest.approx(17.0)
    # The truth pays too: without an effect, nothing is to be paid.
    assert known(left, ["field"], ["field"], in_library=True).rival == 0.0
    # Clean data are called clean but for the level of the test.
    assert (CLEAN.noncentrality, CLEAN.rival, CLEAN.alone) == (0.0, None, 1 - LEVEL)
