"""From file to file: the command of heliopsf beside scripts with other packages, each as a whole process.

    python -m benchmarks.race.files [NAME ...] [--whole] [--rounds N] [--page FILE]

The image, the PSF and the environments are those of `benchmarks.race.peers`. A script reads both files with astropy,
runs the loop of the package, and writes the result with astropy; heliopsf also checks the PSF, measures the changes and
writes QUALITY. The results are compared. A time is that of the process, with its start and its imports; each process
runs once before, so that kernels and compiled modules are kept.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from astropy.io import fits

from benchmarks.figures import write_part
from benchmarks.race.peers import (
    CONTENDERS,
    RACES,
    REPOSITORY,
    STEPS,
    WHOLE,
    Run,
    deviation,
    prepare,
    python_of,
    section,
)
from benchmarks.timing import measured_process, reference

ALL = WHOLE | CONTENDERS
NAMES = ("aiapy", "scikit-image", "JAX, compiled loop", "the loop of aiapy in JAX, single precision")
CARDS = {"TELESCOP": "bench", "BUNIT": "DN/s", "XPOSURE": 1.0, "DATE-OBS": "2020-01-01T00:00:00"}


def command_of(name: str) -> list[str]:
    """The process that deconvolves image.fits with psf.fits into out.fits."""
    if name == "heliopsf":
        words = ["deconvolve", "image.fits", "--psf", "psf.fits", "-o", "out.fits", "--local", "--overwrite"]
        return [sys.executable, "-m", "service.cli", *words, "--steps", str(STEPS), "--edges", "zero"]
    return [python_of(ALL[name].requirement), "-m", "benchmarks.race.files", "--one", name]


def run_one(name: str) -> None:
    """Read, deconvolve and write with one package, in the working folder."""
    image, psf = (np.asarray(fits.getdata(f"{part}.fits"), np.float32) for part in ("image", "psf"))
    result = ALL[name].loop(image, psf, STEPS)[: image.shape[0], : image.shape[1]]
    fits.writeto("out.fits", result.astype(np.float32), fits.getheader("image.fits"), overwrite=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="packages besides heliopsf; default: all")
    parser.add_argument("--whole", action="store_true", help="an image of 4096 px")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--page", type=Path, help="page whose section of this race is replaced")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one:
        run_one(chosen.one)
        return
    race = RACES[chosen.whole]
    names = ["heliopsf", *(chosen.names or (name for name in race.contenders if name in NAMES))]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "JAX_PLATFORMS": "cpu"}
    page = chosen.page and chosen.page.resolve()
    runs: dict[str, list[Run]] = {name: [] for name in names}
    with TemporaryDirectory(prefix="heliopsf-files-") as folder:
        os.chdir(folder)
        image, psf = prepare(race, Path(folder))
        fits.writeto("image.fits", image, fits.Header(CARDS))
        fits.writeto("psf.fits", psf)
        for number in range(chosen.rounds + 1):
            f_s = reference()
            for name in names:
                Path("out.fits").unlink(missing_ok=True)
                took_s, gib = measured_process(command_of(name), environment)
                if not Path("out.fits").is_file():
                    raise SystemExit(f"expected {name} to write out.fits; it did not")
                run = Run(took_s, gib, f_s, deviation(race, name, fits.getdata("out.fits"), Path(folder)))
                if number:
                    runs[name].append(run)
                print(f"round {number}: {name:<20}{run}", flush=True)
    print(section(runs))
    if page:
        write_part(page, f"benchmarks.race.files{' whole' if chosen.whole else ''}", section(runs))


if __name__ == "__main__":
    main()
