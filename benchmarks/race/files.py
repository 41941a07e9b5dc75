"""From file to file: the command of heliopsf beside scripts with other packages, each as a whole process.

    python -m benchmarks.race.files [NAME ...] [--whole] [--rounds N]

The image, the PSF and the environments are those of `benchmarks.race.peers`. A script reads both files with astropy, runs the loop of
the package, and writes the result with astropy; `benchmarks.race.peers` compares the results. A time is that of the process, with its start and
its imports; each process runs once before, so that kernels and compiled modules are kept. A line gives the time as a ratio to that of
heliopsf in the same round.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import numpy as np
from astropy.io import fits

from benchmarks.race.peers import CONTENDERS, RACES, REPOSITORY, STEPS, python_of
from benchmarks.timing import measured_process

NAMES = ("aiapy", "scikit-image", "JAX, compiled loop")
CARDS = {"TELESCOP": "bench", "BUNIT": "DN/s", "XPOSURE": 1.0, "DATE-OBS": "2020-01-01T00:00:00"}


def command_of(name: str) -> list[str]:
    """The process that deconvolves image.fits with psf.fits into out.fits."""
    if name == "heliopsf":
        words = ["deconvolve", "image.fits", "--psf", "psf.fits", "-o", "out.fits", "--local", "--overwrite"]
        return [sys.executable, "-m", "service.cli", *words, "--steps", str(STEPS), "--edges", "zero"]
    return [python_of(CONTENDERS[name].requirement), "-m", "benchmarks.race.files", "--one", name]


def run_one(name: str) -> None:
    """Read, deconvolve and write with one package, in the working folder."""
    image, psf = (np.asarray(fits.getdata(f"{part}.fits"), np.float32) for part in ("image", "psf"))
    result = CONTENDERS[name].loop(image, psf, STEPS)[: image.shape[0], : image.shape[1]]
    fits.writeto("out.fits", result.astype(np.float32), fits.getheader("image.fits"), overwrite=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="packages besides heliopsf; default: all")
    parser.add_argument("--whole", action="store_true", help="an image of 4096 px")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--one", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one:
        run_one(chosen.one)
        return
    names = ["heliopsf", *(chosen.names or NAMES)]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "JAX_PLATFORMS": "cpu"}
    times: dict[str, list[float]] = {name: [] for name in names}
    with TemporaryDirectory(prefix="heliopsf-files-") as folder:
        os.chdir(folder)
        image, psf = RACES[chosen.whole].data()
        fits.writeto("image.fits", image, fits.Header(CARDS))
        fits.writeto("psf.fits", psf)
        for number in range(chosen.rounds + 1):
            for name in names:
                Path("out.fits").unlink(missing_ok=True)
                took, peak_gib = measured_process(command_of(name), environment)
                if not Path("out.fits").is_file():
                    raise SystemExit(f"expected {name} to write out.fits; it did not")
                if number:
                    times[name].append(took)
                print(f"round {number}: {name:<20}{took:8.1f} s {peak_gib:6.2f} GiB", flush=True)
    for name in names:
        ratios = [one / own for one, own in zip(times[name], times["heliopsf"], strict=True)]
        print(
            f"{name:<20}{median(times[name]):8.1f} s {median(ratios):6.1f} ({min(ratios):.1f} to {max(ratios):.1f})"
        )


if __name__ == "__main__":
    main()
