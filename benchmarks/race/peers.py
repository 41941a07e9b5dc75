"""Richardson-Lucy steps of heliopsf beside other packages; part of `make bench-peers`.

    python -m benchmarks.race.peers [NAME ...] [--whole] [--rounds N] [--page FILE]

All packages run in turn, each in a process and an environment of its own: `.venv-peers/NAME`, made if it is missing,
with the numpy, scipy and astropy of constraints.txt. HELIOPSF_PEERS_PYTHON names another Python for them, which new
packages may need. A time contains everything from the image in memory to the result in memory; each loop first runs for
one step, so that compiling and planning are left out. The results are compared before a time is printed.

By default the image has 2048 px and the PSF 4096 px, so that every package convolves linearly: zeros surround the
image. Packages with a deconvolution run their own: heliopsf, scikit-image and aiapy. For the others, which have FFTs
but no deconvolution, the loop is the simplest one with their FFTs, in single precision with all threads. --whole: an
image of the whole Sun of 4096 px with a PSF of this size, for heliopsf and for the loop of aiapy in NumPy and in JAX.
aiapy then continues the image periodically, so that light scattered beyond an edge comes back at the opposite one; the
inner 1600 px, where this light hardly matters, are compared.
"""

from __future__ import annotations

import argparse
import json
import os
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
from benchmarks.timing import THREADS, answer_of, peak_gib, reference, seconds

REPOSITORY = Path(__file__).parents[2]
STEPS, ROUNDS = 20, 5
FLOOR_OF_MAXIMUM = 2.0**-23
FLAT = 0.5  # of the brightest pixel: the start of scikit-image
HEAD = (
    "| package | time (s) | time (F) | time / time of heliopsf (range) | peak memory (GiB) | deviation "
    "|\n|---|---|---|---|---|---|"
)

Array = Any
Loop = Callable[[np.ndarray, np.ndarray, int], np.ndarray]


def python_of(requirement: str) -> str:
    """The interpreter of the environment with this package, made if it is missing; that of this process for no package.

    Raises subprocess.CalledProcessError if pip fails.
    """
    if not requirement:
        return sys.executable
    folder = REPOSITORY / ".venv-peers" / requirement.partition("=")[0].rstrip(">")
    python, done = folder / "bin" / "python", folder / ".installed"
    base = os.environ.get("HELIOPSF_PEERS_PYTHON", sys.executable)
    packages = ["numpy", "scipy", "astropy", requirement]
    content = " ".join([base, *packages])
    if not done.is_file() or done.read_text("utf-8") != content:
        subprocess.run([base, "-m", "venv", "--clear", str(folder)], check=True)
        pip = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        constraints = ["-c", str(REPOSITORY / "constraints.txt")]
        subprocess.run([*pip, *constraints, *packages], check=True)
        done.write_text(content, "utf-8")
    return str(python)


def heliopsf(image: np.ndarray, psf: np.ndarray, steps: int) -> np.ndarray:
    from astropy.io.fits import Header

    from psfcore.deconvolve.conditions import Conditions
    from psfcore.deconvolve.methods.registry import method_named
    from psfcore.image import Image
    from psfcore.psf import Psf

    observed = Image(image.astype(float), np.zeros(image.shape, np.uint8), Header(), "DN/s", 1.0)
    kernel = Psf(psf.astype(float), "bench", "1", None, "draft", None, None)
    conditions = Conditions(edges="zero", threads=THREADS)
    return method_named("richardson-lucy")(observed, kernel, conditions, steps=steps).pixels


def plain_steps(
    padded: Array, transfer: Array, steps: int, forward: Callable[[Array], Array], inverse: Callable[[Array], Array],
    at_least: Callable[[Array, float], Array] = np.maximum, start: Array = None,
) -> Array:  # fmt: skip
    """The steps with any FFT. padded: the image on the plane of the PSF. at_least(a, b): the larger of both, by
    element. start: the first estimate; None: the image."""
    estimate, floor = padded if start is None else start, float(padded.max()) * FLOOR_OF_MAXIMUM
    for _ in range(steps):
        ratio = padded / at_least(inverse(forward(estimate) * transfer), floor)
        estimate = estimate * inverse(forward(ratio) * transfer.conj())
    return estimate


def on_plane(image: np.ndarray, psf: np.ndarray, kind: type = np.float32) -> tuple[np.ndarray, np.ndarray]:
    """The image on a plane of the shape of the PSF, and the PSF with its centre at [0, 0]."""
    padded = np.zeros(psf.shape, kind)
    padded[: image.shape[0], : image.shape[1]] = image
    return padded, np.fft.ifftshift(psf.astype(kind))


