"""The study of the calibration: the share of the true cause, and the temperature that it fits."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pytest

from psfcore.gap.verdict.posterior import NONE, PRIOR, UNKNOWN, Kind
from studies.gap_calibration import Case, calibrated

A, B, AB = ("a",), ("b",), ("a", "b")


def drawn_cases(count: int, temperature: float, prior: Mapping[Kind, float] = PRIOR) -> list[Case]:
    """Cases whose weights are too sure: the truth is drawn from their probabilities at this temperature, and with this prior."""
    rng = np.random.default_rng(5)
    cases = []
    for number in range(count):
        logs = dict(zip((NONE, UNKNOWN, A, B), (4 * rng.normal(size=4)).tolist(), strict=True))
        shares = Case(number, "clean", NONE, logs).shares(temperature, prior)
        true = list(shares)[int(rng.choice(len(shares), p=list(shares.values())))]
        kind = {NONE: "clean", UNKNOWN: "unknown"}.get(true, "single")
        cases.append(Case(number, kind, true, logs))
    return cases


def test_the_true_share_and_the_temperature_of_the_cases_are_found() -> None:
    shares = {NONE: 0.2, UNKNOWN: 0.1, A: 0.3, AB: 0.4}
    # A pair that the data do not show is counted to its effect; the second effect is then in no hypothesis.
    idle = {NONE: 0.2, UNKNOWN: 0.1, A: 0.6, AB: 0.1}
    for weights, true, share in ((shares, B, 0.4), (shares, NONE, 0.2), (idle, A, 0.7), (idle, AB, 0.0)):
        logs = {names: math.log(weight) for names, weight in weights.items()}
        assert Case(0, "single", true, logs).true_share(1.0) == pytest.approx(share), (weights, true)
    for temperature in (1.0, 3.0):
        found = calibrated(drawn_cases(200, temperature), {"seed": 5})
        assert found.temperature == pytest.approx(temperature, rel=0.2)
        assert len(found.true_shares) == 200 and list(found.true_shares) == sorted(found.true_shares)
        assert found.about == {"seed": 5}
    # A case whose true cause was left out counts with a share of zero.
    lost = Case(0, "single", A, {NONE: 0.0, B: -1.0})
    found = calibrated([lost, *drawn_cases(19, 1.0)], {})
    assert found.true_shares[0] == 0.0
    assert found.threshold(0.9) > 0.0 == found.threshold(0.95)
