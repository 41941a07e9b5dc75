"""Time the first and the second `heliopsf deconvolve IMAGE --local` of a new user; part of `make bench`.

The image is a simulated one of HRI_EUV, 2048 x 2048 px. For the first command all caches are empty, so that it compiles the
kernels and builds the PSF. The second command finds both. A time is that of the whole process. The shortest of three rounds counts.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.figures import tell
from benchmarks.timing import THREADS, measured_process, reference
from psfcore.build import build_psf
from psfcore.instruments.model import load_instrument
from psfcore.simulate.observe import demo_image

ROUNDS, SIZE_PX = 3, 2048
COMMAND = (sys.executable, "-m", "service.cli", "deconvolve")


def one_round(image: Path, folder: Path) -> tuple[float, float]:
    """The times of the first and of the second command, s. folder: an empty folder, for caches and results."""
    kept = {"HELIOPSF_CACHE_DIR": str(folder / "psfs"), "NUMBA_CACHE_DIR": str(folder / "kernels")}
    environment = os.environ | kept | {"XDG_CACHE_HOME": str(folder / "user")}
    first, second = (
        measured_process(
            [*COMMAND, str(image), "--local", "-o", str(folder / f"{number}.fits")], environment
        )[0]
        for number in (1, 2)
    )
    return first, second


def main() -> None:
    f_s = reference()
    with TemporaryDirectory(prefix="heliopsf-first-") as temporary:
        image, rounds = Path(temporary) / "image.fits", []
        demo_image(image, build_psf(load_instrument("hri_euv"), threads=THREADS), size=SIZE_PX)
        for number in range(ROUNDS):
            folder = Path(temporary) / str(number)
            folder.mkdir()
            rounds.append(one_round(image, folder))
    first, second = zip(*rounds, strict=True)
    tell("first result, 2048 px, empty caches", min(first), f_s)
    tell("second result, 2048 px", min(second), f_s)


if __name__ == "__main__":
    main()
