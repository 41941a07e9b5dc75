"""Compare methods of deconvolution on simulated images: along edges, for a box alone, and by the steps that they need.

    python -m studies.methods edges [SEED ...]
    python -m studies.methods regions [--size 1024]
    python -m studies.methods steps [--size 1024] [--markdown]

edges: a scene of 2048 px is convolved with a PSF, noise is added, and the whole image is deconvolved. The middle of the result
is the reference without edges. The same pixels of the image are cut out and deconvolved alone. Both results are compared in bands
along the edges of the cut-out; the bias is the relative error of the mean of a band, the deviation the mean relative error of its
pixels:

    bias = sum(x) / sum(x_ref) - 1,    deviation = sum(abs(x - x_ref)) / sum(x_ref),    in percent     Eq. (1)

regions: boxes in a bright region, in quiet Sun, in a coronal hole and at an edge are deconvolved alone, for several allowed
errors, and compared with the same boxes of the whole deconvolved image: the width of the rim, the pixels of box and rim as a share of
the image, the bound, and the differences. All light is in percent of the mean light of the box.

steps: the steps and the time that each method needs to the likelihood of 20 steps of plain Richardson-Lucy. The measure of the
fit is the Poisson likelihood, without the terms that depend on the image alone:

    D = sum over pixels of y log(y / m) - y + m,   m = H x        Eq. (2), the divergence of Csiszar

D is 0 for m = y. It counts the pixels that are not near an edge, so that the treatment of the edges does not matter. A method that
does not maximise the likelihood may fit better and still be a worse estimate: the table also has the rms error of each result beside
the true scene. Times are processor times of all threads, which other work on the machine changes less than it changes the duration.
They are ratios to 20 plain steps in the same run (shortest of three runs in turn), and to the processor time of 1 F (see
benchmarks/timing.py). The PSF is prepared and the kernels are compiled before. --markdown prints the tables of docs/speed.md.
"""

from __future__ import annotations

import argparse
import time
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

import heliopsf
from benchmarks.timing import THREADS, reference, seconds
from psfcore.convolution.convolver import linear_convolve
from psfcore.convolution.engine import Engine
from psfcore.deconvolve.conditions import Conditions, EngineFor, PreparedPsfs
from psfcore.deconvolve.edges import EDGES
from psfcore.deconvolve.extent import Box
from psfcore.deconvolve.methods.registry import method_named, method_names
from psfcore.deconvolve.work import Options, Work, box_work
from psfcore.image import Image
from psfcore.psf import Psf
from psfcore.scatter.power_law import scatter_kernel
from psfcore.simulate.scene import observe, solar_scene

Plane = NDArray[np.float64]
INSTRUMENTS = ("hri_euv", "aia_171")

# Edges.
FIELD_PX, SCENE_PX = 1024, 2048
BANDS_PX = ((0, 2), (2, 20), (20, 64))
SEEDS = (1, 2, 3)
_CORE_SIGMA_PX = 0.45
_DISTANCE_PX = np.minimum.outer(*(2 * (np.minimum(np.arange(FIELD_PX), np.arange(FIELD_PX)[::-1]),)))
# Regions.
_ERRORS = (0.5, 0.2, 0.05, 0.02)
_OF_REGIONS = ("richardson-lucy", "richardson-lucy-accelerated", "linear")
# Steps.
_PLAIN, _PLAIN_STEPS, _MOST_STEPS, _ROUNDS = "richardson-lucy", 20, 60, 3
_INNER = np.s_[128:-128, 128:-128]
_PHOTON_GAIN_DN = 6.0
Way = tuple[str, dict[str, Any]]  # a method and its parameters


def image_of(pixels: Plane, unit: str = "DN", exposure_s: float = 1.0) -> Image:
    """An image without masked pixels."""
    return Image(pixels, np.zeros(pixels.shape, np.uint8), Header(), unit, exposure_s)


@dataclass(frozen=True)
class Row:
    """Eq. (1) for one method, treatment of edges and seed, in each of BANDS_PX, percent."""

    method: str
    edges: str
    seed: int
    bias_pct: tuple[float, ...]
    deviation_pct: tuple[float, ...]


def study_psf() -> Psf:
    """The diffuse scatter of the paper on its full reach, convolved with a small core."""
    line = np.exp(-((np.arange(17) - 8) ** 2) / (2 * _CORE_SIGMA_PX**2))
    core = np.outer(line, line) / line.sum() ** 2
    kernel = linear_convolve(scatter_kernel(6.15, 2.53, 0.411, 2048), core, (2048, 2048))
    return Psf(kernel=np.maximum(kernel, 0), name="edge study", version="1", instrument=None, status="draft")


