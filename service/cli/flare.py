"""The command ``flare``: tests a PSF on the stray light of a flare."""

from __future__ import annotations

from pathlib import Path

import click

from service.cli.connection import SERVER_FOR_IDS, psf_file, psf_option
from service.cli.options import (
    BACKGROUND,
    CENTRE,
    FILE,
    JSON,
    NOISE,
    PLOT,
    SATURATION,
    limits,
    psf_limits,
    user_errors,
    write_json,
    writes_files,
)
from service.cli.progress import echo
from service.client.outputs import written


@click.command()
@click.argument("image", type=FILE)
@click.option("--background", required=True, type=FILE, help=BACKGROUND)
@psf_option("PSF to test: an id or a file", required=True)
@CENTRE
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
    metavar="FROM TO",
    help="Distances from the flare to compare, px",
)
@NOISE
@SATURATION
@JSON
@PLOT
@SERVER_FOR_IDS
@writes_files
def flare(
    image: Path,
    background: Path,
    psf: str,
    centre: tuple[float, float] | None,
    arm_deg: float | None,
    distances_px: tuple[float, float],
    noise: tuple[float, float] | None,
    saturation_dn: float | None,
    json_file: Path | None,
    plot: Path | None,
    server: str | None,
    overwrite: bool,
) -> None:
    """Simulate the stray light of the flare in IMAGE with a PSF, and compare it along a diffraction arm."""
    from psfcore.fits.observation import read_observation
    from psfcore.fits.psfs import read_psf
    from psfcore.flare.judge import judge_on_flare, summary_lines
    from psfcore.flare.plots import flare_png
    from psfcore.noise import Noise

    with user_errors():
        with psf_file(server, psf) as file:
            tested = read_psf(file, psf_limits())
        found = judge_on_flare(
            read_observation(image, limits(), saturation_dn=saturation_dn),
            read_observation(background, limits(), saturation_dn=saturation_dn),
            tested,
            centre_xy=None if centre is None else (round(centre[0]), round(centre[1])),
            arm_deg=arm_deg,
            distances_px=distances_px,
            noise=None if noise is None else Noise(*noise),
        )
        if plot is not None:
            with written(plot, overwrite=overwrite) as picture:
                flare_png(found.difference, found.usable, found.comparison, picture, unit=found.unit)
    echo("\n".join(summary_lines(found.comparison)))
    if json_file is not None:
        inputs = {
            "image": image.name,
            "background": background.name,
            "psf": f"{tested.name} {tested.version}",
        }
        write_json(json_file, inputs | found.comparison.as_json(), overwrite=overwrite)


COMMANDS = (flare,)
