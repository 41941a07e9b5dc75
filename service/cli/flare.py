"""The command ``flare``: tests a PSF on the stray light of a flare."""

from __future__ import annotations

from pathlib import Path

import click

from service.cli.options import (
    FILE,
    JSON,
    NOISE,
    PLOT,
    SATURATION,
    limits,
    user_errors,
    write_json,
    writes_files,
)
from service.client.outputs import written


@click.command()
@click.argument("image", type=FILE)
@click.option(
    "--background", required=True, type=FILE, help="Image of the same frame before the flare (FITS)"
)
@click.option("--psf", "psf_file", required=True, type=FILE, help="PSF to test (FITS)")
@click.option("--centre", nargs=2, type=int, metavar="X Y", help="Position of the flare, px [default: found]")
@click.option(
    "--arm",
    "arm_deg",
    type=float,
    metavar="DEG",
    help="Direction of the arm, from +x towards +y [default: the measured arm nearest to +x]",
)
@click.option(
    "--range",
    "distances_px",
    nargs=2,
    type=float,
    default=(10, 80),
    show_default=True,
    metavar="FROM TO",
    help="Distances from the flare to compare, px",
)
@NOISE
@SATURATION
@JSON
@PLOT
@writes_files
def flare(
    image: Path,
    background: Path,
    psf_file: Path,
    centre: tuple[int, int] | None,
    arm_deg: float | None,
    distances_px: tuple[float, float],
    noise: tuple[float, float] | None,
    saturation_dn: float | None,
    json_file: Path | None,
    plot: Path | None,
    overwrite: bool,
) -> None:
    """Simulate the stray light of the flare in IMAGE with a PSF, and compare it along a diffraction arm."""
    from psfcore.fits.images import read_image
    from psfcore.fits.psfs import read_psf
    from psfcore.flare.arm_profile_plot import flare_png
    from psfcore.flare.judge import judge_on_flare, summary_lines
    from psfcore.noise import Noise

    with user_errors():
        psf = read_psf(psf_file, limits())
        found = judge_on_flare(
            read_image(image, limits(), saturation_dn=saturation_dn),
            read_image(background, limits(), saturation_dn=saturation_dn),
            psf,
            centre_xy=centre,
            arm_deg=arm_deg,
            distances_px=distances_px,
            noise=None if noise is None else Noise(*noise),
        )
        if plot is not None:
            with written(plot, overwrite=overwrite) as picture:
                flare_png(found.difference, found.usable, found.comparison, picture, unit=found.unit)
    click.echo("\n".join(summary_lines(found.comparison)))
    if json_file is not None:
        inputs = {"image": image.name, "background": background.name, "psf": f"{psf.name} {psf.version}"}
        write_json(json_file, inputs | found.comparison.as_json(), overwrite=overwrite)


COMMANDS = (flare,)
