"""Commands about diffraction that run in this process: fresnel, arms, design; and what ``psf show`` says.

Everything numerical is imported by the command that needs it, so that the others start fast.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import click

from service.cli.options import (
    FILE,
    OUTPUT,
    PLOT,
    check_writable,
    limits,
    progress_bar,
    user_errors,
    write_json,
)

SHOWN_RADII_PX = (0.5, 1, 2, 5, 10, 11.5, 20, 50, 100, 200, 500, 1000)


def show(file: Path, plot: Path | None) -> list[str]:
    """What a PSF file holds, in lines; and its picture where asked."""
    import numpy as np

    from psfcore.drawing.plots import psf_png
    from psfcore.fits.psfs import read_psf
    from psfcore.psf import cumulative_curve

    psf = read_psf(file, limits())
    if plot is not None:
        psf_png(psf, plot)
    radii = np.array([r for r in SHOWN_RADII_PX if r < psf.reach_px])
    parts = {"TOTAL": psf.kernel, **psf.components}
    curves = {name: cumulative_curve(kernel, radii) for name, kernel in parts.items()}
    lines = [
        f"{psf.name} {psf.version} ({psf.status}), instrument {psf.instrument or 'unnamed'}",
        f"{psf.kernel.shape[1]} x {psf.kernel.shape[0]} px, reach {psf.reach_px:.0f} px, sum {psf.kernel.sum():.6f}, "
        f"central pixel {psf.kernel.max():.4f}, scale {psf.plate_scale_arcsec or 'unknown'} arcsec/px",
        "",
        "light farther than R, or off the array, in percent:",
        f"{'R (px)':>8}" + "".join(f"{name:>15}" for name in parts),
    ]
    for n, radius in enumerate(radii):
        lines.append(f"{radius:>8g}" + "".join(f"{curve[n]:>15.3f}" for curve in curves.values()))
    return lines


def mask_as_fits(instrument_file: Path, folder: Path) -> Path | None:
    """The mask image that an instrument file names, written as FITS to ``folder``; None where it names none."""
    from astropy.io import fits

    from psfcore.fits.mask_file import read_mask_image
    from psfcore.instruments.model import load_instrument

    mount = load_instrument(instrument_file).mount
    if mount is None or mount.mask_image is None:
        return None
    path = folder / "mask.fits"
    fits.PrimaryHDU(read_mask_image(instrument_file.parent / mount.mask_image.file)).writeto(path)
    return path


@click.command()
@click.option("--instrument", default="hri_euv", show_default=True, metavar="NAME|FILE")
@click.option("--json", "json_file", type=OUTPUT, help="Write everything found")
@PLOT
@click.option("--distances", help="Filter wheel to detector, mm, as 50,273,550 [default: the paper's seven]")
@click.option(
    "--phases", default=16, show_default=True, type=click.IntRange(1, 256), help="Positions of the mesh"
)
@click.option(
    "--windows", type=click.IntRange(1), help="Windows of the analytic series [default: the instrument's]"
)
def fresnel(
    instrument: str,
    json_file: Path | None,
    plot: Path | None,
    distances: str | None,
    phases: int,
    windows: int | None,
) -> None:
    """Compare the combined diffraction with Fresnel propagation through the telescope, in one dimension."""
    from psfcore.diffraction.fresnel_study import DISTANCES_MM, fresnel_study
    from psfcore.diffraction.plots import fresnel_png
    from psfcore.instruments.model import load_instrument

    check_writable(json_file, plot)
    with user_errors(), progress_bar() as report:
        wanted = DISTANCES_MM if distances is None else _numbers("--distances", distances)
        study = fresnel_study(
            load_instrument(instrument),
            distances_mm=wanted,
            phases=phases,
            windows=windows,
            progress=lambda done, of: report("distances", done, of),
        )
        if plot is not None:
            fresnel_png(study, plot)
    focus = study.focus
    click.echo(
        f"best focus: mirrors {focus.separation_mm:.3f} mm apart, {focus.shift_mm:+.3f} mm from the drawing "
        f"(which blurs by {focus.printed_blur_px:.0f} px); focal length {focus.focal_length_mm:.1f} mm"
    )
    click.echo("distance (mm)   largest difference, mean over phases   single phases")
    for at in study.distances:
        click.echo(
            f"{at.distance_mm:>13g}   {at.largest_points:>25.2f} points   up to {at.largest_single_points:.2f} points"
        )
    write_json(json_file, study.as_json())


@click.command()
@click.argument("image", type=FILE)
@click.option("--before", type=FILE, help="An image of the same frame before the flare, to subtract")
@click.option("--centre", help="The flare, as x,y in pixels [default: found]")
@click.option(
    "--arms", "n_arms", default=2, show_default=True, type=click.IntRange(1, 8), help="Lines of peaks"
)
@click.option("--saturation", type=float, help="Level in the image's unit from which pixels are not trusted")
@click.option("--json", "json_file", type=OUTPUT, help="Write what was found")
@PLOT
def arms(
    image: Path,
    before: Path | None,
    centre: str | None,
    n_arms: int,
    saturation: float | None,
    json_file: Path | None,
    plot: Path | None,
) -> None:
    """Measure the diffraction arms round a flare in IMAGE: their angles and the spacing of their peaks."""
    from psfcore.fits.images import read_image
    from psfcore.flare.arms import measure_arms
    from psfcore.flare.arms_plot import arms_png

    check_writable(json_file, plot)
    with user_errors():
        flare = read_image(image, limits(), saturation_dn=saturation)
        reference = None if before is None else read_image(before, limits()).pixels
        found = measure_arms(
            flare.pixels,
            None if centre is None else _pair("--centre", centre),
            reference=reference,
            saturated=~flare.valid,
            n_arms=n_arms,
        )
        if plot is not None:
            arms_png(flare.pixels, found, plot)
    for angle, sigma in zip(found.angles_deg, found.angles_sigma_deg, strict=True):
        click.echo(f"arm at {angle:8.3f} +- {sigma:.3f} degrees from +x towards +y")
    click.echo(f"spacing  {found.spacing_px:8.4f} +- {found.spacing_sigma_px:.4f} px")
    write_json(
        json_file,
        {
            "angles_deg": found.angles_deg,
            "angles_sigma_deg": found.angles_sigma_deg,
            "spacing_px": found.spacing_px,
            "spacing_sigma_px": found.spacing_sigma_px,
            "centre_xy": found.centre_xy,
            "reduced_chi2": found.reduced_chi2,
            "peaks": [dataclasses.asdict(peak) for peak in found.peaks],
            "stopped_because": found.stopped_because,
        },
    )


@click.command()
@click.option("--instrument", default="hri_euv", show_default=True, metavar="NAME|FILE")
@click.option("--pitches", default="400,635,800,1000,1270,1600,2000", show_default=True, help="um")
@click.option("--wires", default="20,30,40,60", show_default=True, help="um")
@click.option("--json", "json_file", type=OUTPUT, help="Write the table")
@PLOT
def design(instrument: str, pitches: str, wires: str, json_file: Path | None, plot: Path | None) -> None:
    """Tabulate what the entrance mesh's pitch and wire width do to the diffracted light."""
    from psfcore.diffraction.design_plot import design_png
    from psfcore.diffraction.design_study import design_study
    from psfcore.instruments.model import load_instrument

    check_writable(json_file, plot)
    with user_errors():
        study = design_study(
            load_instrument(instrument), _numbers("--pitches", pitches), _numbers("--wires", wires)
        )
        if plot is not None:
            design_png(study, plot)
    names = [field.name for field in dataclasses.fields(study.rows[0])]
    click.echo("  ".join(names))
    for row in study.rows:
        values = (getattr(row, name) for name in names)
        texts = (f"{value:.4g}" if isinstance(value, float) else str(value) for value in values)
        click.echo("  ".join(f"{text:>{len(name)}}" for text, name in zip(texts, names, strict=True)))
    write_json(json_file, dataclasses.asdict(study))


COMMANDS = (fresnel, arms, design)


def _numbers(option: str, text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise click.BadParameter(f"expected numbers and commas; got {text!r}", param_hint=option) from error


def _pair(option: str, text: str) -> tuple[float, float]:
    numbers = _numbers(option, text)
    if len(numbers) != 2:
        raise click.BadParameter(f"expected x,y; got {text!r}", param_hint=option)
    return numbers[0], numbers[1]
