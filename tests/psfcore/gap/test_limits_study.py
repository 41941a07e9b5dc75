"""The study of the limits: what it adds to the images, and its table."""

from __future__ import annotations

import numpy as np
import pytest

from psfcore.gap.verdict.limits import ParameterLimits
from psfcore.gap.view import View
from psfcore.scatter.inversion import Solution
from psfcore.transit.transit import Transit
from studies.gap_limits import Case, table, with_effect
from tests.psfcore.gap.small_transits import effect


def test_an_effect_is_added_at_its_strength(clean: Transit, solution: Solution) -> None:
    at = ParameterLimits("offset", "DN", 2.0, 3.0, None)
    changed = with_effect(clean, View(solution), effect("dark_offset"), at)
    for frame, before in zip(changed.frames, clean.frames, strict=True):
        np.testing.assert_allclose(frame.pixels - before.pixels, 3.0 / before.exposure_s, atol=0.01)


def test_the_table_counts_found_effects_and_truths_above_their_limit() -> None:
    cases = [
        Case("ghost", "share", 0.01, True, 0.02, "ghost"),
        Case("ghost", "share", 0.01, False, 0.009, "none"),
        Case("core_blur", "variance", 0.2, True, 0.3, "core_blur"),
        Case("wide_halo", "", None, False, None, "untestable: no light"),
    ]
    rows = {line.split()[0]: line for line in table(cases)[1:]}
    assert "0.50 (0.09 - 0.91), 2" in rows["ghost"]
    assert rows["ghost"].count("0.50") == 2
    assert "1.00" in rows["core_blur"] and "0.00" in rows["core_blur"]
    assert "0.67" in rows["all"] and "0.33" in rows["all"] and "wide_halo" not in rows
    assert rows["not"] == "not added: wide_halo (untestable: no light)"


@pytest.mark.parametrize("found", [1, 3])
def test_the_interval_of_a_share_contains_it(found: int) -> None:
    cases = [Case("ghost", "share", 0.01, n < found, 0.02, "ghost") for n in range(4)]
    low, high = (float(one) for one in table(cases)[1].split("(")[1].split(")")[0].split(" - "))
    assert low < found / 4 < high
