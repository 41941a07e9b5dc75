"""Times of deconvolution and PSF builds, in units of a reference transform; part of `make bench`.

benchmarks/timing.py defines the unit 1 F.
"""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import scipy.fft

from benchmarks.figures import tell
from benchmarks.race import fft_libraries
from benchmarks.timing import THREADS, peak_gib, reference, seconds
from psfcore.build import build_psf
from psfcore.deconvolve.conditions import Conditions, PreparedPsfs
from psfcore.deconvolve.methods.registry import method_named
from psfcore.diffraction.fraunhofer import FEWEST_SAMPLES, far_field
from psfcore.diffraction.pupil import entrance_pupil
from psfcore.drawing.plots import preview_png
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.observation import read_observation
from psfcore.instruments.model import Instrument, load_instrument
from psfcore.psf import Psf
from psfcore.simulate.observe import demo_image
from tests.whole import stack as stacks

TOTAL = "build 2048, total PSF only"
ASYMMETRIC = "build 2048, no symmetry"
FIGURES = {
    TOTAL: "PSF of HRI_EUV, 2048 px",
    ASYMMETRIC: "PSF with a mount without symmetry, 2048 px",
}
TURN_DEG = 7.0


def row(what: str, took_s: float, f_s: float, note: str = "") -> None:
    print(f"{what:<52} {took_s:8.2f} s {took_s / f_s:8.1f} F   peak so far {peak_gib():.2f} GiB  {note}")


def round_trip_s(stack: stacks.Stack, image: Path, output: Path) -> tuple[float, float]:
    """Time of upload, job and download in s: for a new product, and for a product that already exists."""
    stack.client.build_psf("hri_euv")
    # With another number of steps, the worker loads its kernels but the product does not exist yet.
    stack.client.deconvolve(image, steps=1)
    # No pixel reaches these saturation levels. So the work is always the same, but each level gives another product.
    levels = iter((1e9, 2e9, 3e9))
    again = {"output": output, "overwrite": True}
    new = seconds(lambda: stack.client.deconvolve(image, saturation_dn=next(levels), **again), 3)
    return new, seconds(lambda: stack.client.deconvolve(image, saturation_dn=3e9, **again), 3)


def http_round_trip(image: Path, psf: Psf, in_process_s: float, f_s: float, folder: Path) -> None:
    """Time the same deconvolution over HTTP: embedded, and with Redis and PostgreSQL.

    The PSF has already been built.
    """
    for name, mode in (("embedded", stacks.embedded), ("Redis and PostgreSQL", stacks.served)):
        place = folder / name.split()[0]
        place.mkdir()
        with ExitStack() as resources:
            try:
                stack = resources.enter_context(mode(place))
            except stacks.Missing as missing:
                print(f"skipped: {missing}")
                continue
            took, again = round_trip_s(stack, image, place / "out.fits")
        row(
            f"HTTP round trip, {name}",
            took,
            f_s,
            f"difference from the psfcore call: {took - in_process_s:+.2f} s",
        )
        row(f"  the same request again, {name}", again, f_s)


def turned_mount(instrument: Instrument) -> Instrument:
    """The instrument with a mount that has no symmetry: five bars, turned by an angle that no mirror maps to itself."""
    mount = instrument.mount
    assert mount is not None
    rays = tuple(replace(rays, count=5, first_angle_deg=TURN_DEG) for rays in mount.rays)
    return replace(instrument, mount=replace(mount, rays=rays))


def builds(f_s: float) -> None:
    """Time PSF builds, and compare the far field with a plain transform of the padded pupil; each in a separate
    process."""
    for what in (
        TOTAL,
        ASYMMETRIC,
        "build 2048",
        "build 4096",
        "far field 1024",
        "plain padded transform 1024",
    ):
        answer = subprocess.run(
            [sys.executable, "-m", "benchmarks.deconvolution", what],
            capture_output=True,
            text=True,
            check=True,
        )
        measured = json.loads(answer.stdout.splitlines()[-1])
        print(
            f"{'hri_euv, ' + what:<52} {measured['seconds']:8.2f} s {measured['seconds'] / f_s:8.1f} F   "
            f"peak {measured['peak_gib']:.2f} GiB"
        )
        if what in FIGURES:
            tell(FIGURES[what], measured["seconds"], f_s)


def one_build(what: str) -> None:
    """Print one line of `builds`, as JSON."""
    instrument = load_instrument("hri_euv")
    if what.startswith("build"):
        if what == ASYMMETRIC:
            instrument = turned_mount(instrument)
        size, parts = int(what.split()[1].rstrip(",")), what not in FIGURES
        build_psf(instrument, size=256, parts=parts, threads=THREADS)  # compiles
        took = seconds(lambda: build_psf(instrument, size=size, parts=parts, threads=THREADS))
    elif what.startswith("far field"):
        optics = {
            "wavelength_angstrom": instrument.wavelength_angstrom,
            "focal_length_mm": instrument.focal_length_mm,
            "pixel_pitch_um": instrument.detector.pixel_pitch_um,
        }
        pupil = entrance_pupil(instrument.aperture, mount=instrument.mount)
        took = seconds(lambda: far_field(pupil, **optics, size=1024, threads=THREADS))
    else:
        padded = np.zeros((FEWEST_SAMPLES * 1024, FEWEST_SAMPLES * 1024), np.float32)
        took = seconds(lambda: scipy.fft.rfft2(padded, workers=2))
    print(json.dumps({"seconds": took, "peak_gib": peak_gib()}))


def main() -> None:
    f_s = reference()
    print(f"1 F = {f_s:.3f} s, {THREADS} threads")
    if "--quick" not in sys.argv:
        builds(f_s)
    psf = build_psf(load_instrument("hri_euv"), threads=THREADS)
    with TemporaryDirectory(prefix="heliopsf-bench-") as name:
        folder = Path(name)
        path = folder / "image.fits"
        demo_image(path, psf, size=2048)
        image = read_observation(path, FitsLimits(max_pixels=2**24))
        fft_libraries.compare(image.pixels.astype(np.float32), psf.kernel.astype(np.float32), folder, f_s)
        default, as_published = method_named("richardson-lucy"), Conditions(edges="zero", threads=THREADS)
        default(image, psf, as_published, steps=1)
        results = []
        published_s = seconds(lambda: results.append(default(image, psf, as_published)))
        row("Richardson-Lucy as published, 2048 px image and PSF", published_s, f_s)
        conditions = Conditions(threads=THREADS, engine_for=PreparedPsfs().engine_for)
        default(image, psf, conditions, steps=1)
        core_s = seconds(lambda: default(image, psf, conditions))
        row("the same by default (mirrored edges, PSF prepared)", core_s, f_s)
        picture_s = seconds(
            lambda: preview_png(image.pixels, results[0].pixels, folder / "p.png", title="bench", unit="DN/s")
        )
        row("preview, 2048 px", picture_s, f_s)
        http_round_trip(path, psf, core_s, f_s, folder)


if __name__ == "__main__":
    if sys.argv[1:] not in ([], ["--quick"]):
        one_build(sys.argv[1])
    else:
        main()
