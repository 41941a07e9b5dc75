"""Measure one deconvolution or one fit in this process, which does nothing else: its time and its peak memory."""

from __future__ import annotations

import gc
import json
import math
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import heliopsf
from benchmarks.timing import THREADS, memory_bytes, seconds
from psfcore.deconvolve.memory import Demand, deconvolution_bytes
from psfcore.psf import central_part
from psfcore.scatter.fit import fit_transit
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from studies.transits import diffraction, drawn_truth


def deconvolution(case: dict[str, Any]) -> dict[str, Any]:
    """The time of a deconvolution (shortest of `repeats`), and its peak memory besides the image and the PSF, in bytes.

    The kernels are compiled before. output_bytes: the part of the peak that is the result. padded_px: pixels of the
    transforms. estimate_bytes: the estimate of the peak. process_bytes: the peak
    of the whole process, with Python, its libraries, the image and the PSF.
    """
    method, steps, size = case.get("method", "richardson-lucy"), case.get("steps", 20), case["size"]
    psf = heliopsf.build_psf("hri_euv")
    if "psf" in case:
        psf = heliopsf.Psf.of(central_part(psf, case["psf"]))
    asked = Demand(method, (size, size), (psf.kernel.shape[0], psf.kernel.shape[1]))
    pixels = np.random.default_rng(0).gamma(2.0, 400.0, (size, size))

    def deconvolve(part: Any, iterations: int) -> Any:
        return heliopsf.deconvolve(part, psf, iterations=iterations, method=method, threads=THREADS)

    deconvolve(pixels[:256, :256].copy(), 2)
    gc.collect()
    before = memory_bytes("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    took = [seconds(lambda: deconvolve(pixels, steps))]
    highest = memory_bytes("VmHWM")
    peak = highest - before
    took += [seconds(lambda: deconvolve(pixels, steps)) for _ in range(case.get("repeats", 1) - 1)]
    given = 8 * (pixels.size + psf.kernel.size)
    return {
        "seconds": min(took),
        "peak_bytes": peak,
        "process_bytes": highest,
        "output_bytes": 8 * pixels.size,
        "padded_px": math.prod(asked.transform),
        "estimate_bytes": round(deconvolution_bytes(asked) - given),
    }


def fit(case: dict[str, Any]) -> dict[str, Any]:
    """The time of a fit to a simulated transit, and its peak memory besides the images, in bytes."""
    size, truth = case["size"], drawn_truth(1)
    fit_transit(simulate(default_plan(9, 128), truth, diffraction(256), 1).transit)  # compiles
    transit = simulate(
        default_plan(case["images"], size), truth, diffraction(2 * size), 1, threads=THREADS
    ).transit
    gc.collect()
    before = memory_bytes("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")
    took = seconds(lambda: fit_transit(transit, threads=THREADS))
    return {"seconds": took, "peak_bytes": memory_bytes("VmHWM") - before}


if __name__ == "__main__":
    warnings.simplefilter("ignore")  # these images have no header
    asked = json.loads(sys.argv[1])
    print(json.dumps(fit(asked) if "images" in asked else deconvolution(asked)))
