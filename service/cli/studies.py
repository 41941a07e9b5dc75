"""The studies ``fresnel``, ``arms``, ``flare`` and ``design``, which run in this process.

A command imports numerical libraries only when it is called, so that other commands start fast.
"""

from __future__ import annotations

import dataclasses
from functools import partial
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
    Text,
    limits,
    psf_limits,
    write_file,
    write_json,
    writes_files,
)
from service.cli.progress import echo, progress_bar

INSTRUMENT = click.option("--instrument", default="hri_euv", metavar="NAME|FILE",
                          help="A known instrument, or an instrument file (TOML)")  # fmt: skip


def _numbers(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise ValueError(f"expected numbers separated by commas; got {text!r}") from error


NUMBERS = Text(_numbers)
ARM_NUMBERS = (
    "angles_deg", "angles_sigma_deg", "spacing_px", "spacing_sigma_px", "centre_xy", "reduced_chi2",
)  # fmt: skip


@click.command()
@INSTRUMENT
@JSON
@PLOT
@click.option(
    "--distances",
    type=NUMBERS,
    help="Distances from filter wheel to detector, mm, such as 50,273,550 [default: the seven distances of the paper]",
)
@click.option("--phases", default=16, type=click.IntRange(1, 256),
              help="Number of mesh positions to average")  # fmt: skip
@click.option("--windows", type=click.IntRange(1),
              help="Number of terms of the analytic series [default: from the instrument file]")  # fmt: skip
@writes_files
def fresnel(
    instrument: str,
    json_file: Path | None,
    plot: Path | None,
    distances: tuple[float, ...] | None,
    phases: int,
    windows: int | None,
    overwrite: bool,
) -> None:
    """Compare the combined diffraction of all meshes with Fresnel propagation through the telescope, in one
    dimension.
    """
    from psfcore.diffraction.fresnel_study import DISTANCES_MM, fresnel_study
    from psfcore.diffraction.plots import fresnel_png
    from psfcore.instruments.model import load_instrument

    with progress_bar() as report:
        study = fresnel_study(
            load_instrument(instrument),
            distances_mm=DISTANCES_MM if distances is None else distances,
            phases=phases,
            windows=windows,
            progress=lambda done, of: report("distances", done, of),
        )
        write_file(plot, partial(fresnel_png, study), overwrite=overwrite)
    focus = study.focus
    echo(
        f"best focus: mirrors {focus.separation_mm:.3f} mm apart, {focus.shift_mm:+.3f} mm from the distance in the "
        f"drawing (the drawing gives a blur of {focus.printed_blur_px:.0f} px); focal length "
        f"{focus.focal_length_mm:.1f} mm"
    )
    echo("distance (mm)   largest difference, mean over phases   single phases")
    for at in study.distances:
        echo(
            f"{at.distance_mm:>13g}   {at.largest_points:>25.2f} points   up to {at.largest_single_points:.2f} points"
        )
    write_json(json_file, study.as_json(), overwrite=overwrite)


@click.command()
@click.argument("image", type=FILE)
@click.option("--background", type=FILE, help=f"{BACKGROUND}, to subtract")
@CENTRE
@click.option("--arms", "n_arms", default=2, type=click.IntRange(1, 8),
              help="Number of arms (lines of peaks) to fit")  # fmt: skip
@SATURATION
@JSON
@PLOT
@writes_files
def arms(
    image: Path,
    background: Path | None,
    centre_xy: tuple[float, float] | None,
    n_arms: int,
    saturation_dn: float | None,
    json_file: Path | None,
    plot: Path | None,
    overwrite: bool,
) -> None:
    """Measure the diffraction arms around a flare in IMAGE (FITS): their angles, and the spacing of their peaks."""
    import numpy as np

    from psfcore.fits.observation import read_observation
    from psfcore.fits.units import unit_label
    from psfcore.flare.arms import measure_arms
    from psfcore.flare.plots import arms_png

    flare = read_observation(image, limits(), saturation_dn=saturation_dn)
    reference = None
    if background is not None:
        before = read_observation(background, limits(), saturation_dn=saturation_dn)
        reference = np.where(before.valid, before.pixels, np.nan)
    measured = measure_arms(
        flare.pixels, centre_xy, reference=reference, saturated=~flare.valid, n_arms=n_arms
    )
    draw = partial(arms_png, flare.pixels, measured, unit=unit_label(flare))
    write_file(plot, draw, overwrite=overwrite)
    for angle, sigma in zip(measured.angles_deg, measured.angles_sigma_deg, strict=True):
        echo(f"arm at {angle:8.3f} ± {sigma:.3f} degrees from +x towards +y")
    echo(f"spacing  {measured.spacing_px:8.4f} ± {measured.spacing_sigma_px:.4f} px")
    numbers = {name: getattr(measured, name) for name in ARM_NUMBERS}
    numbers |= {
        "peaks": [dataclasses.asdict(peak) for peak in measured.peaks],
        "stopped_because": measured.stopped_because,
    }
    write_json(json_file, numbers, overwrite=overwrite)


@click.command()
@INSTRUMENT
@click.option(
    "--pitches", type=NUMBERS, default="400,635,800,1000,1270,1600,2000", help="Mesh pitches to try, um"
)
@click.option("--wires", type=NUMBERS, default="20,30,40,60", help="Wire widths to try, um")
@JSON
@PLOT
@writes_files
def design(
    instrument: str,
    pitches: tuple[float, ...],
    wires: tuple[float, ...],
    json_file: Path | None,
    plot: Path | None,
    overwrite: bool,
) -> None:
    """Tabulate the diffracted light for combinations of pitch and wire width of the entrance mesh."""
    from psfcore.diffraction.design_study import design_study
    from psfcore.diffraction.plots import design_png
    from psfcore.instruments.model import load_instrument

    study = design_study(load_instrument(instrument), pitches, wires)
    write_file(plot, partial(design_png, study), overwrite=overwrite)
    names = [field.name for field in dataclasses.fields(study.rows[0])]
    echo("  ".join(names))
    for row in study.rows:
        values = (getattr(row, name) for name in names)
        texts = (f"{value:.4g}" if isinstance(value, float) else str(value) for value in values)
        echo("  ".join(f"{text:>{len(name)}}" for text, name in zip(texts, names, strict=True)))
    write_json(json_file, dataclasses.asdict(study), overwrite=overwrite)


# --- a flare --------------------------------------------------------------------------------------------


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
    *,
    centre_xy: tuple[float, float] | None,
    arm_deg: float | None,
    distances_px: tuple[float, float],
    noise: tuple[float, float] | None,
    saturation_dn: float | None,
    json_file: Path | None,
    plot: Path | None,
    overwrite: bool,
) -> None:
    """Simulate the stray light of the flare in IMAGE with a PSF, and compare it along a diffraction arm."""
    from psfcore.fits.observation import read_observation
    from psfcore.fits.psfs import read_psf
    from psfcore.flare.judge import judge_on_flare, summary_lines
    from psfcore.flare.plots import flare_png
    from psfcore.noise import Noise

    with psf_file(psf) as file:
        tested = read_psf(file, psf_limits())
    found = judge_on_flare(
        read_observation(image, limits(), saturation_dn=saturation_dn),
        read_observation(background, limits(), saturation_dn=saturation_dn),
        tested,
        centre_xy=centre_xy,
        arm_deg=arm_deg,
        distances_px=distances_px,
        noise=None if noise is None else Noise(*noise),
    )
    draw = partial(flare_png, found.difference, found.usable, found.comparison, unit=found.unit)
    write_file(plot, draw, overwrite=overwrite)
    echo("\n".join(summary_lines(found.comparison)))
    if json_file is not None:
        inputs = {
            "image": image.name,
            "background": background.name,
            "psf": f"{tested.name} {tested.version}",
        }
        write_json(json_file, inputs | found.comparison.as_json(), overwrite=overwrite)
