"""`make bench`: times as ratios to a reference transform of the same run, called 1 F.

1 F is one 4096 x 4096 float32 rfft2 + irfft2 by SciPy with two workers. The machine's other work slows both
alike, so the ratio says more than the seconds.
"""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import scipy.fft

from psfcore.build import build_psf
from psfcore.deconvolve.richardson_lucy import richardson_lucy
from psfcore.fits_io import read_image
from psfcore.header import FitsLimits
from psfcore.instruments.model import load_instrument
from psfcore.plots import preview_png
from psfcore.psf import Psf
from psfcore.simulate.observe import demo_image
from tests.whole import stack as stacks

THREADS = os.cpu_count() or 1


def seconds(work: Callable[[], object], repeats: int = 1) -> float:
    """The shortest of some runs."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def reference() -> float:
    """1 F in seconds."""
    field = np.random.default_rng(0).random((4096, 4096), dtype=np.float32)

    def pair() -> None:
        scipy.fft.irfft2(scipy.fft.rfft2(field, workers=2), s=field.shape, workers=2)

    return seconds(pair, 5)


def row(what: str, took_s: float, f_s: float, note: str = "") -> None:
    peak_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"{what:<52} {took_s:8.2f} s {took_s / f_s:8.1f} F   peak so far {peak_gib:.2f} GiB  {note}")


def http_round_trip(image: Path, psf: Psf, in_process_s: float, f_s: float, folder: Path) -> None:
    """The same deconvolution over HTTP, embedded and with Redis and PostgreSQL; the PSF is built before."""
    for name, mode in (("embedded", stacks.embedded), ("Redis and PostgreSQL", stacks.served)):
        place = folder / name.split()[0]
        place.mkdir()
        with ExitStack() as resources:
            try:
                stack = resources.enter_context(mode(place))
            except stacks.Missing as missing:
                print(f"left out: {missing}")
                continue
            stack.client.build_psf("hri_euv")
            # Another step count, so that the worker has its kernels loaded and the product is not there yet.
            stack.client.deconvolve(image, steps=1)
            took = seconds(lambda: stack.client.deconvolve(image, place / "out.fits"))  # noqa: B023
            again = seconds(lambda: stack.client.deconvolve(image, place / "out.fits"))  # noqa: B023
        row(f"HTTP round trip, {name}", took, f_s, f"over the psfcore call: {took - in_process_s:+.2f} s")
        row(f"  an equal request again, {name}", again, f_s)


def main() -> None:
    f_s = reference()
    print(f"1 F = {f_s:.3f} s, {THREADS} threads")
    built: list[Psf] = []
    row(
        "PSF of hri_euv, 2048 px",
        seconds(lambda: built.append(build_psf(load_instrument("hri_euv"), threads=THREADS))),
        f_s,
    )
    psf = built[0]
    with TemporaryDirectory(prefix="heliopsf-bench-") as name:
        folder = Path(name)
        path = folder / "image.fits"
        demo_image(path, psf, size=2048)
        image = read_image(path, FitsLimits(max_pixels=2**24))
        richardson_lucy(image, psf, steps=1, threads=THREADS)
        results = []
        core_s = seconds(lambda: results.append(richardson_lucy(image, psf, threads=THREADS)))
        row("Richardson-Lucy, 2048 px image, 2048 px PSF, 20 steps", core_s, f_s)
        picture_s = seconds(
            lambda: preview_png(image.pixels, results[0].pixels, folder / "p.png", title="bench")
        )
        row("preview, 2048 px", picture_s, f_s)
        http_round_trip(path, psf, core_s, f_s, folder)


if __name__ == "__main__":
    main()
