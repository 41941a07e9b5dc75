"""The commands ``simulate transit`` and ``simulate bound``: simulate transits whose PSF is known.

A command imports numerical libraries only when it is called, so that other commands start fast.
"""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from service.cli.options import (
    FILE,
    FOLDER,
    JSON,
    OUTPUT_FOLDER,
    check_fresh_folder,
    counted,
    limits,
    listed,
    write_json,
    writes_files,
)
from service.cli.progress import echo

if TYPE_CHECKING:
    from psfcore.simulate.bound import PhotonBound

THREADS = 2


@click.group(short_help="Simulate transits whose PSF is known.")
def simulate() -> None:
    """Simulate transits whose PSF is known, and compute how exactly a fit can recover this PSF."""


@simulate.command(short_help="Write a simulated transit.")
@click.option("-o", "--output", required=True, type=OUTPUT_FOLDER, help="Folder to write to")
@click.option(
    "--size", "size_px", default=512, type=click.IntRange(64, 4096), help="Width and height of an image, px"
)
@click.option("--images", default=30, type=click.IntRange(1, 1000), help="Number of images")
@click.option("--seed", default=1, type=click.IntRange(0), help="Seed of scenes and noise")
@click.option("--total", default=0.411, help="Fraction of light that is scattered, 0 to 1")
@click.option("--b", "b_px", default=6.15, help="Softening radius of the scatter kernel, px")
@click.option("--c", default=2.53, help="Exponent of the scatter kernel")
@click.option("--stretch", default=0.0, help="Stretch of the scatter kernel along --stretch-angle")
@click.option(
    "--stretch-angle",
    "angle_deg",
    default=0.0,
    help="Direction of stretch and dipole, degrees from +x towards +y",
)
@click.option("--dipole", default=0.0, help="Dipole (asymmetry) of the scatter kernel, -1 to 1")
@click.option(
    "--beyond",
    default="dark",
    type=click.Choice(["dark", "on"]),
    help="Sky outside the field of view. dark: no light; on: the scene continues",
)
@click.option(
    "--saturation",
    "saturation_dn",
    type=float,
    metavar="DN",
    help="Clip high-gain images at this level [default: no clipping]",
)
@click.option("--dark-offset", "dark_offset_dn", default=0.0, help="Offset to add to every pixel, DN")
@click.option(
    "--instrument",
    default="hri_euv",
    metavar="NAME|FILE",
    help="Use the diffraction PSF and the header keywords of this instrument",
)
@click.option(
    "--diffraction", type=FILE, help="Use this diffraction PSF (FITS, sum 1) instead of the instrument's"
)
@click.option(
    "--diffraction-size",
    type=int,
    help="Width and height of the instrument's diffraction PSF, px [default: 2 x size, at most 2048]",
)
@click.option(
    "--scene",
    "scene_files",
    multiple=True,
    type=FILE,
    help="Take the scene from this image (FITS). Give one image, or one for each pointing",
)
@click.option("--overwrite", is_flag=True, help="Write even if the folder is not empty; replace its files")
def transit(
    output: Path,
    seed: int,
    instrument: str,
    diffraction: Path | None,
    diffraction_size: int | None,
    scene_files: tuple[Path, ...],
    overwrite: bool,
    **parameters: Any,
) -> None:
    """Write a simulated transit, with its true PSF and scenes, to a folder."""
    from psfcore.instruments.model import load_instrument
    from psfcore.simulate.inputs import LARGEST_DIFFRACTION_PX, diffraction_kernel, scenes_from_files
    from psfcore.simulate.plan import default_plan
    from psfcore.simulate.scatter_truth import ScatterTruth
    from psfcore.simulate.transit import imitated, write
    from psfcore.simulate.transit import simulate as simulated

    given = [*scene_files, *(Path(one) for one in (diffraction, instrument) if one and Path(one).is_file())]
    check_fresh_folder(output, given, overwrite=overwrite)
    scatter = ScatterTruth(**{one.name: parameters.pop(one.name) for one in fields(ScatterTruth)})
    plan = default_plan(**parameters)
    edge = diffraction_size or min(2 * plan.size_px, LARGEST_DIFFRACTION_PX)
    known = diffraction_kernel(instrument, diffraction, edge, limits(), threads=THREADS)
    scenes = scenes_from_files(scene_files, plan, limits())
    of_instrument = imitated(load_instrument(instrument))
    made = simulated(plan, scatter, known, seed, scenes=scenes, imitated=of_instrument, threads=THREADS)
    try:
        write(made, output)
    except OSError as error:
        raise click.ClickException(f"cannot write {output}: {error.strerror or error}") from error
    exposures = sorted({shot.exposure_s for shot in plan.shots})
    echo(
        f"{output}: {counted(len(plan.shots), 'image')} of {plan.size_px} x {plan.size_px} px, "
        f"{counted(len(plan.pointings), 'pointing')}, "
        f"exposure{'s' if len(exposures) > 1 else ''} of {listed([f'{t:g}' for t in exposures])} s"
    )
    echo(
        f"scatter b {scatter.b_px:g} px, c {scatter.c:g}, total {scatter.total:g}; the file of true values is "
        f"{output / 'truth.json'}"
    )


@simulate.command(short_help="Compute the smallest possible errors.")
@click.argument("folder", type=FOLDER)
@JSON
@writes_files
def bound(folder: Path, json_file: Path | None, overwrite: bool) -> None:
    """Compute the smallest errors that photon and read noise allow for FOLDER, a simulated transit."""
    from psfcore.simulate.bound import bound_of_sky
    from psfcore.simulate.transit import read_sky

    found = bound_of_sky(read_sky(folder, threads=THREADS), threads=THREADS)
    write_json(json_file, found.to_json(), overwrite=overwrite)
    echo("\n".join(_lines(found)))


def _lines(found: PhotonBound) -> list[str]:
    places = [max(pair) for pair in found.places_px]
    return [
        f"smallest standard errors from {found.dark_pixels} occulted pixels in {counted(found.images, 'image')}:",
        f"b {found.b_px:.3g} px, c {found.c:.3g}, total {found.total:.3g}, a {found.a:.3g}",
        f"stretch {found.stretch:.3g} at {found.stretch_angle_deg:g} degrees",
        f"position of the occulter {min(places):.3f} to {max(places):.3f} px",
        "",
        "light beyond R in percent, and its error in percentage points:",
        f"{'R (px)':>8}{'total':>10}{'error':>8}{'diffuse':>10}{'error':>8}",
        *(
            f"{at.radius_px:>8g}{at.total_pct:>10.3f}{at.total_sigma:>8.3f}"
            f"{at.diffuse_pct:>10.3f}{at.diffuse_sigma:>8.3f}"
            for at in found.curve
        ),
    ]
