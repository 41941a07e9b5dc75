"""The command ``psf field``: a PSF that changes over the field, from PSFs at places of the detector."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import click

from service.cli.options import FILE, OUTPUT, psf_limits, write_file, writes_files
from service.cli.progress import echo

if TYPE_CHECKING:
    from psfcore.psf_places import PlacedPsf

_PLACED = re.compile(r"(?P<file>.+)@(?P<x>[0-9.]+),(?P<y>[0-9.]+)")


@click.command("field")
@click.argument("psfs", metavar="FILE@X,Y...", nargs=-1, required=True)
@click.option("-o", "--output", required=True, type=OUTPUT, help="Write the PSF (FITS)")
@click.option(
    "--detector",
    nargs=2,
    type=click.IntRange(2),
    metavar="NX NY",
    help="Size of the detector, px [default: that of the PSFs' instrument]",
)
@click.option("--order", type=click.IntRange(1, 4), default=1, help="Largest sum of the powers of x and y")
@writes_files
def field(
    psfs: tuple[str, ...], output: Path, detector: tuple[int, int] | None, order: int, overwrite: bool
) -> None:
    """Make a PSF that changes over the field from PSFs at places: FILE is a PSF (FITS), and X,Y its pixel on the
    detector, counted from 0. A FILE without a place is an ArrayPSF of the package regularizepsf.
    """
    from psfcore.fits.psfs import write_psf
    from psfcore.psf_places import fit_places

    given = [one for text in psfs for one in _placed(text)]
    size = detector or _detector_of(given[0].psf.instrument)
    found = fit_places(given, size, order=order)
    write_file(output, lambda path: write_psf(path, found.psf), overwrite=overwrite)
    terms = ", ".join(f"x^{term.x_power} y^{term.y_power}" for term in found.psf.field_terms)
    echo(
        f"{output}: terms {terms} on a detector of {size[0]} x {size[1]} px, from PSFs at {len(given)} places"
    )
    if found.left_out:
        names = ", ".join(f"x^{a} y^{b}" for a, b in found.left_out)
        echo(f"  left out, because the places cannot tell them from the other terms: {names}")
    worst = max(range(len(given)), key=found.misplaced.__getitem__)
    of_worst = given[worst]
    echo(
        f"  residual: {100 * sum(found.misplaced) / len(given):.3g} % of the light of a PSF is misplaced, at most "
        f"{100 * found.misplaced[worst]:.3g} % at {of_worst.x_px:g},{of_worst.y_px:g}"
    )
    if found.clipped:
        echo(f"  weights below 0 were raised to 0: up to {100 * found.clipped:.3g} % of the light of a place")


def _placed(text: str) -> list[PlacedPsf]:
    """The PSF that an argument names with its place, or those of an ArrayPSF."""
    from psfcore.fits.psfs import read_psf
    from psfcore.psf_places import PlacedPsf, read_array_psf

    match = _PLACED.fullmatch(text)
    file = FILE.convert(text if match is None else match["file"], None, click.get_current_context())
    if match is None:
        return read_array_psf(file)
    return [PlacedPsf(read_psf(file, psf_limits()), float(match["x"]), float(match["y"]))]


def _detector_of(instrument: str | None) -> tuple[int, int]:
    """The size of the detector of an instrument that has an instrument file."""
    from psfcore.errors import DataError
    from psfcore.instruments.files import instrument_names
    from psfcore.instruments.model import load_instrument

    if instrument not in instrument_names():
        raise DataError(
            "unknown-detector",
            "expected the size of the detector, because the PSFs name no known instrument: give --detector NX NY",
        )
    pixels = load_instrument(instrument).detector.pixels
    return pixels, pixels
