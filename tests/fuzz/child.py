"""Reads inputs one after the other in a process of its own, under the memory limit of a job.

`python -m tests.fuzz.child '{"KIND": COUNT, ...}' FOLDER` writes a line for each seed of each kind: "result", the code
of a DataError, or a fault. If the process dies, it dies with the seed after the last line.
"""

from __future__ import annotations

import dataclasses
import io
import json
import sys
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from psfcore import build, limited
from psfcore.deconvolve.doubts import input_warnings
from psfcore.deconvolve.methods.registry import method_names
from psfcore.deconvolve.run import deconvolve
from psfcore.deconvolve.work import Options
from psfcore.diffraction import combined, fraunhofer
from psfcore.errors import DataError
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.header import read_summary
from psfcore.fits.images import write_image
from psfcore.fits.observation import read_observation
from psfcore.fits.psfs import read_psf
from psfcore.fits.saturation import with_saturation
from psfcore.fits.unusable import unusable_pixels
from psfcore.fits.viewing.regions import Region, write_cutout
from psfcore.image import Image
from psfcore.instruments.model import parse_instrument
from psfcore.instruments.workload import check_workload
from psfcore.scatter import power_law
from psfcore.transit.manifest import parse_manifest
from tests.fuzz.fits_inputs import compressed_image, plain_image
from tests.fuzz.text_inputs import instrument, manifest
from tests.image_contents import CONTENTS
from tests.psfcore.conftest import gaussian, make_psf
from workers.intake.costs import WORKER_MIB
from workers.intake.estimates import estimate_build
from workers.run.child import Child

LIMITS = FitsLimits(max_pixels=128 * 128, max_header_bytes=64 * 1024, max_hdus=8)
SIZE_PX = 64


def read_an_image(content: bytes, folder: Path) -> str:
    """Read an image twice, with different contents of fresh memory in the process that decodes it, and write a product
    from it."""
    path, product = folder / "input.fits", folder / "product.fits"
    path.write_bytes(content)
    try:
        summary = read_summary(path, LIMITS)
    except DataError as error:
        with pytest.raises(DataError, match=f"^{error.code}:"):
            read_observation(path, LIMITS)
        raise
    json.dumps(dataclasses.asdict(summary), allow_nan=False)
    assert 0 < summary.shape[0] * summary.shape[1] <= LIMITS.max_pixels
    images = []
    for filling in (0x11, 0x77):
        limited.FILLING = filling
        images.append(read_observation(path, LIMITS))
    image = images[0]
    assert np.array_equal(image.pixels, images[1].pixels, equal_nan=True), "pixels hold memory of the process"
    cards = {"PSFNAME": (summary.psf_name or "none", "name of the PSF")}
    write_image(product, image, cards=cards, history=[f"from {summary.instrume}"])
    assert read_observation(product, LIMITS).pixels.shape == summary.shape
    if summary.psf_name is not None:
        read_psf(path, LIMITS)
    # Cards of places reach a library in C. What it cannot use is an error of the user.
    with (folder / "cut.fits").open("wb") as cut, suppress(DataError):
        write_cutout(product, Region.circle("helioprojective", 0.0, 0.0, 2.0), LIMITS, cut)
    return "result"


def content_of_an_image(seed: int) -> bytes:
    """An image, as `numpy.save` stores it: the contents of two images side by side, scaled."""
    rng = np.random.default_rng(seed)
    size, names = int(rng.integers(40, 129)), list(CONTENTS)
    left, right = (CONTENTS[names[int(rng.integers(len(names)))]](size) for _ in range(2))
    scale = float(rng.choice([1.0, 1.0, -1.0, 0.0, 1e-9, 1e9]))
    border = int(rng.integers(size))
    file = io.BytesIO()
    np.save(file, scale * np.hstack([left[:, :border], right[:, border:]]))
    return file.getvalue()


def deconvolve_an_image(content: bytes, folder: Path) -> str:
    """Deconvolve an image, with the method that its size chooses, and compare it with the result."""
    pixels = np.load(io.BytesIO(content))
    methods = method_names()
    method = methods[len(pixels) % len(methods)]
    mask, warned = unusable_pixels(pixels, fits.Header(), None, {})
    image = with_saturation(Image(pixels, mask, fits.Header(), "DN/s", 1.0, warnings=warned))
    psf = make_psf(gaussian(33, 1.5))
    warned = input_warnings(psf, image, method, channel=None)
    options = Options(method=method, parameters={"steps": 2}, threads=1)
    product = deconvolve(image, psf, options, warnings=warned)
    assert np.isfinite(product.pixels[image.finite]).all()
    json.dumps(product.details(), allow_nan=False)
    return "result"


def read_a_manifest(content: bytes, folder: Path) -> str:
    """Check a transit.json."""
    parse_manifest(content)
    return "result"


def build_an_instrument(content: bytes, folder: Path) -> str:
    """Build the PSF of an instrument file."""
    described = parse_instrument(content.decode("utf-8", "replace"), "fuzz.toml")
    check_workload(described, "fuzz.toml")
    psf = build.build_psf(described, size=SIZE_PX)
    assert psf.kernel.shape == (SIZE_PX, SIZE_PX) and np.isfinite(psf.kernel).all()
    return "result"


def _instrument_mib(content: bytes) -> float:
    """The estimated memory of a build that is accepted; 0 if it is refused."""
    text = content.decode("utf-8", "replace")
    try:
        check_workload(parse_instrument(text, "fuzz.toml"), "fuzz.toml")
        return float(estimate_build({"instrument_file": text, "size": SIZE_PX})[1])
    except DataError:
        return 0.0


Reader = Callable[[bytes, Path], str]
Maker = Callable[[int], bytes]
KINDS: dict[str, tuple[Maker, Reader]] = {
    "tiles": (compressed_image, read_an_image),
    "headers": (plain_image, read_an_image),
    "contents": (content_of_an_image, deconvolve_an_image),
    "manifests": (manifest, read_a_manifest),
    "instruments": (instrument, build_an_instrument),
}


def _small_grids() -> None:
    """Build PSFs on the grid that is kept, 64 px, in place of 2048 px and 4096 px: a thousand times faster."""
    build.REACH_GRID_PX = SIZE_PX
    combined.PERIOD_PX = SIZE_PX
    fraunhofer.SURVEY_CELLS = 2 * SIZE_PX
    defaults = power_law.amplitude_for_total.__kwdefaults__
    assert defaults is not None
    defaults["reach_grid_px"] = SIZE_PX


def main(counts: dict[str, int], folder: Path) -> None:
    """Read the inputs of the first seeds of each kind."""
    warnings.simplefilter("ignore")
    np.seterr(all="ignore")
    _small_grids()
    child = Child(threads=1)
    for kind, seed in ((kind, seed) for kind, count in counts.items() for seed in range(count)):
        make, read = KINDS[kind]
        content = make(seed)
        estimate_mib = WORKER_MIB + (_instrument_mib(content) if kind == "instruments" else 0.0)
        try:
            with child.limited(round(estimate_mib)):
                outcome = read(content, folder)
        except DataError as error:
            outcome = error.code
        except Exception:  # noqa: BLE001  (any other exception is what the fuzzing looks for)
            outcome = "fault " + json.dumps(traceback.format_exc())
        print(outcome, flush=True)


if __name__ == "__main__":
    main(json.loads(sys.argv[1]), Path(sys.argv[2]))
