"""The figures of growth in the documentation, and the fit of their exponents."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.growth import AXES, FITTED_POINTS, draw, exponent

GROWTH = Path(__file__).parents[2] / "docs" / "growth"
PAGE = (GROWTH.parent / "speed.md").read_text("utf-8")


def test_the_exponent_of_a_power_law_is_found() -> None:
    n = [1.0, 10.0, 100.0, 1000.0]
    for power in (0.0, 2.3):
        assert exponent(n, [5 * one**power for one in n]) == pytest.approx(power, abs=1e-9)
        constant = [1e9, *(5 * one**power for one in n[-FITTED_POINTS:])]
        assert exponent(n, constant) == pytest.approx(power, abs=1e-9), "only the largest points are fitted"
    assert exponent([1.0], [1.0]) is None


def test_the_documentation_shows_a_measured_figure_of_every_quantity() -> None:
    table = json.loads((GROWTH / "measured.json").read_text("utf-8"))
    assert set(table) == set(AXES)
    for name, axis in table.items():
        assert f"](growth/{name}.svg)" in PAGE and (GROWTH / f"{name}.svg").is_file()
        assert len(axis["points"]) >= 2 and axis["machine"]


def test_equal_numbers_give_equal_figures(tmp_path: Path) -> None:
    points = [{"n": n, "seconds": 0.1 * n, "mib": 3.0 * n} for n in (1, 2, 4)]
    axis = {"label": "steps", "what": "a test", "points": points}
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        draw(tmp_path / name / "steps.svg", axis, "a machine")
    assert (tmp_path / "one" / "steps.svg").read_bytes() == (tmp_path / "two" / "steps.svg").read_bytes()
