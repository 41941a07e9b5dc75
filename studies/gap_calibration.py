"""Calibrate the level of the answer of a gap diagnosis, with simulated cases of known cause.

The cases have effects of the library, written by another author, and withheld effects of the calibration; those of the
tests are never used. Each case is diagnosed from its images alone. From its report follows the smallest level at which
the alternatives contain a true cause (`psfcore.gap.verdict.calibration`, Eq. (1)). Cases in which no gap is detected do
not count.

    python -m studies.gap_calibration -o DIR --cases 64 --seed 502 --write

--write replaces the calibration that belongs to this version of the library.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import click
import numpy as np

from psfcore.blind.case_set import make_set
from psfcore.blind.cases import SetPlan
from psfcore.blind.effects.effect import CALIBRATION
from psfcore.blind.judge import diagnosed_cases
from psfcore.blind.run_set import run_set
from psfcore.gap.verdict import calibration
from psfcore.gap.verdict.answer import Labels, causes_of
from service.cli.transits import DIAGNOSE

TRIED = (*np.linspace(0.3, 0.99, 70), 0.995)
MISSED = 1.0  # the level of a case whose true cause is in no group
HOLDS_FOR = (
    "They are like these: 18 images of 256 px in three pointings, with one or two effects of the library, or with "
    "an effect that is not in the library, whose gap is detected. The author of the simulated effects did not use "
    "the library."
)


def smallest_level(report: Mapping[str, Any], truth: Mapping[str, Any]) -> float | None:
    """The smallest level at which the alternatives of a report contain a true cause; None if no gap is detected."""
    shares: dict[Labels, float] = {
        frozenset((one["family"], one["effect"]) for one in row["causes"]): row["probability"]
        for row in report["hypotheses"]
    }
    if not causes_of(shares, TRIED[0]):
        return None
    true = {family for effect in truth["effects"] for family in effect["families"]}
    for level in TRIED:
        if any(one.family.name in true for cause in causes_of(shares, level) for one in cause.alternatives):
            return float(level)
    return MISSED


@click.command()
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path))
@click.option("--cases", default=64)
@click.option("--seed", default=502)
@click.option("--processes", default=2)
@click.option("--write", is_flag=True)
def main(output: Path, cases: int, seed: int, processes: int, write: bool) -> None:
    """Make, diagnose and calibrate."""

    def say(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    plan = SetPlan(cases, seed, withheld=CALIBRATION)
    blind_set, not_made = make_set(output, plan, processes=processes, progress=say)
    numbers = [number for number in range(cases) if number not in not_made]
    run_set(blind_set, numbers, DIAGNOSE, processes=processes, progress=say)
    diagnosed, _ = diagnosed_cases(blind_set, numbers)
    found = [smallest_level(case.report, case.truth) for case in diagnosed if case.causes]
    levels = sorted(level for level in found if level is not None)
    command = f"python -m studies.gap_calibration --cases {cases} --seed {seed} --write"
    about = {"seed": seed, "command": command, "version": version("heliopsf"), "holds_for": HOLDS_FOR}
    level = calibration.Calibration(tuple(levels), about).level()
    print(f"{len(levels)} cases; level {level:.3f}; missed {sum(one >= MISSED for one in levels)}")
    if write:
        file = Path(calibration.__file__).with_name(calibration.FILE)
        file.write_text(json.dumps({"about": about, "levels": levels}, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
