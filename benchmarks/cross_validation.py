"""Time a cross-validation, compare the shared scheme with the exact one, and measure the cost of a lost worker.

    python -m benchmarks.cross_validation [--full]

It uses 30 simulated images of 512 px. Shared scheme: 100 folds in this process. Exact scheme: ten folds by two worker
processes of one thread each, with Redis and PostgreSQL. If this machine lacks them, the two worker processes of a local
service compute the folds. With Redis and PostgreSQL, the exact scheme runs a second time, and one of the two workers is
killed half-way. Times are printed as ratios to 1 F (see benchmarks/timing.py). The time of 100 exact folds is
extrapolated from the ten; --full runs all of them.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.timing import THREADS, reference
from psfcore.fits.blocks import FitsLimits
from psfcore.scatter.inversion import invert
from psfcore.scatter.validation.cross_validation import FoldFit, bands, bootstrap_samples, shared_fits
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate, write
from psfcore.transit.folder import read_transit
from studies.transits import diffraction, drawn_truth
from tests.whole import stack as stacks
from tests.whole.stack import Missing, Stack
from tests.whole.test_crossval import Parts, kill_worker_of

IMAGES, SIZE_PX, FOLDS, RUNS = 30, 512, 10, 10
ONE_THREAD_EACH = {"HELIOPSF_WORKER_THREADS": "1"}
WAIT_S = 0.25


def shared(folder: Path, f_s: float) -> tuple[FoldFit, ...]:
    """Compute 100 folds by the shared scheme in this process."""
    transit = read_transit(folder, FitsLimits(max_pixels=(2 * SIZE_PX) ** 2))
    start = time.perf_counter()
    solution = invert(transit, threads=THREADS)
    fitted = time.perf_counter() - start
    fits = shared_fits(solution, bootstrap_samples(IMAGES, runs=RUNS))
    told(
        f"shared scheme, {len(fits)} folds with free fits (including {fitted:.0f} s for the fit)", start, f_s
    )
    return fits


def told(what: str, start: float, f_s: float) -> None:
    """Print the time since `start`, in seconds and in units of 1 F."""
    took = time.perf_counter() - start
    print(f"{what}: {took:.0f} s = {took / f_s:.0f} F", flush=True)


@contextmanager
def two_workers(folder: Path) -> Iterator[Stack]:
    """Two worker processes with their own Redis and PostgreSQL, or a local service with two worker processes."""
    os.environ.update(ONE_THREAD_EACH)
    folder.mkdir()
    try:
        with stacks.served(folder, workers=2) as stack:
            yield stack
    except Missing as missing:
        print(f"{missing}: using a local service with two worker processes instead")
        os.environ["HELIOPSF_WORKER_PROCESSES"] = "2"
        with stacks.embedded(folder) as stack:
            yield stack


def exact(stack: Stack, transit_id: str, runs: int, seed: int, f_s: float) -> tuple[FoldFit, ...]:
    """Compute folds by the exact scheme, and print the time."""
    start = time.perf_counter()
    job = stack.client.submit("cross-validate", transit_id=transit_id, scheme="exact", runs=runs, seed=seed)
    first: float | None = None
    while (row := stack.client.job(job["id"]))["phase"] in ("QUEUED", "EXECUTING"):
        if first is None and row["progress"]["stage"] == "folds" and row["progress"]["step"] >= 1:
            first = time.perf_counter()
            done = row["progress"]["step"]
        time.sleep(WAIT_S)
    folds = folds_of(stack, stack.client.wait(row))
    told(f"exact scheme, {len(folds)} folds by two workers", start, f_s)
    if first is not None and len(folds) < FOLDS * RUNS:
        a_fold = (time.perf_counter() - first) / (len(folds) - done)
        whole = first - start + a_fold * (FOLDS * RUNS - done)
        print(
            f"  {first - start:.0f} s to the first fold, then {a_fold:.1f} s per fold: "
            f"{FOLDS * RUNS} folds in {whole / 60:.1f} min = {whole / f_s:.0f} F",
            flush=True,
        )
    return folds


def folds_of(stack: Stack, job: dict[str, Any]) -> tuple[FoldFit, ...]:
    report = stack.data.parent / "report.json"
    stack.client.download(stack.client.get(job["result"])["file"], report, overwrite=True)
    return tuple(FoldFit.from_json(fold) for fold in json.loads(report.read_text())["folds"])


def compared(exactly: tuple[FoldFit, ...], quickly: tuple[FoldFit, ...]) -> None:
    """Print the differences between the bands of both schemes for the same folds."""
    radii = np.arange(len(exactly[0].curve_pct), dtype=np.float64)
    one, other = (bands(fits, radii) for fits in (exactly, quickly))
    widths = [b.curve_pct[3] - b.curve_pct[1] for b in (one, other)]
    half = widths[1] / 2
    apart = np.abs(one.curve_pct[2] - other.curve_pct[2]) / half
    each = np.abs(np.subtract([f.curve_pct for f in exactly], [f.curve_pct for f in quickly])) / half
    print(
        f"  width of the 1 sigma bands, exact / shared: {(widths[0] / widths[1]).min():.2f} to "
        f"{(widths[0] / widths[1]).max():.2f}; differences in half-widths: medians at most {apart.max():.2f}, single "
        f"folds {np.median(each):.2f} (median) and {each.max():.2f} (largest)"
    )
    print(
        f"  held-out rms {one.held_out['rms_pct']:.3f} % exact, {other.held_out['rms_pct']:.3f} % shared",
        flush=True,
    )
    if one.shells is not None and other.shells is not None:
        print(
            f"  free fit minus formula near the centre: {one.shells.near_centre.points:+.2f} exact, "
            f"{other.shells.near_centre.points:+.2f} shared, +- {other.shells.near_centre.sigma:.2f} points"
        )


def with_one_killed(stack: Stack, transit_id: str, undisturbed: tuple[FoldFit, ...], f_s: float) -> None:
    """Compute further folds, and kill the helping worker half-way. No fold may be lost or computed twice."""
    if not stack.workers:
        print("one worker killed half-way: not measured, because it requires Redis and PostgreSQL")
        return
    parts = Parts(stack)
    before = parts.done()
    start = time.perf_counter()
    job = stack.client.submit("cross-validate", transit_id=transit_id, scheme="exact", runs=1, seed=2)
    while parts.done() - before < FOLDS // 2 or parts.taken() < 2:
        time.sleep(WAIT_S)
    kill_worker_of(stack, job["id"], own=False)
    found = folds_of(stack, stack.client.wait(job))
    told(f"exact scheme, one of two workers killed after {FOLDS // 2} folds", start, f_s)
    expected = [(fit.run, fit.fold) for fit in undisturbed]
    assert [(fit.run, fit.fold) for fit in found] == expected
    assert parts.done() - before == FOLDS
    parts.close()
    print("  no fold was lost, and none was computed twice", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--full", action="store_true", help="also run 100 exact folds")
    asked = parser.parse_args()
    f_s = reference()
    print(f"1 F = {f_s:.3f} s", flush=True)
    with TemporaryDirectory() as temporary:
        folder = Path(temporary) / "transit"
        write(
            simulate(
                default_plan(IMAGES, SIZE_PX), drawn_truth(1), diffraction(2 * SIZE_PX), 1, threads=THREADS
            ),
            folder,
        )
        quickly = shared(folder, f_s)
        with two_workers(Path(temporary) / "stack") as stack:
            transit_id = stack.client.upload_transit(folder)["id"]
            exactly = exact(stack, transit_id, 1, 1, f_s)
            compared(exactly, quickly[:FOLDS])
            if asked.full:
                compared(exact(stack, transit_id, RUNS, 1, f_s), quickly)
            with_one_killed(stack, transit_id, exactly, f_s)


if __name__ == "__main__":
    main()
