"""The stages of a Richardson-Lucy step beside the limits of this machine (a roofline); part of `make bench`.

    python -m benchmarks.roofline [--size 2048]

For each stage, the number of bytes that it must move between memory and cores, and the number of its floating-point
operations, follow from the sizes of its arrays:

    bytes: every array that the stage reads or writes counts once for each access
    operations: 5 L log2(L) for a complex transform of length L, and the operations on single pixels

The limits are measured in the same run: the memory bandwidth with copies of arrays that are larger than the caches, and the
rate of operations with a product of matrices. A stage then needs at least

    floor = max(bytes / bandwidth, operations / rate)

A product of matrices consists of fused multiply-adds. Most additions and multiplications of a transform cannot be fused, so a
transform can reach about half of this rate.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from astropy.io.fits import Header

from benchmarks.figures import tell
from benchmarks.timing import THREADS, reference, seconds
from psfcore.build import build_psf
from psfcore.convolution.fft_kernels import LANES
from psfcore.deconvolve.conditions import Conditions, PreparedPsfs
from psfcore.deconvolve.methods.registry import method_named
from psfcore.deconvolve.methods.richardson_lucy import METHOD, _ratio_rows, _RichardsonLucy, _update_rows
from psfcore.deconvolve.problem import pose
from psfcore.image import Image
from psfcore.instruments.model import load_instrument

COPIED_FLOATS = 2**26
MATRIX = 2048
REPEATS = 7
STEPS = 20
RATIO_FLOPS, UPDATE_FLOPS = 9, 6  # operations for each pixel in `_ratio_rows` and `_update_rows`


@dataclass(frozen=True)
class Stage:
    """A stage of one step: the bytes that it moves, its floating-point operations, and a function that runs it once."""

    name: str
    bytes: float
    operations: float
    run: Callable[[], object]


def bandwidth() -> float:
    """Bytes per second that all threads together move between memory and cores."""
    parts = [np.zeros((2, COPIED_FLOATS // THREADS), np.float32) for _ in range(THREADS)]
    moved = 2 * sum(part[0].nbytes for part in parts)
    with ThreadPoolExecutor(THREADS) as pool:
        return moved / seconds(lambda: list(pool.map(lambda p: np.copyto(p[1], p[0]), parts)), REPEATS)


def rate() -> float:
    """Floating-point operations per second of all threads, in a product of float32 matrices."""
    matrix = np.random.default_rng(0).random((MATRIX, MATRIX), dtype=np.float32)
    return 2 * MATRIX**3 / seconds(lambda: matrix @ matrix, REPEATS)


def transforms(length: int, count: float) -> float:
    """The operations of complex transforms of one length."""
    return count * 5 * length * math.log2(length)


def stages(iteration: _RichardsonLucy) -> list[Stage]:
    """The stages of a step, in the order in which the step runs them."""
    engine, judged = iteration.engine, iteration.judgement.numbers
    pixels = math.prod(engine.lanes_shape)
    plane, spectrum, transfer = 4.0 * pixels, float(engine._spectrum.nbytes), float(engine.transfer.nbytes)
    columns, ly = engine.column_blocks * LANES, engine.column_plan.length
    multiplied = columns * ly * (2 if engine.symmetric else 6)
    of_columns = 2 * transforms(ly, columns) + multiplied
    # Each complex transform contains two real rows.
    of_rows = 2 * transforms(engine.row_plan.length, engine.row_blocks * LANES)
    return [
        Stage("columns, transfer function", 2 * spectrum + transfer, of_columns,
              lambda: engine.columns(adjoint=False)),
        Stage("rows, ratio", 2 * spectrum + plane, of_rows + RATIO_FLOPS * pixels,
              lambda: engine.row_stage(_ratio_rows, iteration._light_or_agreed, iteration.floor, *judged)),
        Stage("columns, its conjugate", 2 * spectrum + transfer, of_columns,
              lambda: engine.columns(adjoint=True)),
        Stage("rows, update", 2 * spectrum + 2 * plane, of_rows + UPDATE_FLOPS * pixels,
              lambda: engine.row_stage(_update_rows, iteration.x, iteration.dark, True, iteration._moved, iteration._total)),
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=2048)
    size = parser.parse_args().size
    psf = build_psf(load_instrument("hri_euv"), threads=THREADS)
    pixels = np.random.default_rng(0).gamma(2.0, 400.0, (size, size))
    image = Image(pixels, np.zeros(pixels.shape, np.uint8), Header(), "DN/s", 1.0)
    conditions = Conditions(threads=THREADS, engine_for=PreparedPsfs().engine_for)
    method = method_named("richardson-lucy")
    method(image, psf, conditions, steps=1)  # compiles the kernels and prepares the PSF
    f_s, moved, computed = reference(), bandwidth(), rate()
    print(f"1 F = {f_s:.3f} s, {THREADS} threads, image of {size} px")
    print(f"limits: {moved / 1e9:.1f} GB/s, {computed / 1e9:.0f} Gflop/s")
    problem = pose(METHOD, image, psf, conditions, steps=1, stop="fixed")
    found = stages(_RichardsonLucy(problem))
    times = np.array([[seconds(stage.run) for stage in found] for _ in range(REPEATS)]).min(axis=0)
    floors = np.array([max(stage.bytes / moved, stage.operations / computed) for stage in found])
    print(
        f"{'stage of a step':<28} {'ms':>7} {'GB/s':>6} {'Gflop/s':>8} {'floor, ms':>10} {'ms / floor':>11}"
    )
    for stage, took, floor in zip(found, times, floors, strict=True):
        print(
            f"{stage.name:<28} {1e3 * took:7.1f} {stage.bytes / took / 1e9:6.1f} "
            f"{stage.operations / took / 1e9:8.1f} {1e3 * floor:10.1f} {took / floor:11.1f}"
        )
    whole_s = seconds(lambda: method(image, psf, conditions, steps=STEPS), 3)
    print(
        f"{STEPS} steps: {whole_s:.2f} s; their stages {STEPS * times.sum():.2f} s, the floors {STEPS * floors.sum():.2f} s"
    )
    if size == 2048:
        tell("20 steps, 2048 px", whole_s, f_s)


if __name__ == "__main__":
    main()
