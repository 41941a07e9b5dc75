"""The table of `make bench`; the race and the figures of growth in the documentation."""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.figures import Figure, table
from benchmarks.growth import AXES
from benchmarks.race.peers import CONTENDERS

GROWTH = Path(__file__).parents[2] / "docs" / "growth"
PAGE = (GROWTH.parent / "speed.md").read_text("utf-8")
TIME, MEMORY = "20 steps, 2048 px", "memory for a pixel of the padded plane, 2048 px"
GAIN = "bulk: gain of two workers / of two plain processes"
OVERHEAD = "bulk, one worker: overhead"  # one that reaches its goal is no regression
BEFORE = {
    one.name: one
    for one in (Figure(TIME, 1.0, 0.1), Figure(MEMORY, 10.0), Figure(GAIN, 98.0), Figure(OVERHEAD, 0.1))
}


def rows(*changed: Figure) -> str:
    return table(changed, {name: vars(figure) for name, figure in BEFORE.items()})


def test_a_figure_is_compared_with_its_goal_and_the_stored_one() -> None:
    """A time counts as a ratio to the unit of its run; a figure that is 20 % worse is named, and so is one not
    measured."""
    slow_machine = rows(Figure(TIME, 2.0, 0.2))
    assert all(
        one in slow_machine for one in ("x 1.00", "goal <= 1.1 s", "missed", f"not measured: {MEMORY}")
    )
    for figure, named in (
        (Figure(TIME, 1.19, 0.1), False),
        (Figure(TIME, 1.21, 0.1), True),
        (Figure(MEMORY, 12.1), True),
        (Figure(GAIN, 75.0), True),
        (Figure(GAIN, 120.0), False),
        (Figure(OVERHEAD, 0.5), False),
        (Figure(OVERHEAD, 2.5), True),
    ):
        assert (f"REGRESSION: {figure.name}" in rows(figure)) == named, figure


def test_the_documentation_shows_every_package_of_the_race_and_a_measured_figure_of_every_quantity() -> None:
    for name in CONTENDERS:
        assert f"\n| {name} | " in PAGE
    measured = json.loads((GROWTH / "measured.json").read_text("utf-8"))
    assert set(measured) == set(AXES)
    for name, axis in measured.items():
        assert f"](growth/{name}.svg)" in PAGE and (GROWTH / f"{name}.svg").is_file()
        assert len(axis["points"]) >= 2 and axis["machine"]
