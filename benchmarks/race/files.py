"""From file to file: the command of heliopsf beside scripts with other packages, each as a whole process.

    python -m benchmarks.race.files [NAME ...] [--whole | --aia] [--rounds N] [--page FILE]

The image, the PSF and the environments are those of `benchmarks.race.peers`. A script reads both files with astropy,
runs the loop of the package, and writes the result with astropy; heliopsf also checks the PSF, measures the changes and
writes QUALITY. With --whole, heliopsf runs also with the edges periodic, which are those of the others. --aia: the same
with the PSF of AIA at 171 angstrom, which heliopsf built and kept, and the others read. The results are compared. A
time is that of the process, with its start and its imports; each process runs once before, so that kernels and compiled
modules are kept.
"""

from __future__ import annotations

import argparse
import os
import sys
from concurrent.futures import ProcessPoolExecutor
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
    Race,
    Run,
    deviation,
    prepare,
    python_of,
    section,
)
from benchmarks.timing import measured_process, reference

ALL = WHOLE | CONTENDERS
NAMES = ("aiapy", "scikit-image", "JAX, compiled loop", "the loop of aiapy in JAX, single precision")
PERIODIC = "heliopsf, edges periodic"
CARDS = {"TELESCOP": "bench", "BUNIT": "DN/s", "XPOSURE": 1.0, "DATE-OBS": "2020-01-01T00:00:00"}

AIA: dict[str, str | float] = {
    "TELESCOP": "SDO/AIA",
    "INSTRUME": "AIA_3",
    "WAVELNTH": 171,
    "WAVEUNIT": "angstrom",
}
AIA |= {"CDELT1": 0.6, "CDELT2": 0.6, "CUNIT1": "arcsec", "CUNIT2": "arcsec"}


def command_of(name: str, psf: str) -> list[str]:
    """The process that deconvolves image.fits with psf.fits into out.fits. psf: the PSF as heliopsf names it."""
    if name in ("heliopsf", PERIODIC):
        words = ["deconvolve", "image.fits", "--psf", psf, "-o", "out.fits", "--local", "--overwrite"]
        edges = "periodic" if name == PERIODIC else "zero"
        return [sys.executable, "-m", "service.cli", *words, "--steps", str(STEPS), "--edges", edges]
    return [python_of(ALL[name].requirement), "-m", "benchmarks.race.files", "--one", name]


def run_one(name: str) -> None:
    """Read, deconvolve and write with one package, in the working folder."""
    image, psf = (np.asarray(fits.getdata(f"{part}.fits"), np.float32) for part in ("image", "psf"))
    result = ALL[name].loop(image, psf, STEPS)[: image.shape[0], : image.shape[1]]
    fits.writeto("out.fits", result.astype(np.float32), fits.getheader("image.fits"), overwrite=True)


def write_inputs(race: Race, folder: Path) -> None:
    """Write the image and the PSF to the folder, as the packages of both races read them."""
    image, psf = prepare(race, folder)
    cards = CARDS | (AIA if race.instrument else {})
    fits.writeto(folder / "image.fits", image, fits.Header(cards))
    fits.writeto(folder / "psf.fits", psf)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="packages besides heliopsf; default: all")
    parser.add_argument("--whole", action="store_true", help="an image of 4096 px")
    parser.add_argument("--aia", action="store_true", help="the same with the PSF of AIA at 171 angstrom")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--page", type=Path, help="page whose section of this race is replaced")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one:
        run_one(chosen.one)
        return
    race = RACES["aia" if chosen.aia else chosen.whole]
    names = ["heliopsf", *([PERIODIC] if race.image_px == race.psf_px else [])]
    names += chosen.names or [name for name in race.contenders if name in NAMES]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "JAX_PLATFORMS": "cpu"}
    page = chosen.page and chosen.page.resolve()
    runs: dict[str, list[Run]] = {name: [] for name in names}
    with TemporaryDirectory(prefix="heliopsf-files-") as folder:
        os.chdir(folder)
        with ProcessPoolExecutor(
            1
        ) as apart:  # the memory of this process would count as that of the commands
            apart.submit(write_inputs, race, Path(folder)).result()
        for number in range(chosen.rounds + 1):
            f_s = reference()
            for name in names:
                Path("out.fits").unlink(missing_ok=True)
                command = command_of(name, race.instrument or "psf.fits")
                took_s, gib = measured_process(command, environment)
                if not Path("out.fits").is_file():
                    raise SystemExit(f"expected {name} to write out.fits; it did not")
                run = Run(took_s, gib, f_s, deviation(race, name, fits.getdata("out.fits"), Path(folder)))
                if number:
                    runs[name].append(run)
                print(f"round {number}: {name:<20}{run}", flush=True)
    print(section(runs))
    if page:
        write_part(
            page,
            f"benchmarks.race.files{' aia' if chosen.aia else ' whole' if chosen.whole else ''}",
            section(runs),
        )


if __name__ == "__main__":
    main()