def scipy_fft(image: np.ndarray, psf: np.ndarray, steps: int, first: np.ndarray | None = None) -> np.ndarray:
    """first: the first estimate, of the shape of the image."""
    from scipy import fft

    padded, kernel = on_plane(image, psf)
    start = None if first is None else on_plane(first, psf)[0]

    def forward(plane: Array) -> Array:
        return fft.rfft2(plane, workers=THREADS)

    def inverse(spectrum: Array) -> Array:
        return fft.irfft2(spectrum, s=psf.shape, workers=THREADS)

    return np.asarray(plain_steps(padded, forward(kernel), steps, forward, inverse, start=start))


def pyfftw(image: np.ndarray, psf: np.ndarray, steps: int) -> np.ndarray:
    """FFTW plans by measuring, once for a machine: the plans are kept in the folder of the race."""
    import pyfftw

    wisdom = Path("fftw-wisdom.json")
    if wisdom.is_file():
        pyfftw.import_wisdom([text.encode() for text in json.loads(wisdom.read_text())])
    plane = pyfftw.empty_aligned(psf.shape, np.float32)
    half = pyfftw.empty_aligned((psf.shape[0], psf.shape[1] // 2 + 1), np.complex64)
    plan: dict[str, Any] = {"axes": (0, 1), "threads": THREADS}
    plan["flags"] = ("FFTW_MEASURE", "FFTW_DESTROY_INPUT")
    to = pyfftw.FFTW(plane, half, **plan)
    back = pyfftw.FFTW(half, plane, **plan, direction="FFTW_BACKWARD")
    wisdom.write_text(json.dumps([text.decode() for text in pyfftw.export_wisdom()]))
    padded, kernel = on_plane(image, psf)

    def forward(field: Array) -> Array:
        plane[...] = field
        return to()

    transfer = forward(kernel).copy()
    return np.asarray(plain_steps(padded, transfer, steps, forward, lambda s: back(s).copy()))


def ducc0(image: np.ndarray, psf: np.ndarray, steps: int) -> np.ndarray:
    from ducc0 import fft

    padded, kernel = on_plane(image, psf)

    def forward(plane: Array) -> Array:
        return fft.r2c(plane, axes=(0, 1), nthreads=THREADS)

    def inverse(spectrum: Array) -> Array:
        return fft.c2r(spectrum, axes=(0, 1), lastsize=psf.shape[1], forward=False, inorm=2, nthreads=THREADS)

    return np.asarray(plain_steps(padded, forward(kernel), steps, forward, inverse))


def torch(image: np.ndarray, psf: np.ndarray, steps: int) -> np.ndarray:
    import torch

    torch.set_num_threads(THREADS)
    padded, kernel = (torch.from_numpy(plane) for plane in on_plane(image, psf))
    transfer, forward = torch.fft.rfft2(kernel), torch.fft.rfft2

    def inverse(spectrum: Array) -> Array:
        return torch.fft.irfft2(spectrum, s=psf.shape)

    with torch.inference_mode():
        done = plain_steps(padded, transfer, steps, forward, inverse, lambda a, b: a.clamp(min=b))
    return np.asarray(done.numpy())


_COMPILED: dict[str, Any] = {}


def jax(image: np.ndarray, psf: np.ndarray, steps: int) -> np.ndarray:
    """The whole loop is compiled. The precision is that of JAX_ENABLE_X64."""
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
    planes = on_plane(image, psf, np.float64 if jax.config.jax_enable_x64 else np.float32)
    return np.asarray(_COMPILED["loop"](*planes, steps).block_until_ready())


def scikit_image(image: np.ndarray, psf: np.ndarray, steps: int) -> np.ndarray:
    """The package expects the centre of the PSF in the middle of an odd array."""
    from skimage.restoration import richardson_lucy

    bright = image.max()
    planes = [plane.astype(np.float32) for plane in (image / bright, psf[1:, 1:])]
    return np.asarray(richardson_lucy(*planes, num_iter=steps, clip=False) * bright)


def aiapy(image: np.ndarray, psf: np.ndarray, steps: int) -> np.ndarray:
    """aiapy continues the image periodically, so the image is padded first."""
    from aiapy.psf import deconvolve

    padded, _ = on_plane(image, psf)
    return np.asarray(deconvolve(aia_map(padded.astype(float)), psf=psf, iterations=steps).data)


def aia_map(pixels: np.ndarray) -> Any:
    """A sunpy Map of these pixels, with the cards that aiapy needs."""
    import astropy.units as u
    import sunpy.map

    header: dict[str, Any] = {f"ctype{n}": f"HP{name}-TAN" for n, name in ((1, "LN"), (2, "LT"))}
    header |= {"cunit1": "arcsec", "cunit2": "arcsec", "cdelt1": 0.6, "cdelt2": 0.6}
    header |= {"crpix1": 1, "crpix2": 1, "crval1": 0, "crval2": 0}
    header |= {"telescop": "SDO/AIA", "instrume": "AIA_3", "wavelnth": 171, "waveunit": "angstrom"}
    header |= {"date-obs": "2020-01-01T00:00:00", "hgln_obs": 0, "hglt_obs": 0, "dsun_obs": u.AU.to(u.m)}
    return sunpy.map.Map(pixels, header)


@dataclass(frozen=True)
class Contender:
    """A package of the race. requirement: what pip installs into its environment; empty: the environment of heliopsf.
    flat_start: it begins with the same value in all pixels, so it is compared with SciPy's loop from this start.
    double: in double precision."""

    loop: Loop
    requirement: str = ""
    flat_start: bool = False
    double: bool = False


CONTENDERS: dict[str, Contender] = {
    "heliopsf": Contender(heliopsf),
    "JAX, compiled loop": Contender(jax, "jax>=0.4"),
    "ducc0": Contender(ducc0, "ducc0>=0.37"),
    "scipy.fft": Contender(scipy_fft, "scipy"),
    # PyTorch is pinned because a new release would be a download of gigabytes; any version works.
    "PyTorch": Contender(torch, "torch==2.13.0"),
    "pyFFTW": Contender(pyfftw, "pyfftw>=0.14"),
    "scikit-image": Contender(scikit_image, "scikit-image>=0.24", flat_start=True),
    "aiapy": Contender(aiapy, "aiapy>=0.9"),
}
WHOLE = {
    "heliopsf": CONTENDERS["heliopsf"],
    "aiapy": CONTENDERS["aiapy"],
    "the loop of aiapy in JAX, single precision": Contender(jax, "jax>=0.4"),
    "the loop of aiapy in JAX, double precision": Contender(jax, "jax>=0.4", double=True),
}


@dataclass(frozen=True)
class Race:
    """The sizes of image and PSF, px; the contenders; the pixels that are compared; the largest deviation allowed, of
    the brightest pixel, from heliopsf: single precision, and for the whole Sun the light across the edges. instrument:
    the one whose PSF is used; None: the PSF of an equation."""

    image_px: int
    psf_px: int
    contenders: dict[str, Contender]
    edge_px: int
    agreement: float
    instrument: str | None = None

    def data(self) -> tuple[np.ndarray, np.ndarray]:
        """A textured image, and a PSF with a sharp core and the softened power law of the paper; both float32."""
        y, x = np.indices((self.psf_px, self.psf_px), dtype=np.float32) - self.psf_px // 2
        radius, centre = np.hypot(x, y), (self.psf_px // 2, self.psf_px // 2)
        if self.instrument is None:
            psf = 0.1525 / (6.15 + radius) ** 2.53
            psf[centre] = 1 - (psf.sum(dtype=float) - psf[centre])
        else:
            from psfcore.build import build_psf
            from psfcore.instruments.model import load_instrument
            from psfcore.psf import crop_or_pad

            built = build_psf(load_instrument(self.instrument), parts=False, threads=THREADS)
            psf = crop_or_pad(built.kernel, self.psf_px)
        image = np.random.default_rng(0).gamma(2.0, 200.0, (self.image_px, self.image_px))
        image[600:620, 900:930] += 20_000
        if self.image_px == self.psf_px:
            image = 1 + image / (1 + np.exp((radius - 1600) / 40))  # a disc of 1600 px
        return image.astype(np.float32), (psf / psf.sum(dtype=float)).astype(np.float32)


RACES: dict[bool | str, Race] = {
    # scikit-image needs a PSF of odd size, which lacks the outermost row and column.
    False: Race(2048, 4096, CONTENDERS, edge_px=256, agreement=1e-4),
    True: Race(4096, 4096, WHOLE, edge_px=1248, agreement=2e-3),
    "aia": Race(4096, 4096, WHOLE, edge_px=1248, agreement=2e-3, instrument="aia_171"),
}


def run_one(contender: Contender) -> None:
    """Time one package in this process, with the arrays in the working folder, and save its result there."""
    image, psf = np.load("image.npy"), np.load("psf.npy")
    results: list[np.ndarray] = []
    contender.loop(image, psf, 1)
    took = seconds(lambda: results.append(contender.loop(image, psf, STEPS)))
    np.save("result.npy", results[0][: image.shape[0], : image.shape[1]].astype(np.float32))
    print(json.dumps({"seconds": took, "peak_gib": peak_gib()}))


@dataclass(frozen=True)
class Run:
    """A run of a package: its time, s, its peak memory, GiB, 1 F of the round, s, and its deviation from heliopsf."""

    seconds: float
    peak_gib: float
    f_s: float
    deviation: float


def one_run(race: Race, name: str, words: Sequence[str], folder: Path, f_s: float) -> Run:
    """Run a package, and compare its result."""
    contender = race.contenders[name]
    environment = {"PYTHONPATH": str(REPOSITORY), "JAX_PLATFORMS": "cpu"}
    found = answer_of(
        "benchmarks.race.peers", "--one", name, *words, python=python_of(contender.requirement), folder=folder,
        JAX_ENABLE_X64=str(int(contender.double)), **environment,
    )  # fmt: skip
    apart = deviation(race, name, np.load(folder / "result.npy"), folder)
    return Run(found["seconds"], found["peak_gib"], f_s, apart)


def deviation(race: Race, name: str, result: np.ndarray, folder: Path) -> float:
    """The deviation of a result from that of heliopsf, which runs first. Raises SystemExit if it is larger than the
    race allows."""
    if name == "heliopsf":
        np.save(folder / "heliopsf.npy", result)
    flat_start = name in race.contenders and race.contenders[name].flat_start
    expected = np.load(folder / ("flat.npy" if flat_start else "heliopsf.npy"))
    inner = np.s_[race.edge_px : -race.edge_px, race.edge_px : -race.edge_px]
    apart = float(np.abs(result - expected)[inner].max() / expected[inner].max())
    if not apart <= race.agreement:
        raise SystemExit(
            f"expected results within {race.agreement:g} of the brightest pixel; {name}: {apart:.1e}"
        )
    return apart


def prepare(race: Race, folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """The image and the PSF of a race; they are also written to the folder, with the result of SciPy's loop from a flat
    start."""
    image, psf = race.data()
    flat = scipy_fft(image, psf, STEPS, np.full_like(image, FLAT * image.max()))
    for label, array in (("image", image), ("psf", psf), ("flat", flat[: len(image), : len(image)])):
        np.save(folder / f"{label}.npy", array)
    return image, psf


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
    """The machine, the unit of time and the table."""
    f_s = [run.f_s for run in runs["heliopsf"]]
    rounds = f"{kind_of_machine()}, {time.strftime('%Y-%m-%d')}; {len(f_s)} rounds"
    rows = [row(name, each, runs["heliopsf"]) for name, each in runs.items()]
    return "\n".join([f"{rounds}; 1 F = {min(f_s):.2f} s to {max(f_s):.2f} s.\n", HEAD, *rows])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="packages besides heliopsf; default: all")
    parser.add_argument("--whole", action="store_true")
    parser.add_argument("--rounds", type=int, default=ROUNDS)
    parser.add_argument("--page", type=Path, help="page whose section of this race is replaced")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    race, words = RACES[chosen.whole], ["--whole"] if chosen.whole else []
    if chosen.one:
        run_one(race.contenders[chosen.one])
        return
    if unknown := set(chosen.names) - set(race.contenders):
        parser.error(f"expected names among {', '.join(race.contenders)}; got {', '.join(sorted(unknown))}")
    names = ["heliopsf", *(name for name in chosen.names or race.contenders if name != "heliopsf")]
    runs: dict[str, list[Run]] = {name: [] for name in names}
    with TemporaryDirectory(prefix="heliopsf-peers-") as place:
        folder = Path(place)
        prepare(race, folder)
        for number in range(chosen.rounds):
            f_s = reference()
            for name in names:
                runs[name].append(one_run(race, name, words, folder, f_s))
                print(f"round {number + 1}: {name:<44}{runs[name][-1]}", flush=True)
    text = section(runs)
    print(f"\n{text}")
    if chosen.page:
        from benchmarks.figures import write_part

        write_part(chosen.page, "benchmarks.race.peers", text)


if __name__ == "__main__":
    main()
