"""Test the limits: how often an effect of strength `found_90` is found, and how often the truth exceeds `excluded_95`.

    python -m studies.gap_limits -o DIR --cases 40 --seed 1

Each case is a clean simulated transit. Its limits are computed, one effect is added to its images at the strength that should be
found with 90 % probability, and the images are diagnosed with full refits (as in `studies.gap_calibration`). An effect is found if
the answer contains it and excludes "no effect". The table has 95 % Wilson intervals. The command continues where it was
interrupted.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from heliopsf.psfs import LIMITS
from psfcore.blind.score import wilson
from psfcore.errors import DataError
from psfcore.files import write_whole
from psfcore.gap.effect import Effect
from psfcore.gap.evidence.expected_gap import linear_model_of
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.verdict.calibration import shipped_calibration
from psfcore.gap.verdict.correction import hold, images_without
from psfcore.gap.verdict.limits import ParameterLimits, limits
from psfcore.gap.verdict.posterior import NONE, posterior, without_idle
from psfcore.gap.verdict.refits import Refits, settled_posterior
from psfcore.gap.view import View
from psfcore.scatter.inversion import invert
from psfcore.simulate.inputs import diffraction_kernel
from psfcore.simulate.plan import default_plan
from psfcore.simulate.scatter_truth import ScatterTruth
from psfcore.simulate.transit import simulate
from psfcore.transit.transit import Transit

EFFECTS = (
    "dark_offset", "intensity_gradient", "gain_mismatch", "nonlinearity", "column_smear",
    "persistence", "ghost", "anisotropic_scatter", "wide_halo", "core_blur",
)  # fmt: skip
DIFFRACTION_PX = 512


@dataclass(frozen=True)
class Case:
    """One case. strength: the strength of the added effect. excluded_95: from the diagnosis. best: the most probable hypothesis."""

    effect: str
    parameter: str
    strength: float | None
    found: bool
    excluded_95: float | None
    best: str


@dataclass(frozen=True)
class Settings:
    """The settings that determine the cases."""

    seed: int
    images: int
    size_px: int
    threshold: float
    temperature: float


def case_of(number: int, asked: Settings) -> Case:
    """Make and diagnose a case. strength is None if no strength of the effect would be found, or if the images with it cannot be
    fitted."""
    name = EFFECTS[number % len(EFFECTS)]
    transit = clean(number, asked)
    view = View(invert(transit))
    model, _ = linear_model_of(view, LIBRARY)
    effect = next((one for one in model.evidence.effects if one.name == name), None)
    if effect is None:
        return Case(name, "", None, False, None, f"untestable: {model.evidence.untestable[name]}")
    leading = _limits(model, asked, name)[0]
    if leading.found_90 is None:
        return Case(name, leading.name, None, False, None, "no strength would be found")
    try:
        solution = invert(with_effect(transit, view, effect, leading))
    except DataError as error:
        # A limit of many times the likely size can be stronger than any image allows: a halo of 70 % hides the occulter.
        return Case(name, leading.name, None, False, None, f"{leading.found_90:.3g}: {error.code}")
    view = View(solution)
    model, _ = linear_model_of(view, LIBRARY)
    refits = Refits(view, model)
    found = settled_posterior(posterior(model, refits.columns), refits.weighed)
    shares = without_idle(found.probabilities(asked.temperature))
    best = next(iter(shares))
    answer = {names for names, share in shares.items() if share >= asked.threshold} | {best}
    after = {one.name: one for one in _limits(model, asked, name)}
    return Case(
        effect=name,
        parameter=leading.name,
        strength=leading.found_90,
        found=NONE not in answer and (name,) in answer,
        excluded_95=after[leading.name].excluded_95,
        best="+".join(best) or "none",
    )


def clean(number: int, asked: Settings) -> Transit:
    """The transit of a case, without an effect."""
    rng = np.random.default_rng([asked.seed, number])
    scatter = ScatterTruth(rng.uniform(3, 9), rng.uniform(2.3, 2.8), rng.uniform(0.25, 0.5))
    plan = default_plan(asked.images, asked.size_px)
    kernel = diffraction_kernel("hri_euv", None, DIFFRACTION_PX, LIMITS)
    return simulate(plan, scatter, kernel, int(rng.integers(2**31))).transit


def with_effect(transit: Transit, view: View, effect: Effect, at: ParameterLimits) -> Transit:
    """The transit, with the change by one parameter of an effect added to its images."""
    theta = np.array([at.found_90 if one.name == at.name else 0.0 for one in effect.parameters], dtype=float)
    held = hold(effect, view)
    count = len(list(held.changes(view)))
    return images_without(transit, view, [held], -theta[:count])


def _limits(model: LinearModel, asked: Settings, name: str) -> list[ParameterLimits]:
    """The limits of an effect: first those of its leading parameter, then those of every parameter, including the leading
    one."""
    found = limits(model, threshold=asked.threshold, temperature=asked.temperature).effects[name]
    return [found.leading, *found.parameters]


def table(cases: Sequence[Case]) -> list[str]:
    """The lines of the table, by effect and for all."""
    lines = [f"{'effect':<22} {'found (goal 0.90)':<30} {'truth above excluded_95 (at most 0.05)':<40}"]
    added = [case for case in cases if case.strength is not None]
    rows = [(name, [case for case in added if case.effect == name]) for name in EFFECTS]
    for name, some in [*rows, ("all", added)]:
        if some:
            found = sum(case.found for case in some)
            above = sum(_is_above(case) for case in some)
            lines.append(f"{name:<22} {_share(found, len(some)):<30} {_share(above, len(some))}")
    lines += [f"not added: {case.effect} ({case.best})" for case in cases if case.strength is None]
    return lines


def _is_above(case: Case) -> bool:
    return case.strength is not None and case.excluded_95 is not None and case.strength > case.excluded_95


def _share(hits: int, count: int) -> str:
    low, high = wilson(hits, count)
    return f"{hits / count:.2f} ({low:.2f} - {high:.2f}), {count}"


def main() -> None:
    """Compute the cases that are missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--images", type=int, default=18)
    parser.add_argument("--size", type=int, default=256)
    given = parser.parse_args()
    made = shipped_calibration()
    asked = Settings(given.seed, given.images, given.size, made.threshold(), made.temperature)
    print("\n".join(table([_kept(number, asked, given.output) for number in range(given.cases)])))


def _kept(number: int, asked: Settings, folder: Path) -> Case:
    """A case: read from its file, or computed now if there is no file."""
    file = folder / f"{number:04d}.json"
    about = asdict(asked)
    if not file.is_file():
        case = case_of(number, asked)
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(file, json.dumps({"settings": about, "case": asdict(case)}, indent=1))
        print(
            f"case {number:04d}: {case.effect} {case.strength}: found {case.found}, {case.best}", flush=True
        )
    kept = json.loads(file.read_text("utf-8"))
    if kept["settings"] != about:
        raise SystemExit(
            f"expected cases with the same settings in {folder}; got {kept['settings']}: name another folder"
        )
    return Case(**kept["case"])


if __name__ == "__main__":
    main()
