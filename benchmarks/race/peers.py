"""`make bench-peers`: time Richardson-Lucy steps of heliopsf and of other packages, in turn on the same data.

    python -m benchmarks.race.peers [NAME ...] [--rounds N] [--page FILE]

The image has 2048 x 2048 px, the PSF 4096 x 4096 px; all results are those of the same 20 steps with no light beyond the field.
In every round, each package runs in a process and an environment of its own (`benchmarks.race.environments`). A time contains
everything from the image in memory to the result in memory, also the transform of the PSF. Compiling and planning, which happen
once, are left out: each loop first runs for one step. The result is compared with that of heliopsf before a time is printed.

heliopsf is the package as users call it, so are scikit-image and aiapy. For the other packages, which have FFTs but no
deconvolution, the loop is the simplest one with their FFTs, in single precision with all threads. `benchmarks.race.fft_libraries`
compares FFT libraries in heliopsf's own loop, which transforms fewer rows.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.figures import kind_of_machine
from benchmarks.race.environments import REPOSITORY, python_of
from benchmarks.timing import THREADS, peak_gib, reference, seconds

STEPS, ROUNDS = 20, 5
IMAGE_PX, PSF_PX = 2048, 4096
EDGE_PX = 256  # not compared: scikit-image needs a PSF of odd size, which lacks the outermost row and column
AGREEMENT = 1e-4  # largest deviation from heliopsf, of the brightest pixel: single precision, 40 transforms
FLOOR_OF_MAXIMUM = 2.0**-23
HEADING = "## Beside other packages"
SECTION = """{heading}

`make bench-peers` makes this table: 20 Richardson-Lucy steps of an image of {image} px with a PSF of {psf} px on {machine}. All packages run in turn, {rounds} rounds, each in a
process and an environment of its own. A time is the median of the rounds with its range, from the image in memory to the result in memory; compiling and planning are left out.
1 F was {f}. The deviation is the largest one from the result of heliopsf, relative to the brightest pixel.

| package | time (s) | time (F) | time / time of heliopsf (range) | peak memory (GiB) | deviation |
|---|---|---|---|---|---|
{rows}

aiapy computes in double precision. The memory is that of the whole process.
"""

Array = Any
Loop = Callable[[np.ndarray, np.ndarray, int], np.ndarray]


def heliopsf(image: np.ndarray, psf: np.ndarray, steps: int) -> np.ndarray:
    from astropy.io.fits import Header

    from psfcore.deconvolve.conditions import Conditions
    from psfcore.deconvolve.methods.richardson_lucy import deconvolve
    from psfcore.image import Image
    from psfcore.psf import Psf

    observed = Image(image.astype(float), np.zeros(image.shape, np.uint8), Header(), "DN/s", 1.0)
    kernel = Psf(psf.astype(float), "bench", "1", None, "draft", None, None)
    return deconvolve(observed, kernel, Conditions(edges="zero", threads=THREADS), steps=steps).pixels


def plain_steps(
    padded: Array, transfer: Array, steps: int, forward: Callable[[Array], Array], inverse: Callable[[Array], Array],
    at_least: Callable[[Array, float], Array], start: Array = None,
) -> Array:  # fmt: skip
    """The steps with any FFT. padded: the image on the plane of the PSF. at_least(a, b): the larger of both, by element.
    start: the first estimate; None: the image."""
    estimate, floor = padded if start is None else start, float(padded.max()) * FLOOR_OF_MAXIMUM
    for _ in range(steps):
        ratio = padded / at_least(inverse(forward(estimate) * transfer), floor)
        estimate = estimate * inverse(forward(ratio) * transfer.conj())
    return estimate


def on_plane(image: np.ndarray, psf: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The image on a plane of the shape of the PSF, and the PSF with its centre at [0, 0]; both float32."""
    padded = np.zeros(psf.shape, np.float32)
    padded[: image.shape[0], : image.shape[1]] = image
    return padded, np.fft.ifftshift(psf.astype(np.float32))


