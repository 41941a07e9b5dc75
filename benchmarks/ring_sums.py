"""`python -m benchmarks.ring_sums [--quick]`: time three methods for sums of images over shells, as ratios to 1 F.

The sums are computed about 51,660 target pixels: the 410 pixels nearest to each of 126 positions of the occulter along
a transit, in images of 2048 px. Sums are over the 50 published shells. 1 F is defined in `benchmarks.timing`. Two of the methods, the plain look-up and one
convolution for each shell, are too slow for all targets. They are timed on a part of the targets, and the times are
scaled to all targets. On that part, their sums are compared with those of the third method, the running sums.
"""

from __future__ import annotations

import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from benchmarks.timing import THREADS, reference, seconds
from psfcore.scatter.segments import Segments, segment_sums, shells_as_published
from tests.psfcore.scatter.ring_sum_references import segment_sums_fft, segment_sums_plain

IMAGES, TARGETS_AN_IMAGE, SIZE_PX = 126, 410, 2048
EDGES_PX = shells_as_published()


def transit_targets() -> list[NDArray[np.int64]]:
    """The 410 pixels nearest to each of 126 positions on a straight line across the image."""
    dy, dx = np.indices((31, 31)) - 15
    nearest = np.argsort((dy**2 + dx**2).ravel(), kind="stable")[:TARGETS_AN_IMAGE]
    disc = np.column_stack((dy.ravel()[nearest], dx.ravel()[nearest]))
    along = np.linspace(0.1, 0.9, IMAGES) * SIZE_PX
    return [disc + np.array([round(0.55 * SIZE_PX + 0.1 * x), round(x)]) for x in along]


def report(what: str, took_s: float, f_s: float, note: str = "") -> None:
    print(f"{what:<58} {took_s:9.2f} s {took_s / f_s:9.1f} F  {note}", flush=True)


def of_part(sums: NDArray[np.float64], expected: NDArray[np.float64]) -> str:
    """The largest relative difference between two methods, as text."""
    return f"largest relative difference {np.abs(sums / expected - 1).max():.1e}"


def ring_sums_bench(*, quick: bool = False) -> None:
    """Print the table. quick: use a tenth of the images for the running sums, and one shell for the FFT."""
    f_s = reference()
    print(f"1 F = {f_s:.3f} s, {THREADS} threads, {IMAGES * TARGETS_AN_IMAGE} targets")
    rng = np.random.default_rng(0)
    images = [rng.gamma(2.0, 100.0, (SIZE_PX, SIZE_PX)).astype(np.float32) for _ in range(3)]
    targets = transit_targets()
    used = range(0, IMAGES, 10) if quick else range(IMAGES)
    scale = IMAGES / len(used)
    scaled = f"{len(used)} images, scaled" if quick else ""
    segments = Segments(EDGES_PX)
    report(f"50 shells ({segments.size}): preparation", seconds(lambda: segments.runs), f_s)

    def one(n: int, threads: int = 1) -> NDArray[np.float64]:
        return segment_sums(images[n % len(images)], targets[n], segments, threads=threads)

    def side_by_side() -> None:
        with ThreadPoolExecutor(THREADS) as pool:
            list(pool.map(one, used))

    one(0)
    report("  running sums, one thread", scale * seconds(lambda: [one(n) for n in used]), f_s, scaled)
    took = scale * seconds(lambda: [one(n, threads=THREADS) for n in used])
    report(f"  running sums, {THREADS} threads on each image", took, f_s, scaled)
    report(f"  running sums, {THREADS} images in parallel", scale * seconds(side_by_side), f_s, scaled)
    sums = segment_sums(images[0], targets[0], segments)
    some = slice(0, TARGETS_AN_IMAGE, 100 if quick else 40)
    part = targets[0][some]
    result: list[NDArray[np.float64]] = []
    took = seconds(lambda: result.append(segment_sums_plain(images[0], part, segments)))
    note = f"{len(part)} targets, scaled; {of_part(sums[some], result[-1])}"
    report("50 shells: plain look-up, one thread", took * IMAGES * TARGETS_AN_IMAGE / len(part), f_s, note)
    # A convolution costs the same for every shell.
    shells = (0, 49)[1 if quick else 0 :]
    took = 0.0
    differences = []
    for k in shells:
        shell = Segments(EDGES_PX[k : k + 2])
        took += seconds(
            lambda s=shell: result.append(segment_sums_fft(images[0], targets[0], s, threads=THREADS))
        )
        differences.append(of_part(sums[:, [k]], result[-1]))
    note = f"{len(shells)} of 50 shells of one image, scaled; {differences[-1]}"
    report(f"50 shells: FFT, {THREADS} threads", took / len(shells) * 50 * IMAGES, f_s, note)


if __name__ == "__main__":
    ring_sums_bench(quick="--quick" in sys.argv)
