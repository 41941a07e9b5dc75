"""Make the calibration of the gap diagnosis from simulated cases of known cause.

    python -m studies.gap_calibration -o DIR [--write]

The command makes a blind set (`psfcore.blind`), computes the posterior of every case with full refits, and stores it in
DIR. From the probabilities of the true causes it computes the temperature and the threshold. It prints how often the
answer sets contain the true cause, and how large they are. For this test, the calibration from one half of the cases is
applied to the other half, and the reverse. With --write it writes psfcore/gap/verdict/calibration.json. The seed must
not be used to test the diagnosis. The command continues where it was interrupted; one case takes about 15 s of one
processor core.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar

from heliopsf.psfs import LIMITS
from psfcore.blind.case_set import BlindSet, SetPlan, make_set
from psfcore.blind.judged import required_causes
from psfcore.blind.score import wilson
from psfcore.build import known_diffraction
from psfcore.errors import DataError
from psfcore.files import write_whole
from psfcore.gap.evidence.effect_fits import fit_effects
from psfcore.gap.evidence.expected_gap import linear_model_of
from psfcore.gap.evidence.fields import Field
from psfcore.gap.evidence.likelihood import TEMPLATE_ERRORS, Weighed
from psfcore.gap.evidence.measured_noise import measured_noise
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.verdict import calibration
from psfcore.gap.verdict.calibration import COVERAGE, Calibration, true_share
from psfcore.gap.verdict.posterior import (
    NONE,
    PRIOR,
    UNKNOWN,
    Form,
    Kind,
    Names,
    Posterior,
    kind_of,
    posterior,
    probabilities,
    without_idle,
)
from psfcore.gap.verdict.refits import Refits, settled_posterior
from psfcore.gap.view import View
from psfcore.scatter.inversion import invert
from psfcore.transit.folder import read_transit

KINDS = ("clean", "single", "pair", "unknown", "mixed")
FITTED: tuple[Kind, ...] = ("single", "unknown", "mixed")  # kinds whose prior probabilities are fitted
TEMPERATURES = (0.5, 10.0)
VISIBLE_SIGMA = 2.0
LEAST_SHARE = 1e-5  # a true cause that is less probable counts as if it had this probability
HOLDS_FOR = (
    "The coverage holds for transits like these: 18 images of 256 px in three pointings, with no effect, with one or two effects of the "
    "library, or with one effect that is not in the library. Each effect leaves a residual of 0.5 to 30 % in the discs after "
    "the PSF is refitted, or is as strong as is plausible. The author of the simulated effects did not use the library."
)


@dataclass(frozen=True)
class Case:
    """A case of known cause. true: the effects that an answer must contain. log_weights: as in `Posterior`.

    departures: how far each full refit differs from the first order (`departures_of`).
    """

    number: int
    kind: str
    true: Names
    log_weights: dict[Names, float]
    departures: tuple[float, ...] = ()

    def shares(self, temperature: float, prior: Mapping[Kind, float] = PRIOR) -> dict[Names, float]:
        """The probability of every hypothesis. prior: other prior probabilities of the kinds than those of the weights."""
        weights = {
            names: weight + math.log(prior[kind_of(names)] / PRIOR[kind_of(names)])
            for names, weight in self.log_weights.items()
        }
        return without_idle(probabilities(weights, temperature))

    def true_share(self, temperature: float, prior: Mapping[Kind, float] = PRIOR) -> float:
        """The probability of the true cause."""
        shares = self.shares(temperature, prior)
        if self.true in (NONE, UNKNOWN):
            return shares.get(self.true, 0.0)
        return true_share(shares, self.true)


def posterior_of(folder: Path) -> tuple[Posterior, tuple[float, ...]]:
    """Two results for the transit in a folder: the settled posterior; how far the refits differ from the first order."""
    transit = read_transit(
        folder, LIMITS, diffraction=lambda instrument, _shape: known_diffraction(instrument, threads=1)
    )
    noise = measured_noise(transit)
    if noise is not None and not noise.agrees:
        transit = replace(transit, noise=noise.noise)
    view = View(invert(transit))
    model, _ = linear_model_of(view, LIBRARY)
    refits = Refits(view, model)
    found = settled_posterior(posterior(model, refits.columns), refits.weighed)
    return found, departures_of(refits)


def departures_of(refits: Refits) -> tuple[float, ...]:
    """The measured template error of each refit: how far the refit differs from the first order.

    It is the rms difference between the residuals of the linear fit and of the refit in the cells, divided by the
    rms change of the cells by the effect. If the effects change the cells by less than VISIBLE_SIGMA, noise
    dominates, and the refit is left out.
    """
    out = []
    for form, refit in refits.made.items():
        before = refits.model_with(form)
        if refit.model.evidence.images != before.evidence.images:
            continue
        linear = fit_effects(before, refit.effects, any_sign=True).step
        left = before.left(linear)
        real = refit.model.left(refit.model.fit(refit.model.evidence.of_effects))
        base = len(before.evidence.base)
        own = list(linear.columns[base:])
        change = [disc.jacobian[own].T @ linear.values[base:] for disc in before.discs]
        size = _rms(change)
        if size > VISIBLE_SIGMA:
            out.append(_rms([a - b for a, b in zip(left, real, strict=True)]) / size)
    return tuple(out)


def _rms(vectors: Sequence[NDArray[np.float64]]) -> float:
    return float(np.sqrt(np.mean(np.concatenate(vectors) ** 2)))


def in_calibration(cases: Sequence[Case]) -> list[Case]:
    """The cases that set the threshold: all but those of a known effect beside an unknown cause.

    In half of those the data do not show both, so that the true cause has no probability; a threshold with these cases makes sets
    of more than ten members.
    """
    return [case for case in cases if case.kind != "mixed"]


def calibrated(cases: Sequence[Case], about: Mapping[str, Any]) -> Calibration:
    """The calibration from these cases. If the refit of a true cause failed, the true cause has no weight, and its
    share is 0."""

    def loss(log_temperature: float) -> float:
        return _loss(case.true_share(float(np.exp(log_temperature))) for case in cases)

    low, high = np.log(TEMPERATURES)
    temperature = round(float(np.exp(minimize_scalar(loss, bounds=(low, high), method="bounded").x)), 2)
    return Calibration(temperature, tuple(sorted(case.true_share(temperature) for case in cases)), about)


def best_prior(cases: Sequence[Case], temperature: float) -> dict[Kind, float]:
    """The prior probabilities of the kinds whose mean logarithm of the probability of the true cause is largest.

    Only those of FITTED are fitted; the ratios of the others stay.
    """

    def prior(factors: NDArray[np.float64]) -> dict[Kind, float]:
        fitted = zip(FITTED, np.exp(factors), strict=True)
        scaled = dict(PRIOR) | {kind: PRIOR[kind] * factor for kind, factor in fitted}
        return {kind: float(share / sum(scaled.values())) for kind, share in scaled.items()}

    def loss(factors: NDArray[np.float64]) -> float:
        other = prior(factors)
        return _loss(case.true_share(temperature, other) for case in cases)

    return prior(
        minimize(loss, np.zeros(len(FITTED)), method="Powell", options={"xtol": 0.02, "ftol": 1e-4}).x
    )


def _loss(true_shares: Iterable[float]) -> float:
    """Minus the mean logarithm of the probabilities of the true causes."""
    return -float(np.mean(np.log(np.maximum(list(true_shares), LEAST_SHARE))))


def table(cases: Sequence[Case], coverage: float = COVERAGE) -> list[str]:
    """The lines of a table: how often the answer set contains the true cause, and its mean size.

    The calibration from one half of the cases is applied to the other half, and the reverse.
    """
    tested: list[tuple[Case, bool, int]] = []
    for half in (0, 1):
        made = calibrated(in_calibration(cases[half::2]), {})
        least = made.threshold(coverage)
        for case in cases[1 - half :: 2]:
            size = len(made.answer(case.shares(made.temperature), coverage))
            tested.append((case, case.true_share(made.temperature) >= least, size))
    lines = [f"{'cases':<10} {'true cause in the answer':<28} {'mean size':>9} {'right and alone':>16}"]
    for kind in (*KINDS, "all"):
        some = [one for one in tested if kind in (one[0].kind, "all")]
        if some:
            held, count = sum(right for _, right, _ in some), len(some)
            low, high = wilson(held, count)
            alone = sum(right and size == 1 for _, right, size in some) / count
            size = float(np.mean([size for _, _, size in some]))
            lines.append(
                f"{kind:<10} {f'{held / count:.2f} ({low:.2f} - {high:.2f}), {count}':<28} {size:>9.1f} {alone:>16.2f}"
            )
    return lines


def cases_of(folder: Path, plan: SetPlan, processes: int) -> Iterator[Case]:
    """Make a set, compute the weights of its cases, and yield the cases."""
    made, not_made = make_set(
        folder / "set", plan, processes=processes, progress=lambda line: print(line, flush=True)
    )
    numbers = [number for number in plan.numbers if number not in not_made]
    kept = folder / "weights"
    kept.mkdir(parents=True, exist_ok=True)
    missing = [number for number in numbers if not _file(kept, number).is_file()]
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        for line in pool.map(_keep, [made.transit(n) for n in missing], [_file(kept, n) for n in missing]):
            print(line, flush=True)
    for number in numbers:
        if _file(kept, number).is_file():
            yield _read(made, number, kept)


def _file(kept: Path, number: int) -> Path:
    return kept / f"{number:04d}.json"


def _read(made: BlindSet, number: int, kept: Path) -> Case:
    truth = made.truth(number)
    found = json.loads(_file(kept, number).read_text("utf-8"))
    forms = {
        Form(
            tuple(effects), None if field is None else Field(**field | {"parts": tuple(field["parts"])})
        ): Weighed(evidence, (), np.zeros(0), 0.0)
        for effects, field, evidence in found["forms"]
    }
    weights = Posterior(forms, tuple(found["order"])).log_weights
    return Case(number, str(truth["kind"]), required_causes(truth), weights, tuple(found["departures"]))


def _keep(transit: Path, file: Path) -> str:
    """Compute the evidence of the forms of all hypotheses of a case and write it. Returns a line for the log."""
    try:
        found, departures = posterior_of(transit)
    except DataError as error:
        return f"case {file.stem}: {error.message}"
    listed = [
        [form.effects, None if form.field is None else asdict(form.field), weighed.log_evidence]
        for form, weighed in found.forms.items()
    ]
    write_whole(file, json.dumps({"order": found.order, "forms": listed, "departures": departures}))
    return f"case {file.stem}: {'+'.join(next(iter(found.probabilities()))) or 'none'}"


def main() -> None:
    """Make the sets, compute the posteriors that are missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, required=True)
    parser.add_argument("--cases", type=int, default=144)
    parser.add_argument("--seed", type=int, default=102)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--write", action="store_true")
    asked = parser.parse_args()
    plan = SetPlan(cases=asked.cases, seed=asked.seed, withheld="calibration")
    cases = list(cases_of(asked.output, plan, asked.processes))
    about = {
        "seed": asked.seed,
        "command": f"python -m studies.gap_calibration --cases {asked.cases} --seed {asked.seed} --write",
        "version": version("heliopsf"),
        "holds_for": HOLDS_FOR,
    }
    made = calibrated(in_calibration(cases), about)
    print(f"{len(cases)} cases, temperature {made.temperature:g}, threshold {made.threshold():.3g}")
    print("\n".join(table(cases)))
    best = best_prior(cases, made.temperature)
    print(
        "best prior: "
        + ", ".join(f"{kind} {share:.2f} ({PRIOR[kind]:g} used)" for kind, share in best.items())
    )
    departures = [one for case in cases for one in case.departures]
    if departures:
        print(
            f"{len(departures)} full refits depart from first order by {np.median(departures):.3f} of the change (median); "
            f"the likelihood assumes {', '.join(f'{error:g}' for error in TEMPLATE_ERRORS)}"
        )
    if asked.write:
        file = Path(calibration.__file__).with_name(calibration.FILE)
        content = {"temperature": made.temperature, "about": about, "true_shares": made.true_shares}
        write_whole(file, json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
