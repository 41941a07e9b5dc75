"""How often the posterior of a gap diagnosis contains the true cause, on the simulated cases of a blind set.

    python -m studies.gap_posterior -o DIR --cases 96 --seed 101

It makes a blind set (`psfcore.blind`), computes the posterior of every case with full refits, and keeps it in DIR. The threshold of
the answer is found on the cases with an even number and tested on the others, and the reverse. The table has for each kind of
case the share of answers that contain the true cause (with its 95 % Wilson interval), and their mean size. The command continues
where it was interrupted.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from heliopsf.transits import LIMITS, known_diffraction
from psfcore.blind.case_set import BlindSet, SetPlan, make_set
from psfcore.blind.score_table import wilson
from psfcore.errors import DataError
from psfcore.gap.diagnose import linear_model_of
from psfcore.gap.evidence.likelihood import Weighed
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.evidence.measured_noise import measured_noise
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.verdict.calibration import Calibration, true_share
from psfcore.gap.verdict.correction import add_to_model, with_library
from psfcore.gap.verdict.judge import fitted
from psfcore.gap.verdict.posterior import NONE, UNKNOWN, Names, at_refit, without_idle
from psfcore.gap.verdict.settled import settled_posterior
from psfcore.gap.view import View
from psfcore.scatter.inversion import invert
from psfcore.transit.folder import read_transit
from psfcore.whole_files import write_whole

KINDS = ("clean", "single", "pair", "unknown")
NAMED = tuple(effect for effect in LIBRARY if effect.named)
LEAST_LEFT_PCT = 1.0  # an effect that leaves less alone need not be in the answer if another leaves more
STRONG_PCT = 2.0


@dataclass(frozen=True)
class Case:
    """A case: its kind, the effects that the answer must contain, what they leave (%), and the probabilities found."""

    kind: str
    true: Names
    left_pct: float
    shares: Mapping[Names, float]

    @property
    def true_share(self) -> float:
        """The probability of the true cause."""
        if self.kind == "clean":
            return self.shares.get(NONE, 0.0)
        return true_share(self.shares, self.true)


class Refits:
    """Full refits of a transit. failed: the reasons of those that failed."""

    def __init__(self, view: View, model: LinearModel) -> None:
        self._view, self._model = view, model
        self.failed: list[str] = []

    def __call__(self, names: Names) -> Mapping[Names, Weighed] | None:
        effects = self._model.evidence.effects
        chosen = [effect for effect in effects if effect.name in names]
        try:
            made = add_to_model(
                self._view.solution, chosen, fitted(self._model, chosen), self._model, view=self._view
            )
            model = made.model if len(names) > 1 else with_library(made, effects, self._model)
        except DataError as error:
            self.failed.append(f"{'+'.join(names)}: {error.message}")
            return None
        return at_refit(model, self._model, names, made.subtracted, effects)


def shares_of(folder: Path) -> dict[Names, float]:
    """The probability of every hypothesis about the transit in a folder."""
    transit = read_transit(
        folder, LIMITS, diffraction=lambda instrument, _shape: known_diffraction(instrument, threads=1)
    )
    noise = measured_noise(transit)
    if noise is not None and not noise.agrees:
        transit = replace(transit, noise=noise.noise)
    view = View(invert(transit))
    model, _ = linear_model_of(view, NAMED)
    found, _ = settled_posterior(model, Refits(view, model))
    return without_idle(found.probabilities())


def case_of(truth: Mapping[str, Any], shares: Mapping[Names, float]) -> Case:
    """The case of a truth file."""
    effects = truth["effects"]
    required = tuple(
        effect["name"] for effect in effects if effect.get("left_alone_pct", LEAST_LEFT_PCT) >= LEAST_LEFT_PCT
    )
    true = required or tuple(effect["name"] for effect in effects)
    left = float(truth.get("left_after_refit_pct", 0.0))
    return Case(str(truth["kind"]), UNKNOWN if truth["kind"] == "unknown" else true, left, shares)


def table(cases: Sequence[Case], coverage: float) -> list[str]:
    """The lines of the table. Each half of the cases is tested with the threshold of the other half."""
    tested: list[tuple[Case, bool, int]] = []
    for half in (0, 1):
        calibrated = Calibration(tuple(case.true_share for case in cases[half::2]))
        least = calibrated.threshold(coverage)
        for case in cases[1 - half :: 2]:
            size = len(calibrated.answer(case.shares, coverage))
            tested.append((case, case.true_share >= least, size))
    rows = [(kind, [one for one in tested if one[0].kind == kind]) for kind in KINDS]
    strong = [one for one in tested if one[0].kind in ("single", "pair") and one[0].left_pct >= STRONG_PCT]
    rows += [("all", tested), (f"known effects, {STRONG_PCT:g} % or more left", strong)]
    lines = [f"{'cases':<36} {'true cause in the answer':<28} {'mean size':>9} {'right and alone':>16}"]
    for name, some in rows:
        if some:
            held, count = sum(one[1] for one in some), len(some)
            low, high = wilson(held, count)
            alone = sum(right and size == 1 for _, right, size in some) / count
            size = float(np.mean([one[2] for one in some]))
            lines.append(
                f"{name:<36} {f'{held / count:.2f} ({low:.2f} - {high:.2f}), {count}':<28} {size:>9.1f} {alone:>16.2f}"
            )
    return lines


def main() -> None:
    """Make the set, compute the posteriors that are missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--cases", type=int, default=96)
    parser.add_argument("--seed", type=int, default=101)
    parser.add_argument("--coverage", type=float, default=0.9)
    asked = parser.parse_args()
    plan = SetPlan(cases=asked.cases, seed=asked.seed)
    made, not_made = make_set(asked.output / "set", plan, progress=lambda line: print(line, flush=True))
    cases = [
        case_of(made.truth(number), _kept(made, number, asked.output / "shares"))
        for number in plan.numbers
        if number not in not_made
    ]
    print("\n".join(table(cases, asked.coverage)))


def _kept(made: BlindSet, number: int, folder: Path) -> dict[Names, float]:
    """The probabilities of a case, from its file or computed now."""
    file = folder / f"{number:04d}.json"
    if not file.is_file():
        shares = shares_of(made.transit(number))
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(file, json.dumps([[list(names), share] for names, share in shares.items()]))
        best = next(iter(shares))
        print(f"case {number:04d}: {'+'.join(best) or 'none'} {shares[best]:.2f}", flush=True)
    return {tuple(names): float(share) for names, share in json.loads(file.read_text("utf-8"))}


if __name__ == "__main__":
    main()
