"""The study of the calibration: the smallest level at which the answer to a case contains a true cause."""

from __future__ import annotations

from typing import Any

import pytest

from studies.gap_calibration import MISSED, smallest_level

DARK, HALO, GLOW = ("offset_place", "dark_offset"), ("psf", "wide_halo"), ("light_place", None)
TRUE = {"families": ["offset_place"]}
WITHHELD = {"families": ["light_place", "light_time"]}


def report(*rows: tuple[float, tuple[str, str | None]]) -> dict[str, Any]:
    """A report with one hypothesis for each label, and the rest of the probability for no cause."""
    causes = [
        {"causes": [{"family": f, "effect": effect}], "probability": share} for share, (f, effect) in rows
    ]
    return {"hypotheses": [*causes, {"causes": [], "probability": 1 - sum(share for share, _ in rows)}]}


def test_the_smallest_level_that_covers_a_true_cause() -> None:
    for rows, effect, level in (
        ([(0.95, DARK), (0.04, HALO)], TRUE, 0.3),
        ([(0.6, HALO), (0.39, DARK)], TRUE, 0.61),
        ([(0.95, GLOW), (0.04, HALO)], WITHHELD, 0.3),
        ([(0.95, HALO), (0.04, GLOW)], WITHHELD, 0.96),
        ([(0.95, HALO), (0.04, DARK)], WITHHELD, MISSED),
        ([(0.5, DARK), (0.1, HALO)], TRUE, None),  # no gap is detected
    ):
        truth = {"effects": [{"families": ["ghost"]}, effect]}
        found = smallest_level(report(*rows), truth)
        assert found == (None if level is None else pytest.approx(level, abs=0.011)), (rows, effect)