def edge_rows(
    seed: int, psf: Psf, cache: EngineFor, *, methods: Sequence[str], ways: Sequence[str | None]
) -> Iterator[Row]:
    """One row for every method and every treatment of edges, on one scene. None: the default treatment of the method."""
    scene = solar_scene((SCENE_PX, SCENE_PX), seed)
    noise = {"photon_gain_dn": 6.0, "read_noise_dn": 2.0}
    whole = observe(scene, psf, exposure_s=1.4, **noise, seed=seed, threads=2)
    first = (SCENE_PX - FIELD_PX) // 2
    middle = (slice(first, first + FIELD_PX),) * 2
    conditions = Conditions(threads=2, engine_for=cache)
    for name in methods:
        deconvolve = method_named(name)
        # The middle of the scene is far from its edges; outside, the scene is zero.
        beyond: Any = "extended" if name == "richardson-lucy-extended" else "zero"
        of_whole = replace(conditions, edges=beyond, margin_px=0)
        x_ref = deconvolve(image_of(whole, "DN/s", 1.4), psf, of_whole).pixels[middle]
        for way in ways:
            found = deconvolve(image_of(whole[middle], "DN/s", 1.4), psf, replace(conditions, edges=way))
            bias, deviation = [], []
            for near, far in BANDS_PX:
                band = (near <= _DISTANCE_PX) & (far > _DISTANCE_PX)
                total = x_ref[band].sum()
                bias.append(100 * (found.pixels[band].sum() / total - 1))  # Eq. (1)
                deviation.append(100 * np.abs(found.pixels - x_ref)[band].sum() / total)
            yield Row(name, found.edges, seed, tuple(bias), tuple(deviation))


def print_edges(seeds: Sequence[int]) -> None:
    """Print the table of `edges`."""
    psf, cache = study_psf(), PreparedPsfs().engine_for
    print(
        f"{'method':<30}{'edges':<12}{'seed':>5}   bias, % (0-2, 2-20, 20-64 px from the edge)    deviation, %"
    )
    for seed in seeds:
        for row in edge_rows(seed, psf, cache, methods=method_names(), ways=EDGES):
            figures = [" ".join(f"{v:8.2f}" for v in part) for part in (row.bias_pct, row.deviation_pct)]
            print(f"{row.method:<30}{row.edges:<12}{row.seed:>5}   {figures[0]}   {figures[1]}", flush=True)


