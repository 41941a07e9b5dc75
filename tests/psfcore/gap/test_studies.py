"""The studies of the calibration and of the limits: what they ask of an answer, what they fit and add, and their tables."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pytest

from psfcore.gap.verdict.limits import ParameterLimits
from psfcore.gap.verdict.posterior import NONE, PRIOR, UNKNOWN, Kind
from psfcore.gap.view import View
from psfcore.scatter.reconstruction import Solution
from psfcore.transit.transit import Transit
from studies import gap_limits
from studies.gap_calibration import KINDS, Case, best_prior, calibrated, table
from tests.psfcore.gap.small_gaps import effect

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


def test_the_true_share_is_that_of_a_hypothesis_with_all_effects() -> None:
    shares = {NONE: 0.2, UNKNOWN: 0.1, A: 0.3, AB: 0.4}
    # A pair that the data do not show is counted to its effect; the second effect is then in no hypothesis.
    idle = {NONE: 0.2, UNKNOWN: 0.1, A: 0.6, AB: 0.1}
    for weights, true, share in ((shares, B, 0.4), (shares, NONE, 0.2), (idle, A, 0.7), (idle, AB, 0.0)):
        logs = {names: math.log(weight) for names, weight in weights.items()}
        assert Case(0, "single", true, logs).true_share(1.0) == pytest.approx(share), (weights, true)


def test_the_temperature_of_the_cases_is_found() -> None:
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


def test_the_table_of_the_calibration_has_coverage_and_size_of_every_kind() -> None:
    cases = drawn_cases(200, 2.0)
    named = {row.split()[0]: row for row in table(cases)[1:]}
    assert set(named) == {"clean", "single", "unknown", "all"} < {*KINDS, "all"}
    low, high = (float(one) for one in named["all"].split("(")[1].split(")")[0].split(" - "))
    held, size, alone = (float(named["all"].split()[at]) for at in (1, -2, -1))
    # Each half is tested with the calibration by the other one, so that the coverage holds.
    assert held == pytest.approx(0.9, abs=0.08) and low < held < high
    assert 1.0 <= size <= 4.0 and 0.0 < alone < held
    half = next(row for row in table(cases, 0.5)[1:] if row.startswith("all"))
    assert float(half.split()[-2]) < size


def test_the_best_prior_is_the_one_from_which_the_truths_were_drawn() -> None:
    prior = dict(PRIOR) | {"single": 4.0 * PRIOR["single"], "unknown": 0.4 * PRIOR["unknown"]}
    found = best_prior(drawn_cases(200, 1.0, prior), 1.0)
    assert sum(found.values()) == pytest.approx(1.0)
    for kind in ("single", "unknown"):
        # With other seeds, the ratios of 200 draws scatter by a quarter.
        assert found[kind] / found["none"] == pytest.approx(prior[kind] / prior["none"], rel=0.5)


def test_the_study_of_the_limits_adds_an_effect_at_its_strength(clean: Transit, solution: Solution) -> None:
    at = ParameterLimits("offset", "DN", 2.0, 3.0, None)
    changed = gap_limits.with_effect(clean, View(solution), effect("dark_offset"), at)
    for frame, before in zip(changed.frames, clean.frames, strict=True):
        np.testing.assert_allclose(frame.pixels - before.pixels, 3.0 / before.exposure_s, atol=0.01)


def test_the_table_of_the_limits_counts_found_effects_and_truths_above_their_limit() -> None:
    cases = [
        gap_limits.Case("ghost", "share", 0.01, True, 0.02, "ghost"),
        gap_limits.Case("ghost", "share", 0.01, False, 0.009, "none"),
        gap_limits.Case("core_blur", "variance", 0.2, True, 0.3, "core_blur"),
        gap_limits.Case("wide_halo", "", None, False, None, "untestable: no light"),
    ]
    rows = {line.split()[0]: line for line in gap_limits.table(cases)[1:]}
    assert "0.50 (0.09 - 0.91), 2" in rows["ghost"]
    assert rows["ghost"].count("0.50") == 2
    assert "1.00" in rows["core_blur"] and "0.00" in rows["core_blur"]
    assert "0.67" in rows["all"] and "0.33" in rows["all"] and "wide_halo" not in rows
    assert rows["not"] == "not added: wide_halo (untestable: no light)"
