"""Steps and time that each method needs to the likelihood of 20 steps of plain Richardson-Lucy.

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
benchmarks/timing.py). The PSF is prepared and the kernels are compiled before. --markdown prints the tables of docs/speed.md.
"""

from __future__ import annotations

import argparse
import time
from bisect import bisect_left
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray

import heliopsf
from benchmarks.timing import THREADS, reference, seconds
from psfcore.convolution.engine import Engine
from psfcore.deconvolve.conditions import Conditions, PreparedPsfs
from psfcore.deconvolve.methods.registry import method_named, method_names
from psfcore.image import Image
from psfcore.psf import Psf
from psfcore.simulate.scene import observe, solar_scene

PLAIN, PLAIN_STEPS, MOST_STEPS = "richardson-lucy", 20, 60
INNER = np.s_[128:-128, 128:-128]
PHOTON_GAIN_DN = 6.0
ROUNDS = 3

Plane = NDArray[np.float64]
Way = tuple[str, dict[str, Any]]  # a method and its parameters


@dataclass(frozen=True)
class Case:
    """A simulated image [y, x], its true scene and its PSF."""

    image: Image
    scene: Plane
    psf: Psf
    conditions: Conditions

    def run(self, way: Way, steps: int) -> Plane:
        """The estimate of a method after this number of steps."""
        name, parameters = way
        return method_named(name)(self.image, self.psf, self.conditions, steps=steps, **parameters).pixels

    def divergence(self, estimate: Plane) -> float:
        """D of Eq. (1) for each pixel."""
        engine = Engine(self.psf.kernel, self.scene.shape, threads=THREADS)
        y = np.maximum(self.image.pixels[INNER], 0) / PHOTON_GAIN_DN
        m = np.maximum(engine.apply(estimate).astype(np.float64)[INNER], 1e-6) / PHOTON_GAIN_DN
        log = np.log(y / m, out=np.zeros_like(y), where=y > 0)
        return float(np.mean(y * log - y + m))

    def error(self, estimate: Plane) -> float:
        """Rms difference from the true scene, divided by the rms of the scene."""
        return float(np.sqrt(np.mean((estimate - self.scene)[INNER] ** 2) / np.mean(self.scene[INNER] ** 2)))

    def fewest(self, way: Way, target: float) -> int | None:
        """The smallest number of steps at which D is not above the target; None if MOST_STEPS are not enough."""
        numbers = range(1, MOST_STEPS + 1)
        at = bisect_left(numbers, True, key=lambda steps: self.divergence(self.run(way, steps)) <= target)
        return numbers[at] if at < len(numbers) else None


def simulated(instrument: str, size: int) -> Case:
    """A noisy image of a simulated scene, seen with the PSF of an instrument."""
    psf = heliopsf.build_psf(instrument)
    scene = solar_scene((size, size), 1)
    noise = {"photon_gain_dn": PHOTON_GAIN_DN, "read_noise_dn": 2.0}
    pixels = observe(scene, psf, exposure_s=1.0, **noise, seed=1, threads=THREADS)
    image = Image(pixels, np.zeros(pixels.shape, np.uint8), Header(), "DN", 1.0)
    return Case(image, scene, psf, Conditions(threads=THREADS, engine_for=PreparedPsfs().engine_for))


def compare(instrument: str, size: int, f_s: float, *, markdown: bool) -> None:
    """Print the table for a PSF."""
    case, plain = simulated(instrument, size), (PLAIN, {})
    target = case.divergence(case.run(plain, PLAIN_STEPS))
    ways: list[Way] = [(name, {}) for name in method_names()]
    ways.insert(ways.index((f"{PLAIN}-accelerated", {})) + 1, (f"{PLAIN}-accelerated", {"order": 2}))
    reached = [PLAIN_STEPS if way == plain else case.fewest(way, target) for way in ways]
    runs = {
        number: partial(case.run, way, steps)
        for number, (way, steps) in enumerate(zip(ways, reached, strict=True))
        if steps is not None
    }
    rounds = [
        {number: seconds(run, clock=time.process_time) for number, run in runs.items()} for _ in range(ROUNDS)
    ]
    times = {number: min(one[number] for one in rounds) for number in runs}
    plain_s = times[ways.index(plain)]
    print(f"\nPSF of {instrument}, image of {size} px; D of {PLAIN_STEPS} plain steps: {target:.4f} a pixel")
    print(row(("method", "steps", "time / plain", "time (F)", "rms error"), markdown))
    if markdown:
        print("|---|---|---|---|---|")
    for number, (name, parameters) in enumerate(ways):
        label = " ".join([name, *(f"{key} {value}" for key, value in parameters.items())])
        cells = (label, f"> {MOST_STEPS}", "", "", "")
        if number in runs:
            took, error = times[number], 100 * case.error(runs[number]())
            cells = (
                label,
                f"{reached[number]}",
                f"{took / plain_s:.2f}",
                f"{took / f_s:.2f}",
                f"{error:.2f} %",
            )
        print(row(cells, markdown), flush=True)


def row(cells: tuple[str, ...], markdown: bool) -> str:
    """A row of the table."""
    if markdown:
        return f"| {' | '.join(cells)} |"
    return f"{cells[0]:<36}" + "".join(f"{cell:>14}" for cell in cells[1:])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--markdown", action="store_true")
    chosen = parser.parse_args()
    f_s = reference(time.process_time)
    print(f"1 F = {f_s:.3f} s of processor time, {THREADS} threads")
    for instrument in ("hri_euv", "aia_171"):
        compare(instrument, chosen.size, f_s, markdown=chosen.markdown)


if __name__ == "__main__":
    main()
