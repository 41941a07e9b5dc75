"""The table of `make bench`; the race and the figures of growth in the documentation, and the fit of their exponents."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import figures
from benchmarks.figures import COLLECTED, Figure, figure_of, keep, kind_of_machine, stored, table, tell
from benchmarks.growth import AXES, FITTED_POINTS, exponent
from benchmarks.race.peers import CONTENDERS, Run, row

GROWTH = Path(__file__).parents[2] / "docs" / "growth"
PAGE = (GROWTH.parent / "speed.md").read_text("utf-8")
TIME, MEMORY, GAIN = (
    "20 steps, 2048 px",
    "memory for a pixel of the padded plane, 2048 px",
    "bulk: gain of two workers / of two plain processes",
)
OVERHEAD = "bulk, one worker: overhead"  # one that reaches its goal is no regression
BEFORE = {
    one.name: one
    for one in (Figure(TIME, 1.0, 0.1), Figure(MEMORY, 10.0), Figure(GAIN, 98.0), Figure(OVERHEAD, 0.1))
}


def rows(*changed: Figure) -> str:
    return table(changed, {name: vars(figure) for name, figure in BEFORE.items()})


def test_a_figure_is_compared_with_its_goal_and_the_stored_one() -> None:
    """A time counts as a ratio to the unit of its run; a figure that is 20 % worse is named, and so is one not measured."""
    slow_machine = rows(Figure(TIME, 2.0, 0.2))
    assert all(
        one in slow_machine for one in ("x 1.00", "goal <= 1.1 s", "missed", f"not measured: {MEMORY}")
    )
    for figure, named in (
        (Figure(TIME, 2.0, 0.2), False),
        (Figure(TIME, 1.19, 0.1), False),
        (Figure(TIME, 1.21, 0.1), True),
        (Figure(TIME, 0.2, 0.1), False),
        (Figure(MEMORY, 12.1), True),
        (Figure(GAIN, 90.0), False),
        (Figure(GAIN, 75.0), True),
        (Figure(GAIN, 120.0), False),
        (Figure(OVERHEAD, 0.5), False),
        (Figure(OVERHEAD, 2.5), True),
    ):
        assert (f"REGRESSION: {figure.name}" in rows(figure)) == named, figure


def test_figures_are_collected_and_stored_by_kind_of_machine_and_a_time_needs_its_unit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(COLLECTED, str(tmp_path / "told"))
    monkeypatch.setattr(figures, "STORED", tmp_path / "stored.json")
    tell(TIME, 0.5, 0.1)
    tell(MEMORY, 11)
    told = [figure_of(json.loads(line)) for line in (tmp_path / "told").read_text().splitlines()]
    assert told == [Figure(TIME, 0.5, 0.1), Figure(MEMORY, 11.0)]
    keep(told)
    keep([Figure(MEMORY, 12.0)])
    kept = stored()[kind_of_machine()]
    assert figure_of(kept[TIME]) == told[0] and kept[MEMORY]["value"] == 12.0 and kept[TIME]["date"]
    with pytest.raises(ValueError, match="expected f_s"):
        tell(TIME, 1.0)
    with pytest.raises(KeyError):
        tell("another figure", 1.0)


def test_a_row_of_the_race_has_the_median_ratio_and_the_documentation_has_every_package() -> None:
    ours = [Run(1.0, 0.5, 0.1, 0.0), Run(2.0, 0.5, 0.2, 0.0), Run(1.0, 0.5, 0.1, 0.0)]
    theirs = [Run(5.0, 1.5, 0.1, 1e-6), Run(12.0, 1.4, 0.2, 2e-6), Run(4.0, 1.4, 0.1, 1e-6)]
    cells = row("other", theirs, ours).split(" | ")
    assert cells[1:] == ["5.0 (4.0 to 12.0)", "50", "5.00 (4.00 to 6.00)", "1.50", "2e-06 |"]
    for name in CONTENDERS:
        assert f"\n| {name} | " in PAGE


def test_the_exponent_of_a_power_law_is_found() -> None:
    n = [1.0, 10.0, 100.0, 1000.0]
    for power in (0.0, 2.3):
        constant = [1e9, *(5 * one**power for one in n[-FITTED_POINTS:])]
        assert exponent(n, constant) == pytest.approx(power, abs=1e-9), "only the largest points are fitted"
    assert exponent([1.0], [1.0]) is None


def test_the_documentation_shows_a_measured_figure_of_every_quantity() -> None:
    table = json.loads((GROWTH / "measured.json").read_text("utf-8"))
    assert set(table) == set(AXES)
    for name, axis in table.items():
        assert f"](growth/{name}.svg)" in PAGE and (GROWTH / f"{name}.svg").is_file()
        assert len(axis["points"]) >= 2 and axis["machine"]
