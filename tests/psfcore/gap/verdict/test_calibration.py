"""The calibration: the level of a coverage, how often further cases are covered, and the shipped calibration."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.errors import DataError
from psfcore.gap.verdict.calibration import ANOTHER_AUTHOR, COVERAGE, MOST, Calibration, shipped_calibration


def test_the_level_is_a_quantile_of_the_cases() -> None:
    nine = Calibration((0.97, 0.5, 0.6, 0.92, 0.7, 0.8, 0.94, 0.95, 1.0), {})
    rows = [(0.8, 0.97), (0.7, 0.95), (0.6, 0.94), (0.5, 0.92), (0.4, 0.8), (0.3, 0.7)]
    assert [nine.level(coverage) for coverage, _ in rows] == [level for _, level in rows]
    assert [nine.covered(level) for level in (0.94, 0.97, 0.4)] == pytest.approx([6 / 9, 8 / 9, 0])
    # It is not below the coverage, and is the coverage if too many cases are never covered.
    assert Calibration((0.1,) * 9, {}).level(0.9) == nine.level(0.9) == 0.9
    assert Calibration((0.1,) * 999, {}).level(0.995) == 0.995
    for coverage in (0.0, 1.0, 0.91, -1.0):
        with pytest.raises(DataError, match=r"at most 0\.900") as refusal:
            nine.level(coverage)
        assert refusal.value.code == "bad-coverage"


def test_further_cases_are_covered_as_stated() -> None:
    """Split-conformal coverage over many calibrations: at least as stated, and above it by 1 / (n + 1) at most."""
    rng, held = np.random.default_rng(7), []
    for _ in range(400):
        levels = COVERAGE + (1 - COVERAGE) * rng.beta(1, 9, 49 + 20)  # few reach the largest level
        held.append(np.mean(levels[49:] <= Calibration(tuple(levels[:49]), {}).level()))
    assert COVERAGE - 0.01 < np.mean(held) < COVERAGE + 1 / 50 + 0.01


def test_the_calibration_says_how_it_was_made() -> None:
    about = {"seed": 3, "holds_for": "transits like these"}
    assert (
        Calibration((0.2, 0.4), about).to_json(0.3)
        == {
            "cases": 2,
            "covered": 0.5,
            "another_author": ANOTHER_AUTHOR,
        }
        | about
    )
    shipped = shipped_calibration()
    assert shipped.about["command"].startswith("python -m studies.gap_calibration ")
    assert f"--seed {shipped.about['seed']} " in shipped.about["command"]
    assert shipped.about["version"] and shipped.about["holds_for"].endswith(".")
    assert all(0.0 <= level <= 1.0 for level in shipped.levels)
    # Clean cases do not count; a level from fewer than thirty cases is rough.
    assert len(shipped.levels) >= 30
    assert all(coverage <= shipped.level(coverage) <= MOST for coverage in (0.5, COVERAGE, 0.95))
