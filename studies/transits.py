"""Measure the accuracy of the inversion on simulated transits of known truth: bias, errors, pulls, positions, stretch.

    python -m studies.transits [--seeds 20] [--processes 2] [--published 0] [--stretch 0] [--size 512] [--images 30]
    python -m studies.transits --bands | --shapes

Each seed has its own power law, scenes, ephemeris and noise. The output compares the cumulative curve of the total PSF
with the truth, and the rms of its errors with the photon bound. The output also lists the pulls, the errors of the
position of the occulter, and the errors of the curve for images without noise and with exact positions. Options add the
published recipe and stretched scatter. --bands: only compare the bands of cross-validations with the truth. --shapes:
only compare shapes of scatter by their residuals in held-out images, and compare the light of a free fit near the
centre with the power law; the truth is a power law.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache
from itertools import repeat
from pathlib import Path
from tempfile import gettempdir
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.build import build_psf
from psfcore.evaluation.shapes import compare_shapes_by_errors
from psfcore.evaluation.summary_lines import shape_lines
from psfcore.instruments.model import load_instrument
from psfcore.psf import REACH_GRID_PX, cumulative_curve
from psfcore.scatter.as_published import AS_PUBLISHED, invert_as_published
from psfcore.scatter.inversion import invert
from psfcore.scatter.reconstruction import Solution
from psfcore.scatter.shapes import SHAPES, stretch_of
from psfcore.scatter.validation.cross_validation import bands, bootstrap_samples, shared_fits
from psfcore.simulate.bound import bound_of_sky
from psfcore.simulate.plan import default_plan
from psfcore.simulate.scatter_truth import ScatterTruth, total_kernel
from psfcore.simulate.transit import SimulatedTransit, simulate

BRIGHT_PHOTONS = 30.0


@cache
def diffraction(size: int) -> NDArray[np.float64]:
    """The diffraction of HRI_EUV on (size, size), sum 1; kept in the temporary folder, because it takes ten seconds."""
    kept = Path(gettempdir()) / f"heliopsf-study-{size}.npy"
    if not kept.is_file():
        psf = build_psf(load_instrument("hri_euv"), size=size, component="DIFFRACTION")
        made = kept.with_suffix(f".{os.getpid()}.npy")
        np.save(made, psf.kernel / psf.kernel.sum())
        made.replace(kept)
    return np.asarray(np.load(kept))


def drawn_truth(seed: int, stretch: float = 0.0, angle_deg: float = 0.0) -> ScatterTruth:
    """A random power law similar to the power law of the paper."""
    rng = np.random.default_rng([seed, 77])
    return ScatterTruth(
        b_px=rng.uniform(5.0, 7.5),
        c=rng.uniform(2.40, 2.65),
        total=rng.uniform(0.38, 0.45),
        stretch=stretch,
        angle_deg=angle_deg,
    )


def one(seed: int, size: int, images: int, published: bool, stretch: bool) -> dict[str, Any]:
    """All requested figures of one seed."""
    kernel = diffraction(min(2 * size, REACH_GRID_PX))
    truth = drawn_truth(seed)
    simulated = simulate(default_plan(images, size), truth, kernel, seed)
    started = time.perf_counter()
    solution = invert(simulated.transit)
    seconds = time.perf_counter() - started
    inversion = solution.inversion
    radii = inversion.radii_px
    true_curve = cumulative_curve(total_kernel(truth, kernel, REACH_GRID_PX), radii)
    bound = bound_of_sky(simulated.sky)
    out: dict[str, Any] = {
        "seed": seed,
        "radii": radii.tolist(),
        "seconds": seconds,
        "error": (inversion.curve_pct - true_curve).tolist(),
        "sigma": inversion.curve_sigma.tolist(),
        "bound": [at.total_sigma for at in bound.curve if at.radius_px in radii],
        "total_error": inversion.values["total"] - truth.total,
        "total_sigma": inversion.value_sigma["total"],
        "total_bound": bound.total,
        "chi2": inversion.chi2_per_pixel,
        "rounds": len(inversion.rounds),
        "converged": inversion.converged,
        "places": _places(simulated, solution, bound),
        "noise_free": _noise_free(simulated, true_curve),
    }
    if published:
        found = invert_as_published(simulated.transit, AS_PUBLISHED, seed=seed)
        out["published"] = (found.curve_pct - true_curve).tolist()
    if stretch:
        out["stretch"] = _stretch(seed, kernel, size, images)
    return out


def banded(seed: int, size: int, images: int) -> dict[str, Any]:
    """Cross-validate one seed. Returns the errors of the median, and half the width of the 1-sigma band."""
    kernel, truth = diffraction(min(2 * size, REACH_GRID_PX)), drawn_truth(seed)
    solution = invert(simulate(default_plan(images, size), truth, kernel, seed).transit)
    radii = solution.inversion.radii_px
    found = bands(shared_fits(solution, bootstrap_samples(images, seed=seed)), radii)
    true_curve = cumulative_curve(total_kernel(truth, kernel, REACH_GRID_PX), radii)
    return {
        "radii": radii.tolist(),
        "error": (found.curve_pct[2] - true_curve).tolist(),
        "sigma": ((found.curve_pct[3] - found.curve_pct[1]) / 2).tolist(),
        "held_out": found.held_out,
    }


def shaped(seed: int, size: int, images: int) -> dict[str, Any]:
    """For one seed, compare shapes by their errors in held-out images, and compare the free fit with the power law."""
    kernel, truth = diffraction(min(2 * size, REACH_GRID_PX)), drawn_truth(seed)
    solution = invert(simulate(default_plan(images, size), truth, kernel, seed).transit)
    found = bands(
        shared_fits(solution, bootstrap_samples(images, seed=seed)), solution.inversion.radii_px
    ).shells
    assert found is not None
    return {
        "seed": seed,
        "near": found.near_centre,
        "largest": found.largest,
        "excess_pull": found.excess_pct[2] / found.excess_sigma,
        "shapes": compare_shapes_by_errors(solution, seed=seed),
    }


def shapes_summary(rows: list[dict[str, Any]]) -> str:
    """One table per seed, and the excesses of the free fit."""
    lines = []
    for row in rows:
        lines.append(f"seed {row['seed']}")
        lines += shape_lines(row["shapes"].to_json())
        for name, excess in (("near the centre", row["near"]), ("most apart", row["largest"])):
            lines.append(
                f"free fit less power law, {name}: {excess.points:+.2f} +- {excess.sigma:.2f} points of all light "
                f"within {excess.within_px:.3g} px ({excess.of_formula_pct:+.0f} % of the power law's)"
            )
    pulls = np.array([row["excess_pull"] for row in rows])
    lines.append(
        f"pulls of the excess at all distances: rms {np.sqrt((pulls**2).mean()):.2f}, at most {np.abs(pulls).max():.2f}"
    )
    return "\n".join(lines)


def bands_summary(rows: list[dict[str, Any]]) -> str:
    """A table of the pulls of the bands."""
    pull = np.array([row["error"] for row in rows]) / np.array([row["sigma"] for row in rows])
    lines = [f"bands of {len(rows)} seeds; radii (px)   " + " ".join(f"{r:7g}" for r in rows[0]["radii"])]
    for name, values in (("pull, mean", pull.mean(0)), ("pull, width", pull.std(0, ddof=1))):
        lines.append(f"{name:<31}" + " ".join(f"{v:7.3f}" for v in values))
    return "\n".join(lines)


def _places(simulated: SimulatedTransit, solution: Solution, bound: Any) -> list[list[float]]:
    """For each frame: photons per pixel, errors in x and y, stated errors, bounds (px)."""
    rows = []
    for n, frame in zip(solution.part, solution.inversion.frames, strict=True):
        exact, found = simulated.plan.place(n), frame.found
        gain = simulated.plan.noise.photon_gain_dn
        photons = frame.observed * simulated.plan.shots[n].exposure_s / gain
        rows.append(
            [
                photons,
                found.place.x_px - exact.x_px,
                found.place.y_px - exact.y_px,
                found.sigma_x_px,
                found.sigma_y_px,
                *bound.places_px[n],
            ]
        )
    return rows


def _noise_free(simulated: SimulatedTransit, true_curve: NDArray[np.float64]) -> list[float]:
    """The errors of the curve for images without noise and with exact places."""
    frames = tuple(
        replace(frame, pixels=seen.astype(np.float32), place=simulated.plan.place(n))
        for n, (frame, seen) in enumerate(
            zip(simulated.transit.frames, simulated.sky.noise_free, strict=True)
        )
    )
    inversion = invert(replace(simulated.transit, frames=frames)).inversion
    return (inversion.curve_pct - true_curve).tolist()


def _stretch(seed: int, kernel: NDArray[np.float64], size: int, images: int) -> dict[str, Any]:
    """The stretch that a fit with a free angle finds, for a true stretch of 15 % at -15 degrees and of 0."""
    out = {}
    for name, amount in (("put_in", 0.15), ("none", 0.0)):
        truth = drawn_truth(seed, amount, -15.0)
        simulated = simulate(default_plan(images, size), truth, kernel, seed)
        inversion = invert(simulated.transit, SHAPES["stretched"]).inversion
        p, q = (inversion.values[k] for k in ("stretch_p", "stretch_q"))
        wanted = np.log1p(amount) * np.array([np.cos(np.radians(-30.0)), np.sin(np.radians(-30.0))])
        covariance = inversion.covariance[3:, 3:]
        miss = np.array([p, q]) - wanted
        out[name] = {
            "stretch_angle": stretch_of(inversion.values),
            "chi2_from_truth": float(miss @ np.linalg.solve(covariance, miss)),
            "chi2_from_none": float(np.array([p, q]) @ np.linalg.solve(covariance, np.array([p, q]))),
        }
    return out


def summary(rows: list[dict[str, Any]]) -> str:
    """The table of all seeds."""
    error, sigma, bound = (np.array([row[k] for row in rows]) for k in ("error", "sigma", "bound"))
    pull = error / sigma
    rms, bound_rms = np.sqrt((error**2).mean(0)), np.sqrt((bound**2).mean(0))
    lines = [f"{len(rows)} seeds; radii (px)   " + " ".join(f"{r:7g}" for r in rows[0]["radii"])]

    def line(name: str, values: NDArray[np.float64]) -> None:
        lines.append(f"{name:<26}" + " ".join(f"{v:7.3f}" for v in values))

    line("bias (points)", error.mean(0))
    line("  its standard error", error.std(0, ddof=1) / np.sqrt(len(rows)))
    line("rms (points)", rms)
    line("stated error, rms", np.sqrt((sigma**2).mean(0)))
    line("photon bound, rms", bound_rms)
    line("rms / photon bound", rms / bound_rms)
    line("pull, mean", pull.mean(0))
    line("pull, width", pull.std(0, ddof=1))
    line("noise-free, worst", np.abs([row["noise_free"] for row in rows]).max(0))
    total = np.array([row["total_error"] / row["total_sigma"] for row in rows])
    lines.append(
        f"total: pull mean {total.mean():.2f}, width {total.std(ddof=1):.2f}; rms / bound {_ratio(rows):.2f}"
    )
    places = np.array([p for row in rows for p in row["places"]])
    pulls = places[:, 1:3] / places[:, 3:5]
    bright = places[:, 0] >= BRIGHT_PHOTONS
    moderate = places[:, 5] < 0.3
    ratio = np.sqrt((places[moderate, 1:3] ** 2).sum() / (places[moderate, 5:7] ** 2).sum())
    lines.append(
        f"place: rms {np.sqrt((places[bright, 1:3] ** 2).mean()):.3f} px for discs with {BRIGHT_PHOTONS:g} photons "
        f"per pixel or more, bound {np.sqrt((places[bright, 5:7] ** 2).mean()):.3f}; pulls {pulls.mean():.2f} +- "
        f"{pulls.std():.2f}; for bounds below 0.3 px rms / bound = {ratio:.2f}"
    )
    seconds = [row["seconds"] for row in rows]
    lines.append(
        f"chi2 per pixel {np.mean([row['chi2'] for row in rows]):.3f}; rounds {np.mean([row['rounds'] for row in rows]):.1f}; "
        f"converged {sum(row['converged'] for row in rows)}; {np.median(seconds):.1f} s a fit, one thread"
    )
    if "published" in rows[0]:
        published = np.array([row["published"] for row in rows])
        line("as published, bias", published.mean(0))
        line("as published, rms", np.sqrt((published**2).mean(0)))
    if "stretch" in rows[0]:
        for name in ("put_in", "none"):
            found = np.array([row["stretch"][name]["stretch_angle"] for row in rows])
            miss = np.array([row["stretch"][name]["chi2_from_truth"] for row in rows])
            seen = np.array([row["stretch"][name]["chi2_from_none"] for row in rows])
            lines.append(
                f"stretch {name}: found {found[:, 0].mean():.3f} +- {found[:, 0].std():.3f} at "
                f"{np.median(found[:, 1]):.0f} degrees; within 2 sigma (chi2 < 6.18 of two) of the truth "
                f"{np.mean(miss < 6.18):.2f}, claimed (chi2 > 9.21, 1 %) {np.mean(seen > 9.21):.2f}"
            )
    return "\n".join(lines)


def _ratio(rows: list[dict[str, Any]]) -> float:
    error = np.array([row["total_error"] for row in rows])
    return float(np.sqrt((error**2).mean() / np.mean([row["total_bound"] ** 2 for row in rows])))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--images", type=int, default=30)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--published", type=int, default=0, help="number of seeds for the published recipe")
    parser.add_argument("--stretch", type=int, default=0, help="number of seeds for stretched scatter")
    parser.add_argument("--bands", action="store_true", help="only cross-validate each seed")
    parser.add_argument("--shapes", action="store_true", help="only compare shapes for each seed")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    diffraction(min(2 * asked.size, REACH_GRID_PX))
    with ProcessPoolExecutor(asked.processes) as pool:
        for wanted, part, told in (
            (asked.bands, banded, bands_summary),
            (asked.shapes, shaped, shapes_summary),
        ):
            if wanted:
                seeds = range(asked.first, asked.first + asked.seeds)
                print(told(list(pool.map(part, seeds, repeat(asked.size), repeat(asked.images)))))
                return
        jobs = [
            pool.submit(one, seed, asked.size, asked.images, k < asked.published, k < asked.stretch)
            for k, seed in enumerate(range(asked.first, asked.first + asked.seeds))
        ]
        rows = [job.result() for job in jobs]
    for key in ("published", "stretch"):
        part = [row for row in rows if key in row]
        if part and len(part) < len(rows):
            print(summary(part), flush=True)
            for row in part:
                row.pop(key)
    print(summary(rows))
    if asked.json:
        asked.json.write_text(json.dumps(rows))


if __name__ == "__main__":
    main()
