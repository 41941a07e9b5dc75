"""The answer sets of an ideal observer for hand-made cases."""

from __future__ import annotations

from itertools import combinations
from typing import Any

import pytest

from psfcore.blind.ideal_sets import IdealCase, mean_sizes

NAMES = ("ghost", "core_blur", "wide_halo", "persistence")


def ideal(true: set[str], rival: float) -> dict[str, Any]:
    """Every hypothesis that does not contain the true effects leaves the chi2 `rival`."""
    hypotheses = [set(some) for n in range(3) for some in combinations(NAMES, n)]
    return {
        "hypotheses": [
            {"effects": sorted(some), "chi2": 0.0 if true <= some else rival, "cost": 2.0 * len(some)}
            for some in hypotheses
        ]
    }


def cases(rival: float) -> list[IdealCase]:
    clean = [IdealCase("clean", (), None)] * 10
    return clean + [IdealCase("single", (name,), ideal({name}, rival)) for name in NAMES * 5]


def test_effects_that_are_plain_to_see_have_sets_of_one() -> None:
    assert mean_sizes(cases(1000.0)) == pytest.approx([1.0] * 30)


def test_effects_that_leave_nothing_need_sets_that_hold_every_effect() -> None:
    """The data say nothing, so that a set must contain 0.9 of the prior: four effects, with or without the clean data."""
    sizes = mean_sizes(cases(0.0))
    assert min(sizes) >= 4


def test_the_sets_grow_between_these_two() -> None:
    means = [sum(mean_sizes(cases(rival))) for rival in (0.0, 4.0, 16.0, 100.0)]
    assert means == sorted(means, reverse=True) and means[0] > means[2] + 20


def test_without_an_ideal_observer_there_are_no_sizes() -> None:
    assert mean_sizes([IdealCase("clean", (), None)]) == []
