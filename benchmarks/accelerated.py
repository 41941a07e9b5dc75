"""Compare the methods: steps and time to the likelihood of 20 steps of plain Richardson-Lucy.

    python -m benchmarks.accelerated [--size 1024] [--markdown]

The image is a simulated scene, convolved with the PSF of an instrument, with photon and read noise. The measure of the
fit is the Poisson likelihood, without the terms that depend on the image alone:

    D = sum over pixels of y log(y / m) - y + m,   m = H x        Eq. (1), the divergence of Csiszar

D is 0 for m = y. It counts the pixels that are not near an edge, so that the treatment of the edges does not matter. For
each method, the smallest number of steps is searched at which D is not above that of plain Richardson-Lucy. A method that
does not maximise the likelihood may fit better and still be a worse estimate: the table also has the rms error
of each result beside the true scene.

Times are processor times of all threads, which other work on the machine changes less than it changes the duration. They
are ratios to 20 plain steps in the same run (shortest of three runs in turn), and to the processor time of 1 F (see
benchmarks/timing.py). The PSF is prepared and the kernels are compiled before.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import scipy.fft
from astropy.io.fits import Header
from numpy.typing import NDArray

import heliopsf
from benchmarks.timing import THREADS
from psfcore.convolution.engine import Engine
from psfcore.deconvolve.conditions import Conditions, PreparedPsfs
from psfcore.deconvolve.methods.registry import method_named, method_names
from psfcore.image import Image
from psfcore.psf import Psf
from psfcore.simulate.observe import observe
from psfcore.simulate.scene import solar_scene

PLAIN, PLAIN_STEPS, MOST_STEPS = "richardson-lucy", 20, 60
BAND_PX = 128
PHOTON_GAIN_DN = 6.0
ROUNDS = 3

Plane = NDArray[np.float64]


@dataclass(frozen=True)
class Way:
    """A method with its parameters, as pairs."""

    method: str
    parameters: tuple[tuple[str, Any], ...] = ()

    @property
    def name(self) -> str:
        """The method and its parameters, as a text."""
        return " ".join([self.method, *(f"{key} {value}" for key, value in self.parameters)])


@dataclass(frozen=True)
class Case:
    """A simulated image [y, x], its true scene and its PSF."""

    image: Image
    scene: Plane
    psf: Psf
    conditions: Conditions

    def run(self, way: Way, steps: int) -> Plane:
        """The estimate of a method after this number of steps."""
        method = method_named(way.method)
        return method(self.image, self.psf, self.conditions, steps=steps, **dict(way.parameters)).pixels

    def divergence(self, estimate: Plane) -> float:
        """D of Eq. (1) for each pixel."""
        engine = Engine(self.psf.kernel, self.scene.shape, threads=THREADS)
        inner = np.s_[BAND_PX:-BAND_PX, BAND_PX:-BAND_PX]
        y = np.maximum(self.image.pixels[inner], 0) / PHOTON_GAIN_DN
        m = np.maximum(engine.apply(estimate).astype(np.float64)[inner], 1e-6) / PHOTON_GAIN_DN
        log = np.log(y / m, out=np.zeros_like(y), where=y > 0)
        return float(np.mean(y * log - y + m))

    def error(self, estimate: Plane) -> float:
        """Rms difference from the true scene, divided by the rms of the scene."""
        inner = np.s_[BAND_PX:-BAND_PX, BAND_PX:-BAND_PX]
        return float(np.sqrt(np.mean((estimate - self.scene)[inner] ** 2) / np.mean(self.scene[inner] ** 2)))


def processor_s(work: Callable[[], object]) -> float:
    """The processor time of all threads of this process, s."""
    started = time.process_time()
    work()
    return time.process_time() - started


def reference_processor_s() -> float:
    """The processor time of 1 F, s."""
    field = np.random.default_rng(0).random((4096, 4096), dtype=np.float32)

    def pair() -> None:
        scipy.fft.irfft2(scipy.fft.rfft2(field, workers=2), s=field.shape, workers=2)

    return min(processor_s(pair) for _ in range(ROUNDS))


def made(instrument: str, size: int) -> Case:
    """A noisy image of a simulated scene, seen with the PSF of an instrument."""
    psf = heliopsf.build_psf(instrument)
    scene = solar_scene((size, size), 1)
    pixels = observe(
        scene, psf, exposure_s=1.0, photon_gain_dn=PHOTON_GAIN_DN, read_noise_dn=2.0, seed=1, threads=THREADS
    )
    image = Image(pixels, np.zeros(pixels.shape, np.uint8), Header(), "DN", 1.0)
    return Case(image, scene, psf, Conditions(threads=THREADS, engine_for=PreparedPsfs().engine_for))


def fewest(case: Case, way: Way, target: float) -> int | None:
    """The smallest number of steps at which D is not above the target; None if MOST_STEPS are not enough."""
    if case.divergence(case.run(way, MOST_STEPS)) > target:
        return None
    low, high = 0, MOST_STEPS
    while high - low > 1:
        middle = (low + high) // 2
        if case.divergence(case.run(way, middle)) <= target:
            high = middle
        else:
            low = middle
    return high


def compared(instrument: str, size: int, f_s: float, *, markdown: bool) -> None:
    """Print the table for a PSF."""
    case, plain = made(instrument, size), Way(PLAIN)
    target = case.divergence(case.run(plain, PLAIN_STEPS))
    ways = [Way(name) for name in method_names()]
    ways.insert(ways.index(Way(f"{PLAIN}-accelerated")) + 1, Way(f"{PLAIN}-accelerated", (("order", 2),)))
    reached = {way: PLAIN_STEPS if way == plain else fewest(case, way, target) for way in ways}
    times: dict[int, list[float]] = {}
    for _ in range(ROUNDS):
        for number, way in enumerate(ways):
            steps = reached[way]
            if steps is not None:
                times.setdefault(number, []).append(processor_s(partial(case.run, way, steps)))
    plain_s = min(times[ways.index(plain)])
    print(f"\nPSF of {instrument}, image of {size} px; D of {PLAIN_STEPS} plain steps: {target:.4f} a pixel")
    heads = ("method", "steps", "time / plain", "time (F)", "rms error")
    print(_row(heads, markdown))
    if markdown:
        print("|---|---|---|---|---|")
    for number, way in enumerate(ways):
        steps = reached[way]
        if steps is None:
            print(_row((way.name, f"> {MOST_STEPS}", "", "", ""), markdown))
            continue
        took = min(times[number])
        error = 100 * case.error(case.run(way, steps))
        cells = (way.name, str(steps), f"{took / plain_s:.2f}", f"{took / f_s:.2f}", f"{error:.2f} %")
        print(_row(cells, markdown), flush=True)


def _row(cells: tuple[str, ...], markdown: bool) -> str:
    if markdown:
        return f"| {' | '.join(cells)} |"
    return f"{cells[0]:<36}" + "".join(f"{cell:>14}" for cell in cells[1:])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--markdown", action="store_true", help="print Markdown, for docs/speed.md")
    asked = parser.parse_args()
    f_s = reference_processor_s()
    print(f"1 F = {f_s:.3f} s of processor time, {THREADS} threads")
    for instrument in ("hri_euv", "aia_171"):
        compared(instrument, asked.size, f_s, markdown=asked.markdown)


if __name__ == "__main__":
    main()
