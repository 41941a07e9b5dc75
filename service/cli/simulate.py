"""Commands about transits whose truth is known: ``simulate transit`` and ``simulate bound``.

Everything numerical is imported by the command that needs it, so that the others start fast.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from service.cli.options import (
    FILE,
    FOLDER,
    OUTPUT,
    OUTPUT_FOLDER,
    check_fresh_folder,
    check_writable,
    limits,
    user_errors,
    write_json,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from psfcore.simulate.bound import PhotonBound
    from psfcore.simulate.plan import Plan

LARGEST_DIFFRACTION_PX = 2048


@click.group()
def simulate() -> None:
    """Simulate transits whose truth is known, and say how well they can be analysed."""


@simulate.command()
@click.option("-o", "--output", required=True, type=OUTPUT_FOLDER, help="Folder to fill")
@click.option(
    "--size", default=512, show_default=True, type=click.IntRange(64, 4096), help="Edge of an image, px"
)
@click.option("--images", default=30, show_default=True, type=click.IntRange(1, 1000))
@click.option("--seed", default=1, show_default=True, type=click.IntRange(0), help="Of scenes and noise")
@click.option("--total", default=0.411, show_default=True, help="Light scattered out of its pixel, 0 to 1")
@click.option("--b", "b_px", default=6.15, show_default=True, help="Softening radius of the scatter, px")
@click.option("--c", default=2.53, show_default=True, help="Exponent of the scatter")
@click.option("--stretch", default=0.0, show_default=True, help="Stretch of the scatter along an angle")
@click.option(
    "--stretch-angle", default=0.0, show_default=True, help="Degrees from +x to +y; the dipole's too"
)
@click.option("--dipole", default=0.0, show_default=True, help="Lopsidedness of the scatter, -1 to 1")
@click.option(
    "--beyond", default="dark", show_default=True, type=click.Choice(["dark", "on"]), help="Outside the field"
)
@click.option("--saturation", type=float, help="DN that high-gain images clip at [default: none]")
@click.option("--dark-offset", default=0.0, show_default=True, help="DN added to every pixel")
@click.option(
    "--instrument",
    default="hri_euv",
    show_default=True,
    metavar="NAME|FILE",
    help="Instrument: its diffraction is built, its keywords are written",
)
@click.option(
    "--diffraction", type=FILE, help="A known diffraction (FITS), sum 1, in place of the instrument's"
)
@click.option("--diffraction-size", type=int, help="Edge of the one built, px [default: 2 x size, to 2048]")
@click.option(
    "--scene",
    "scene_files",
    multiple=True,
    type=FILE,
    help="An image (FITS) to take the Sun from: one for all pointings, or one each",
)
@click.option("--force", is_flag=True, help="Write into a folder that is not empty")
def transit(
    output: Path,
    size: int,
    images: int,
    seed: int,
    total: float,
    b_px: float,
    c: float,
    stretch: float,
    stretch_angle: float,
    dipole: float,
    beyond: str,
    saturation: float | None,
    dark_offset: float,
    instrument: str,
    diffraction: Path | None,
    diffraction_size: int | None,
    scene_files: tuple[Path, ...],
    force: bool,
) -> None:
    """Write a simulated transit with its truth into a folder."""
    from psfcore.instruments.model import load_instrument
    from psfcore.simulate.headers import imitated
    from psfcore.simulate.plan import default_plan
    from psfcore.simulate.scatter_truth import ScatterTruth
    from psfcore.simulate.transit import simulate as simulated
    from psfcore.simulate.transit_files import write

    check_fresh_folder(output, force=force)
    with user_errors():
        scatter = ScatterTruth(b_px, c, total, stretch, stretch_angle, dipole)
        plan = default_plan(images, size, beyond=beyond, saturation_dn=saturation, dark_offset_dn=dark_offset)
        known = _diffraction(
            diffraction, instrument, diffraction_size or min(2 * size, LARGEST_DIFFRACTION_PX)
        )
        scenes = _scenes(scene_files, plan)
        of_instrument = imitated(load_instrument(instrument))
        made = simulated(plan, scatter, known, seed, scenes=scenes, imitated=of_instrument, threads=2)
        try:
            write(made, output)
        except OSError as error:
            raise click.ClickException(f"cannot write {output}: {error.strerror or error}") from error
    exposures = sorted({shot.exposure_s for shot in plan.shots})
    click.echo(
        f"{output}: {images} images of {size} x {size} px, {len(plan.pointings)} pointings, "
        f"{', '.join(f'{t:g}' for t in exposures)} s"
    )
    click.echo(f"scatter b {b_px:g} px, c {c:g}, total {total:g}; the truth is in {output / 'truth.json'}")


@simulate.command()
@click.argument("folder", type=FOLDER)
@click.option("--json", "json_file", type=OUTPUT, help="Write all of it, with every image's place")
def bound(folder: Path, json_file: Path | None) -> None:
    """Say how well photons and readout let FOLDER, a simulated transit, be analysed at best."""
    from psfcore.simulate.bound import bound_of_folder

    check_writable(json_file)
    with user_errors():
        found = bound_of_folder(folder, threads=2)
    write_json(json_file, found.to_json())
    click.echo("\n".join(_lines(found)))


COMMANDS = (simulate,)


def _lines(found: PhotonBound) -> list[str]:
    places = [max(pair) for pair in found.places_px]
    return [
        f"smallest standard errors from {found.dark_pixels} dark pixels of {found.images} images:",
        f"b {found.b_px:.3g} px, c {found.c:.3g}, total {found.total:.3g}, a {found.a:.3g}",
        f"stretch {found.stretch:.3g} at {found.stretch_angle_deg:g} degrees",
        f"place of the occulter {min(places):.3f} to {max(places):.3f} px",
        "",
        "light farther than R, in percent, and its error in percentage points:",
        f"{'R (px)':>8}{'total':>10}{'error':>8}{'diffuse':>10}{'error':>8}",
        *(
            f"{at.radius_px:>8g}{at.total_pct:>10.3f}{at.total_sigma:>8.3f}"
            f"{at.diffuse_pct:>10.3f}{at.diffuse_sigma:>8.3f}"
            for at in found.curve
        ),
    ]


def _diffraction(file: Path | None, instrument: str, size: int) -> NDArray[np.float64]:
    """Weights that sum to 1 on their grid: read, or built for an instrument."""
    from psfcore.build import build_psf
    from psfcore.fits.images import read_plane
    from psfcore.instruments.model import load_instrument

    if file is not None:
        return read_plane(file, limits())
    kernel = build_psf(load_instrument(instrument), size=size, component="DIFFRACTION", threads=2).kernel
    return kernel / kernel.sum()


def _scenes(files: tuple[Path, ...], plan: Plan) -> dict[int, NDArray[np.float64]] | None:
    """A scene a pointing from images: one for all, mirrored for the west limb, or one each; None for none."""
    from psfcore.fits.images import read_image
    from psfcore.simulate.plan import WEST
    from psfcore.simulate.pointings import scene_from_image

    if not files:
        return None
    if len(files) not in (1, len(plan.views)):
        message = f"expected one image, or {len(plan.views)}, one a pointing; got {len(files)}"
        raise click.BadParameter(message, param_hint="--scene")
    scenes = {}
    for pointing in plan.pointings:
        image = read_image(files[(pointing - 1) % len(files)], limits())
        rate = image.pixels
        if (image.unit or "").replace(" ", "").lower() == "dn" and image.exposure_s is not None:
            rate = rate / image.exposure_s
        mirrored = len(files) == 1 and plan.views[pointing - 1] == WEST
        scenes[pointing] = scene_from_image(rate[:, ::-1] if mirrored else rate, plan)
    return scenes