def scipy_fft(image: np.ndarray, psf: np.ndarray, steps: int, first: np.ndarray | None = None) -> np.ndarray:
    """first: the first estimate, of the shape of the image."""
    from scipy import fft

    padded, kernel = on_plane(image, psf)
    start = None if first is None else on_plane(first, psf)[0]

    def forward(plane: Array) -> Array:
        return fft.rfft2(plane, workers=THREADS)

    def inverse(spectrum: Array) -> Array:
        return fft.irfft2(spectrum, s=psf.shape, workers=THREADS)

    return np.asarray(plain_steps(padded, forward(kernel), steps, forward, inverse, np.maximum, start))


def pyfftw(image: np.ndarray, psf: np.ndarray, steps: int) -> np.ndarray:
    """FFTW plans by measuring, once for a machine: the plans are kept in the folder of the race."""
    import pyfftw

    wisdom = Path("fftw-wisdom.json")
    if wisdom.is_file():
        pyfftw.import_wisdom([text.encode() for text in json.loads(wisdom.read_text())])
    plane = pyfftw.empty_aligned(psf.shape, np.float32)
    half = pyfftw.empty_aligned((psf.shape[0], psf.shape[1] // 2 + 1), np.complex64)
    plan: dict[str, Any] = {
        "axes": (0, 1),
        "threads": THREADS,
        "flags": ("FFTW_MEASURE", "FFTW_DESTROY_INPUT"),
    }
    to, back = (
        pyfftw.FFTW(plane, half, **plan),
        pyfftw.FFTW(half, plane, **plan, direction="FFTW_BACKWARD"),
    )
    wisdom.write_text(json.dumps([text.decode() for text in pyfftw.export_wisdom()]))
    padded, kernel = on_plane(image, psf)

    def forward(field: Array) -> Array:
        plane[...] = field
        return to()

    transfer = forward(kernel).copy()
    return np.asarray(plain_steps(padded, transfer, steps, forward, lambda s: back(s).copy(), np.maximum))


def ducc0(image: np.ndarray, psf: np.ndarray, steps: int) -> np.ndarray:
    from ducc0 import fft

    padded, kernel = on_plane(image, psf)

    def forward(plane: Array) -> Array:
        return fft.r2c(plane, axes=(0, 1), nthreads=THREADS)

    def inverse(spectrum: Array) -> Array:
        return fft.c2r(spectrum, axes=(0, 1), lastsize=psf.shape[1], forward=False, inorm=2, nthreads=THREADS)

    return np.asarray(plain_steps(padded, forward(kernel), steps, forward, inverse, np.maximum))


def torch(image: np.ndarray, psf: np.ndarray, steps: int) -> np.ndarray:
    import torch

    torch.set_num_threads(THREADS)
    padded, kernel = (torch.from_numpy(plane) for plane in on_plane(image, psf))

    def inverse(spectrum: Array) -> Array:
        return torch.fft.irfft2(spectrum, s=psf.shape)

    with torch.inference_mode():
        done = plain_steps(
            padded, torch.fft.rfft2(kernel), steps, torch.fft.rfft2, inverse, lambda a, b: a.clamp(min=b)
        )
    return np.asarray(done.numpy())


_COMPILED: dict[str, Any] = {}


def jax(image: np.ndarray, psf: np.ndarray, steps: int) -> np.ndarray:
    """The whole loop is compiled."""
    import jax
    import jax.numpy as jnp

    if not _COMPILED:

        def loop(padded: Array, kernel: Array, steps: Array) -> Array:
            transfer, floor = jnp.fft.rfft2(kernel), padded.max() * FLOOR_OF_MAXIMUM

            def step(_: Array, estimate: Array) -> Array:
                model = jnp.fft.irfft2(jnp.fft.rfft2(estimate) * transfer)
                ratio = padded / jnp.maximum(model, floor)
                return estimate * jnp.fft.irfft2(jnp.fft.rfft2(ratio) * transfer.conj())

            return jax.lax.fori_loop(0, steps, step, padded)

        _COMPILED["loop"] = jax.jit(loop)
    return np.asarray(_COMPILED["loop"](*on_plane(image, psf), steps).block_until_ready())


def scikit_image(image: np.ndarray, psf: np.ndarray, steps: int) -> np.ndarray:
    from skimage.restoration import richardson_lucy

    odd = psf[1:, 1:]  # the package expects the centre in the middle of an odd array
    bright = image.max()
    done = richardson_lucy(
        (image / bright).astype(np.float32), odd.astype(np.float32), num_iter=steps, clip=False
    )
    return np.asarray(done * bright)


def aiapy(image: np.ndarray, psf: np.ndarray, steps: int) -> np.ndarray:
    """aiapy continues the image periodically, so the image is padded first."""
    from aiapy.psf import deconvolve

    padded, _ = on_plane(image, psf)
    return np.asarray(deconvolve(aia_map(padded.astype(float)), psf=psf, iterations=steps).data)


def aia_map(pixels: np.ndarray) -> Any:
    """A sunpy Map of these pixels, with the cards that aiapy needs."""
    import astropy.units as u
    import sunpy.map

    header: dict[str, Any] = {
        "ctype1": "HPLN-TAN",
        "ctype2": "HPLT-TAN",
        "cunit1": "arcsec",
        "cunit2": "arcsec",
    }
    header |= {"cdelt1": 0.6, "cdelt2": 0.6, "crpix1": 1, "crpix2": 1, "crval1": 0, "crval2": 0}
    header |= {"telescop": "SDO/AIA", "instrume": "AIA_3", "wavelnth": 171, "waveunit": "angstrom"}
    header |= {"date-obs": "2020-01-01T00:00:00", "hgln_obs": 0, "hglt_obs": 0, "dsun_obs": u.AU.to(u.m)}
    return sunpy.map.Map(pixels, header)


@dataclass(frozen=True)
class Contender:
    """A package of the race. environment: its environment; empty: that of heliopsf. flat_start: it begins with the same
    value in all pixels, so it is compared with SciPy's loop from this start."""

    loop: Loop
    environment: str = ""
    flat_start: bool = False


CONTENDERS: dict[str, Contender] = {
    "heliopsf": Contender(heliopsf),
    "JAX, compiled loop": Contender(jax, "jax"),
    "ducc0": Contender(ducc0, "ducc0"),
    "scipy.fft": Contender(scipy_fft, "scipy"),
    "PyTorch": Contender(torch, "torch"),
    "pyFFTW": Contender(pyfftw, "pyfftw"),
    "scikit-image": Contender(scikit_image, "scikit-image", flat_start=True),
    "aiapy": Contender(aiapy, "aiapy"),
}
FLAT = 0.5  # of the brightest pixel: the start of scikit-image


def data() -> tuple[np.ndarray, np.ndarray]:
    """A textured image, and a PSF with a sharp core and the softened power law of the paper."""
    rng = np.random.default_rng(0)
    y, x = np.indices((PSF_PX, PSF_PX), dtype=np.float32) - PSF_PX // 2
    psf = 0.1525 / (6.15 + np.hypot(x, y)) ** 2.53
    psf[PSF_PX // 2, PSF_PX // 2] = 1 - (psf.sum() - psf[PSF_PX // 2, PSF_PX // 2])
    image = rng.gamma(2.0, 200.0, (IMAGE_PX, IMAGE_PX))
    image[600:620, 900:930] += 20_000
    return image.astype(np.float32), (psf / psf.sum()).astype(np.float32)


def run_one(name: str) -> None:
    """Time one package in this process, with the arrays in the working folder, and save its result there."""
    image, psf = np.load("image.npy"), np.load("psf.npy")
    loop, result = CONTENDERS[name].loop, []
    loop(image, psf, 1)
    took = seconds(lambda: result.append(loop(image, psf, STEPS)))
    np.save("result.npy", result[0][:IMAGE_PX, :IMAGE_PX].astype(np.float32))
    print(json.dumps({"seconds": took, "peak_gib": peak_gib()}))


@dataclass(frozen=True)
class Run:
    """A run of a package: its time, s, its peak memory, GiB, 1 F of the round, s, and its deviation from heliopsf."""

    seconds: float
    peak_gib: float
    f_s: float
    deviation: float


def one_run(name: str, folder: Path, f_s: float) -> Run:
    """Run a package, and compare its result. Raises SystemExit if it deviates by more than AGREEMENT."""
    contender = CONTENDERS[name]
    done = subprocess.run(
        [python_of(contender.environment), "-m", "benchmarks.race.peers", "--one", name],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY), "JAX_PLATFORMS": "cpu"},
    )
    found = json.loads(done.stdout.splitlines()[-1])
    result = np.load(folder / "result.npy")
    if name == "heliopsf":
        np.save(folder / "heliopsf.npy", result)
    expected = np.load(folder / ("flat.npy" if contender.flat_start else "heliopsf.npy"))
    inner = np.s_[EDGE_PX:-EDGE_PX, EDGE_PX:-EDGE_PX]
    apart = float(np.abs(result - expected)[inner].max() / expected.max())
    if not apart <= AGREEMENT:
        raise SystemExit(
            f"peers: expected results within {AGREEMENT:g} of the brightest pixel; {name} deviates by {apart:.1e}"
        )
    return Run(found["seconds"], found["peak_gib"], f_s, apart)


def row(name: str, runs: Sequence[Run], ours: Sequence[Run]) -> str:
    """The row of a package in the table."""
    times = [run.seconds for run in runs]
    in_f = [run.seconds / run.f_s for run in runs]
    ratios = [run.seconds / own.seconds for run, own in zip(runs, ours, strict=True)]
    return (
        f"| {name} | {median(times):.1f} ({min(times):.1f} to {max(times):.1f}) | {median(in_f):.0f} | "
        f"{median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f}) | {max(run.peak_gib for run in runs):.2f} | "
        f"{max(run.deviation for run in runs):.0e} |"
    )


def section(runs: dict[str, list[Run]]) -> str:
    """The section of the page."""
    f_s = [run.f_s for run in runs["heliopsf"]]
    return SECTION.format(
        heading=HEADING,
        image=IMAGE_PX,
        psf=PSF_PX,
        machine=f"{kind_of_machine()}, {time.strftime('%Y-%m-%d')}",
        rounds=len(f_s),
        f=f"{min(f_s):.2f} s to {max(f_s):.2f} s",
        rows="\n".join(row(name, each, runs["heliopsf"]) for name, each in runs.items()),
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="packages besides heliopsf; default: all")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--page", type=Path, help="page whose section of this race is replaced")
    asked = parser.parse_args()
    if unknown := set(asked.names) - set(CONTENDERS):
        parser.error(f"expected names among {', '.join(CONTENDERS)}; got {', '.join(sorted(unknown))}")
    names = ["heliopsf", *(name for name in asked.names or CONTENDERS if name != "heliopsf")]
    runs: dict[str, list[Run]] = {name: [] for name in names}
    with TemporaryDirectory(prefix="heliopsf-peers-") as place:
        folder = Path(place)
        image, psf = data()
        for label, array in (("image", image), ("psf", psf)):
            np.save(folder / f"{label}.npy", array)
        if any(CONTENDERS[name].flat_start for name in names):
            flat = np.full_like(image, FLAT * image.max())
            np.save(folder / "flat.npy", scipy_fft(image, psf, STEPS, flat)[:IMAGE_PX, :IMAGE_PX])
        for number in range(asked.rounds):
            f_s = reference()
            for name in names:
                run = one_run(name, folder, f_s)
                runs[name].append(run)
                ratio = run.seconds / runs["heliopsf"][-1].seconds
                print(
                    f"round {number + 1}: {name:<22}{run.seconds:8.2f} s {run.seconds / f_s:7.1f} F  x {ratio:.2f}",
                    flush=True,
                )
    text = section(runs)
    print(f"\n{text}")
    if asked.page:
        page = asked.page.read_text("utf-8")
        found = re.compile(f"{re.escape(HEADING)}\n.*?(?=\n## |\\Z)", re.DOTALL)
        if not found.search(page):
            raise SystemExit(f"peers: expected a section {HEADING!r} in {asked.page}")
        asked.page.write_text(found.sub(lambda _: text.rstrip() + "\n", page), "utf-8")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        run_one(sys.argv[2])
    else:
        main()
