"""The table of `make bench`: goals, stored figures and regressions; and the table of the race in the documentation."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import figures
from benchmarks.figures import COLLECTED, Figure, figure_of, keep, kind_of_machine, stored, table, tell
from benchmarks.race.peers import CONTENDERS, Run, row

TIME, MEMORY, GAIN = (
    "20 steps, 2048 px",
    "memory for a pixel of the padded plane, 2048 px",
    "bulk: gain of two workers / of two plain processes",
)
BEFORE = {TIME: Figure(TIME, 1.0, 0.1), MEMORY: Figure(MEMORY, 10.0), GAIN: Figure(GAIN, 98.0)}


def rows(*changed: Figure) -> str:
    return table(changed, {name: vars(figure) for name, figure in BEFORE.items()})


def test_a_time_is_compared_as_a_ratio_to_the_unit_of_its_run() -> None:
    slow_machine = rows(Figure(TIME, 2.0, 0.2))
    assert "x 1.00" in slow_machine and "REGRESSION" not in slow_machine
    assert "goal <= 1.1 s" in slow_machine and "missed" in slow_machine


def test_a_figure_twenty_percent_worse_than_stored_is_named() -> None:
    for figure, named in (
        (Figure(TIME, 1.19, 0.1), False),
        (Figure(TIME, 1.21, 0.1), True),
        (Figure(TIME, 0.2, 0.1), False),
        (Figure(MEMORY, 12.1), True),
        (Figure(GAIN, 90.0), False),
        (Figure(GAIN, 75.0), True),
        (Figure(GAIN, 120.0), False),
    ):
        assert (f"REGRESSION: {figure.name}" in rows(figure)) == named, figure


def test_an_overhead_that_reaches_its_goal_is_no_regression() -> None:
    name = "bulk, one worker: overhead"
    earlier = {name: vars(Figure(name, 0.1))}
    assert "REGRESSION" not in table([Figure(name, 0.5)], earlier)
    assert "REGRESSION" in table([Figure(name, 2.5)], earlier)


def test_a_figure_that_was_not_measured_is_named() -> None:
    assert f"not measured: {MEMORY}" in rows(BEFORE[TIME])


def test_figures_are_collected_and_stored_by_kind_of_machine(
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


def test_a_time_without_its_unit_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(COLLECTED, raising=False)
    with pytest.raises(ValueError, match="expected f_s"):
        tell(TIME, 1.0)
    with pytest.raises(KeyError):
        tell("another figure", 1.0)


def test_a_row_of_the_race_has_the_median_ratio_of_the_rounds() -> None:
    ours = [Run(1.0, 0.5, 0.1, 0.0), Run(2.0, 0.5, 0.2, 0.0), Run(1.0, 0.5, 0.1, 0.0)]
    theirs = [Run(5.0, 1.5, 0.1, 1e-6), Run(12.0, 1.4, 0.2, 2e-6), Run(4.0, 1.4, 0.1, 1e-6)]
    cells = row("other", theirs, ours).split(" | ")
    assert cells[1:] == ["5.0 (4.0 to 12.0)", "50", "5.00 (4.00 to 6.00)", "1.50", "2e-06 |"]


def test_the_documentation_has_the_race_with_every_package() -> None:
    page = (Path(__file__).parents[2] / "docs" / "speed.md").read_text("utf-8")
    for name in CONTENDERS:
        assert f"\n| {name} | " in page