def boxes(image: Image) -> dict[str, Box]:
    """Boxes of a sixteenth of the image's width: where it is brightest, darkest and of median light, and at an edge."""
    size = image.pixels.shape[0]
    side, edge = size // 16, size // 5
    light = uniform_filter(image.pixels, side)[edge:-edge, edge:-edge]
    usual = np.abs(light - np.median(light))
    places = {"bright": np.argmax(light), "quiet": np.argmin(usual), "dark": np.argmin(light)}
    found = {}
    for name, place in places.items():
        y, x = (int(n) + edge - side // 2 for n in np.unravel_index(place, light.shape))
        found[name] = Box(x, x + side, y, y + side)
    return found | {"edge": Box(0, side, size // 2, size // 2 + side)}


def print_regions(instrument: str, size: int) -> None:
    """Print the rim, the bound and the differences of each box, for the PSF of an instrument."""
    psf, scene = heliopsf.build_psf(instrument), solar_scene((size, size), 1)
    image = image_of(observe(scene, psf, exposure_s=1, photon_gain_dn=2, read_noise_dn=2, seed=1))
    for method in _OF_REGIONS:
        options = Options(method=method, threads=THREADS, engine_for=PreparedPsfs().engine_for)
        whole = Work(image, psf, options).run().pixels
        for name, box in boxes(image).items():
            what, mean = f"{instrument} {method} {name}", image.pixels[box.slices].mean() / 100
            for error in _ERRORS:
                alone = box_work(Work(image, psf, replace(options, region_error=error)), box)
                if alone.error == 0:
                    print(f"{what:<46} for {100 * error:g} %: whole image")
                    break
                difference = alone.run().pixels - whole[box.slices]
                largest, rms = np.abs(difference).max(), np.sqrt(np.mean(difference**2))
                share = np.prod(alone.rim.shape) / image.pixels.size
                told = f"{alone.error / mean:8.2f}%{largest / mean:8.2f}%{rms / mean:7.2f}%{alone.error / largest:17.1f}"
                print(f"{what:<46}{alone.rim_px:6d}{share:7.2f}{told}", flush=True)


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
        """D of Eq. (2) for each pixel."""
        engine = Engine(self.psf.kernel, self.scene.shape, threads=THREADS)
        y = np.maximum(self.image.pixels[_INNER], 0) / _PHOTON_GAIN_DN
        m = np.maximum(engine.apply(estimate).astype(np.float64)[_INNER], 1e-6) / _PHOTON_GAIN_DN
        log = np.log(y / m, out=np.zeros_like(y), where=y > 0)
        return float(np.mean(y * log - y + m))

    def error(self, estimate: Plane) -> float:
        """Rms difference from the true scene, divided by the rms of the scene."""
        difference, scene = (estimate - self.scene)[_INNER], self.scene[_INNER]
        return float(np.sqrt(np.mean(difference**2) / np.mean(scene**2)))

    def fewest(self, way: Way, target: float) -> int | None:
        """The smallest number of steps at which D is not above the target; None if _MOST_STEPS are not enough."""
        numbers = range(1, _MOST_STEPS + 1)
        at = bisect_left(numbers, True, key=lambda steps: self.divergence(self.run(way, steps)) <= target)
        return numbers[at] if at < len(numbers) else None


def print_steps(instrument: str, size: int, f_s: float, *, markdown: bool) -> None:
    """Print the table of `steps` for the PSF of an instrument."""
    psf, scene = heliopsf.build_psf(instrument), solar_scene((size, size), 1)
    noise = {"photon_gain_dn": _PHOTON_GAIN_DN, "read_noise_dn": 2.0}
    image = image_of(observe(scene, psf, exposure_s=1.0, **noise, seed=1, threads=THREADS))
    case = Case(image, scene, psf, Conditions(threads=THREADS, engine_for=PreparedPsfs().engine_for))
    plain: Way = (_PLAIN, {})
    target = case.divergence(case.run(plain, _PLAIN_STEPS))
    ways: list[Way] = [(name, {}) for name in method_names()]
    ways.insert(ways.index((f"{_PLAIN}-accelerated", {})) + 1, (f"{_PLAIN}-accelerated", {"order": 2}))
    reached = [_PLAIN_STEPS if way == plain else case.fewest(way, target) for way in ways]
    runs = {n: partial(case.run, ways[n], steps) for n, steps in enumerate(reached) if steps is not None}
    rounds = [{n: seconds(run, clock=time.process_time) for n, run in runs.items()} for _ in range(_ROUNDS)]
    times = {n: min(one[n] for one in rounds) for n in runs}
    plain_s = times[ways.index(plain)]
    print(f"\nPSF of {instrument}, image of {size} px; D of {_PLAIN_STEPS} plain steps: {target:.4f} a pixel")
    table = [("method", "steps", "time / plain", "time (F)", "rms error")]
    for n, (name, parameters) in enumerate(ways):
        label = " ".join([name, *(f"{key} {value}" for key, value in parameters.items())])
        if n not in runs:
            table.append((label, f"> {_MOST_STEPS}", "", "", ""))
            continue
        ratios = (f"{times[n] / plain_s:.2f}", f"{times[n] / f_s:.2f}")
        table.append((label, f"{reached[n]}", *ratios, f"{100 * case.error(runs[n]()):.2f} %"))
    for cells in table:
        plain_text = f"{cells[0]:<36}" + "".join(f"{cell:>14}" for cell in cells[1:])
        print(f"| {' | '.join(cells)} |" if markdown else plain_text)
        if markdown and cells is table[0]:
            print("|---|---|---|---|---|")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("study", choices=("edges", "regions", "steps"))
    parser.add_argument("seeds", nargs="*", type=int, metavar="SEED")
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--markdown", action="store_true")
    chosen = parser.parse_args()
    if chosen.study == "edges":
        print_edges(chosen.seeds or SEEDS)
    elif chosen.study == "regions":
        print(f"{'':<46}{'rim':>6}{'share':>7}{'bound':>9}{'largest':>9}{'rms':>8}{'bound / largest':>17}")
        for instrument in INSTRUMENTS:
            print_regions(instrument, chosen.size)
    else:
        f_s = reference(time.process_time)
        print(f"1 F = {f_s:.3f} s of processor time, {THREADS} threads")
        for instrument in INSTRUMENTS:
            print_steps(instrument, chosen.size, f_s, markdown=chosen.markdown)


if __name__ == "__main__":
    main()
