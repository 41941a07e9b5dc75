"""Time a fit, and compare the fast solver with a simple reference solver.

    python -m benchmarks.fit [--full] [--folder DIR]

By default it fits 30 images of 512 px and prints the time as a ratio to 1 F (see benchmarks/timing.py). It also
fits nine images of 256 px with both solvers. The reference solver uses SciPy transforms in float64 and all images in
every round. For each set of parameters it reconstructs every scene anew, with thirty steps of Richardson's iteration.
It computes the derivatives by finite differences of the whole model. --full also fits 126 images of 2048 px and prints
the peak memory. The first run with --full writes 4 GB into DIR (default: the temporary folder).
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path
from tempfile import gettempdir

import numpy as np
from numpy.typing import NDArray

from benchmarks.figures import tell
from benchmarks.timing import THREADS, peak_gib, reference
from psfcore.convolution.convolver import Convolver
from psfcore.fits.blocks import FitsLimits
from psfcore.psf import cumulative_curve
from psfcore.scatter.fit import fit_transit
from psfcore.scatter.inversion import invert
from psfcore.scatter.reconstruction import LEAST_LEVEL, Solution
from psfcore.scatter.report import fit_sentence
from psfcore.scatter.total_psf import TotalPsf
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate, write
from psfcore.transit.folder import read_transit
from studies.transits import diffraction, drawn_truth

SCENE_STEPS = 30
STRAIGHT_ROUNDS = 4


def fit_of_512(f_s: float) -> None:
    """Fit 30 images of 512 px, with all results of `heliopsf psf fit`."""
    transit = simulate(default_plan(30, 512), drawn_truth(1), diffraction(1024), 1, threads=THREADS).transit
    fit_transit(simulate(default_plan(9, 128), drawn_truth(1), diffraction(256), 1).transit)  # compiles
    start = time.perf_counter()
    fit_transit(transit, threads=THREADS)
    took = time.perf_counter() - start
    print(f"fit of 30 images of 512 px: {took:.1f} s = {took / f_s:.0f} F", flush=True)


def compare_with_reference() -> None:
    """Compare the cumulative curves of both solvers for nine images of 256 px."""
    simulated = simulate(
        default_plan(9, 256, brightness=3.0), drawn_truth(2), diffraction(512), 2, threads=THREADS
    )
    solution = invert(simulated.transit, threads=THREADS)
    start = time.perf_counter()
    curve = reference_curve(solution)
    took = time.perf_counter() - start
    worst = np.abs(curve - solution.inversion.curve_pct).max()
    print(
        f"fast and reference solver, 9 images of 256 px: the curves differ by at most {worst:.4f} points "
        f"(smallest stated error {solution.inversion.curve_sigma.min():.2f}; the reference solver took {took:.0f} s)",
        flush=True,
    )


def reference_curve(solution: Solution) -> NDArray[np.float64]:
    """The cumulative curve at the minimum of Eq. (2) of the inversion, with the same start and dark pixels."""
    transit, inversion = solution.transit, solution.inversion
    total = TotalPsf(transit.diffraction, inversion.shape, transit.shape, threads=THREADS)

    def expected(at: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        convolver = Convolver(total.kernel(at), transit.shape, dtype=np.float64, threads=THREADS)
        out = []
        for n in solution.part:
            x = transit.frames[n].pixels.astype(np.float64)
            for _ in range(
                SCENE_STEPS
            ):  # Richardson's iteration. It converges, because the transform of the PSF is between 0.3 and 1
                x = x + (transit.frames[n].pixels - convolver.apply(x))
            x[solution.sky.dark[n]] = 0.0
            out.append(np.asarray(convolver.apply(x))[solution.sky.dark[n]])
        return out

    at = inversion.shape.start
    for _ in range(STRAIGHT_ROUNDS):
        here = expected(at)
        slopes = []
        for k in range(at.size):
            step = np.zeros_like(at)
            step[k] = 1e-3
            slopes.append(
                [(a - b) / 2e-3 for a, b in zip(expected(at + step), expected(at - step), strict=True)]
            )
        normal, score = np.zeros((at.size, at.size)), np.zeros(at.size)
        for k, n in enumerate(solution.part):
            frame = transit.frames[n]
            level = np.maximum(here[k], LEAST_LEVEL * here[k].mean())
            weight = 1 / transit.noise.variance(level, frame.exposure_s)
            jacobian = np.array([slope[k] for slope in slopes])
            normal += (jacobian * weight) @ jacobian.T
            score += (jacobian * weight) @ (frame.pixels[solution.sky.dark[n]] - here[k])
        at = at + np.linalg.solve(normal, score)
    return cumulative_curve(total.kernel(at), total.radii_px)


def full_size(folder: Path, f_s: float) -> None:
    """Fit 126 images of 2048 px in a separate process, which measures its own memory."""
    where = folder / "heliopsf-bench-126x2048"
    if not (where / "transit.json").is_file():
        plan = default_plan(126, 2048)
        write(simulate(plan, drawn_truth(3), diffraction(2048), 3, threads=THREADS), where)
    told = subprocess.run(
        [sys.executable, "-m", "benchmarks.fit", "--one", str(where)],
        capture_output=True,
        text=True,
        check=True,
    )
    took, gib, sentence = told.stdout.strip().split("\n")
    tell("fit of 126 images of 2048 px", float(took), f_s)
    print(f"  {gib} GiB; {sentence}", flush=True)


def one(folder: Path) -> None:
    """Fit the transit in a folder; print its time, peak memory and sentence."""
    start = time.perf_counter()
    transit = read_transit(folder, FitsLimits(max_pixels=4096 * 4096))
    found = fit_transit(transit, threads=THREADS)
    print(time.perf_counter() - start)
    print(f"{peak_gib():.2f}")
    print(fit_sentence(found))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--folder", type=Path, default=Path(gettempdir()))
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.one:
        one(asked.one)
        return
    f_s = reference()
    print(f"1 F = {f_s:.3f} s", flush=True)
    fit_of_512(f_s)
    compare_with_reference()
    if asked.full:
        full_size(asked.folder, f_s)


if __name__ == "__main__":
    main()
