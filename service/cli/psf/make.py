"""The commands ``psf build``, ``psf fit``, ``psf crossval`` and ``psf show``."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click

from psfcore.instruments.psf_statements import caveats, title
from service.cli.connection import SERVER_OR_LOCAL, connection, short
from service.cli.options import (
    FILE,
    JSON,
    OUTPUT,
    PLOT,
    is_local,
    options_of,
    psf_limits,
    write_file,
    writes_files,
)
from service.cli.progress import echo, progress_bar
from workers.contract.requests import CrossValidate, PsfBuild, PsfFit

SHOWN_RADII_PX = (0.5, 1, 2, 5, 10, 11.5, 20, 50, 100, 200, 500, 1000)
TRANSIT = click.argument("transit", type=click.Path(exists=True, path_type=Path))


@click.command("build")
@click.option(
    "--instrument",
    required=True,
    metavar="NAME|FILE",
    help="An instrument that `psf instruments` lists, such as hri_euv, or an instrument file (TOML)",
)
@options_of(PsfBuild, "size", "component")
@click.option("-o", "--output", required=True, type=OUTPUT, help="Write the PSF (FITS)")
@PLOT
@SERVER_OR_LOCAL
@writes_files
def build(
    instrument: str,
    output: Path,
    plot: Path | None,
    size: int,
    component: str | None,
    overwrite: bool,
) -> None:
    """Compute the PSF of an instrument."""
    with (
        TemporaryDirectory(prefix="heliopsf-") as folder,
        connection() as service,
        progress_bar() as report,
    ):
        built = service.build_psf(
            instrument,
            output,
            mask=_mask_of(instrument, folder),
            size=size,
            component=component,
            preview=plot,
            progress=report,
            overwrite=overwrite,
        )
    echo(f"{output}: {title(built['name'], built['version'], built['status'])}, id {short(built['id'])}")
    details = built["details"]
    for caveat in caveats(built["name"], built["instrument"], details["provenance"]):
        echo(f"  {caveat}")
    reach_px = (
        math.hypot(*details["shape"]) / 2
    )  # farther out, no weight of the array says where the light is
    for radius, beyond_pct in details["cumulative_curve_pct"].items():
        if float(radius) < reach_px:
            echo(f"  light beyond {radius:>5} px  {beyond_pct:6.2f} %")


TOLD_PX = (10, 100)  # the JSON and `psf show` have the curve at more radii


@click.command("fit")
@TRANSIT
@click.option("-o", "--output", required=True, type=OUTPUT, help="Write the PSF (FITS)")
@JSON
@PLOT
@options_of(PsfFit, "shape", "field", "as_published", "noise", "saturation_dn")
@SERVER_OR_LOCAL
@writes_files
def fit(
    transit: Path,
    output: Path,
    json_file: Path | None,
    plot: Path | None,
    **parameters: object,
) -> None:
    """Fit the scattered light in TRANSIT: a folder with a transit.json, or a .zip or .tar file of such a folder."""
    with connection() as service, progress_bar() as say:
        fitted = service.fit_psf(
            transit,
            output,
            report=json_file,
            preview=plot,
            progress=say,
            **parameters,
        )
    found = fitted["details"]["fit"]
    echo(f"{output}: {title(fitted['name'], fitted['version'], fitted['status'])}, id {short(fitted['id'])}")
    say_fit(found)
    for line in found.get("field", {}).get("lines", ()):
        echo(f"  {line}")
    for limit in found["limits"]:
        echo(f"  note: {limit}")
    here = " --local" if is_local() else ""
    echo(f"next: `heliopsf report {transit}{here} -o PAGE.html` tests the fit on images that it did not use")


def say_fit(fit: dict[str, Any]) -> None:
    """Print the sentence of a fitted shape, its parameters, and its curve at two radii, with their errors."""
    echo(fit["sentence"])
    for name, parameter in fit["parameters"].items():
        echo(f"  {name:<12} {parameter['value']:10.4f} ± {parameter['sigma']:.4f} {parameter['unit']}")
    curve = fit["curve"]
    told = zip(curve["radii_px"], curve["light_beyond_pct"], curve["sigma"], strict=True)
    for radius, beyond, sigma in told:
        if radius in TOLD_PX:
            echo(f"  light beyond {radius:>3g} px  {beyond:6.2f} ± {sigma:.2f} %")


@click.command("crossval")
@TRANSIT
@click.option("--json", "json_file", required=True, type=OUTPUT, help="Write all numbers to this file (JSON)")
@PLOT
@options_of(CrossValidate, "scheme", "runs", "shape", "noise")
@SERVER_OR_LOCAL
@writes_files
def crossval(
    transit: Path,
    json_file: Path,
    plot: Path | None,
    **parameters: object,
) -> None:
    """Estimate the uncertainty of the fit to TRANSIT: hold out blocks of images and bootstrap the other images, in many
    runs.
    """
    with connection() as service, progress_bar() as report:
        found = service.cross_validate(
            transit,
            json_file,
            preview=plot,
            progress=report,
            **parameters,
        )
    echo(f"{json_file}: {found['details']['sentence']}")


@click.command("show")
@click.argument("file", type=FILE)
@PLOT
@writes_files
def show(file: Path, plot: Path | None, overwrite: bool) -> None:
    """Show what the PSF in FILE (FITS) contains: its size, its sum, and the light beyond several radii."""
    import numpy as np

    from psfcore.fits.psfs import read_psf
    from psfcore.psf import cumulative_curve, light_beyond_map

    psf = read_psf(file, psf_limits())
    if plot is not None:
        from psfcore.drawing.plots import psf_png

        write_file(plot, partial(psf_png, psf), overwrite=overwrite)
    radii = np.array([r for r in SHOWN_RADII_PX if r < psf.reach_px])
    kernels = {"TOTAL": psf.kernel, **psf.components}
    curves = {name: cumulative_curve(kernel, radii) for name, kernel in kernels.items()}
    echo(f"{title(psf.name, psf.version, psf.status)}, instrument {psf.instrument or 'unnamed'}")
    scale = "unknown" if psf.plate_scale_arcsec is None else f"{psf.plate_scale_arcsec} arcsec/px"
    echo(
        f"{psf.kernel.shape[1]} x {psf.kernel.shape[0]} px, reach {psf.reach_px:.0f} px, sum {psf.kernel.sum():.6f}, "
        f"central pixel {psf.kernel.max():.4f}, plate scale {scale}"
    )
    for caveat in caveats(psf.name, psf.instrument, psf.provenance):
        echo(caveat)
    echo("\nlight beyond R, or outside the array, in percent:")
    echo(f"{'R (px)':>8}" + "".join(f"{name:>15}" for name in kernels))
    for n, radius in enumerate(radii):
        echo(f"{radius:>8g}" + "".join(f"{curve[n]:>15.3f}" for curve in curves.values()))
    if psf.place is None:
        return
    terms = ", ".join(f"x^{term.x_power} y^{term.y_power}" for term in psf.field_terms)
    nx, ny = psf.place.detector
    echo(
        f"\nchanges over the field of {nx} x {ny} px (terms {terms}); above: at its centre\n"
        "light beyond R in percent at the corners, the edges and the centre, y upwards:"
    )
    for radius, places in zip(radii, light_beyond_map(psf, radii), strict=True):
        for n, row in enumerate(places[::-1]):
            echo((f"{radius:>8g}" if n == 0 else " " * 8) + "".join(f"{pct:>10.3f}" for pct in row))


def _mask_of(instrument: str, folder: str) -> Path | None:
    """The mask image that the user's instrument file names, as a FITS file in this folder; None if it names no mask
    image.
    """
    if not instrument.endswith(".toml"):
        return None
    from astropy.io import fits

    from psfcore.fits.images import read_mask_image
    from psfcore.instruments.model import load_instrument

    mount = load_instrument(instrument).mount
    if mount is None or mount.mask_image is None:
        return None
    file = Path(folder) / "mask.fits"
    fits.PrimaryHDU(read_mask_image(Path(instrument).parent / mount.mask_image.file)).writeto(file)
    return file
