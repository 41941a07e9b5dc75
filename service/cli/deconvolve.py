"""The command ``deconvolve``: deconvolves one image into a file, or many images into a folder."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import click

from psfcore.deconvolve.box import Box
from psfcore.errors import DataError
from service.cli.connection import CONTEXT, LOCAL, PSF, SERVER, connection, named_psf, short
from service.cli.options import (
    METHOD,
    NOISE,
    OTHER_CHANNEL,
    OUTPUT,
    SATURATION,
    STEPS,
    OutputPlace,
    Place,
    counted,
    fits_files,
    percent,
    progress_bar,
    say_warnings,
    user_errors,
    writes_files,
)
from service.cli.progress import Report
from service.client.many import Outcome, deconvolve_many
from service.client.operations import Operations
from service.client.outputs import check_output_folder, check_outputs
from service.start import STARTED

AGAIN = click.option(
    "--again", is_flag=True, help="Deconvolve files whose header says that they are products or PSFs"
)


def _region(context: click.Context, parameter: click.Parameter, text: str | None) -> str | None:
    """The text of a region, if it has the right form."""
    if text is not None:
        try:
            Box.parse(text)
        except DataError as error:
            raise click.BadParameter(error.message, context, parameter) from error
    return text


@click.command()
@click.argument("images", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option(
    "-o",
    "--output",
    required=True,
    type=OutputPlace(decides=True),
    metavar="FILE|FOLDER/",
    help="Write the deconvolved image (FITS) to this file; several images: to this folder",
)
@PSF
@OTHER_CHANNEL
@CONTEXT
@METHOD
@STEPS
@click.option("--stop", type=click.Choice(["fixed", "discrepancy"]), help="When to stop [default: fixed]")
@click.option(
    "--edges",
    type=click.Choice(["zero", "symmetric", "extended"]),
    help="Assumed scene outside the image [default: depends on the method]",
)
@click.option("--hdu", type=click.IntRange(0), metavar="N", help="HDU of the image [default: first]")
@click.option(
    "--plate-scale",
    "plate_scale_arcsec",
    type=click.FloatRange(0, min_open=True),
    metavar="ARCSEC",
    help="Plate scale of a PSF without one",
)
@click.option(
    "--region",
    metavar="X0:X1,Y0:Y1",
    callback=_region,
    help="Deconvolve only this box, in pixels from 0 (X0 <= x < X1); the output is the box",
)
@click.option(
    "--region-error",
    type=click.FloatRange(0, 1, min_open=True),
    metavar="SHARE",
    help="Largest bound of the error of the region, as a share of its mean light; sets the rim [default: 0.05]",
)
@NOISE
@SATURATION
@click.option(
    "--errors",
    "error_draws",
    type=click.IntRange(0, 64),
    default=0,
    metavar="N",
    help="Add an ERROR plane from N >= 2 noise realisations; each takes as long as one deconvolution",
)
@click.option("--plot", type=OUTPUT, help="Write the image before and after (PNG)")
@click.option("--changes", type=OUTPUT, help="Write difference, ratio and histograms (PNG)")
@click.option("--timings", is_flag=True, help="Print how long each stage of the command took; needs --local")
@AGAIN
@SERVER
@LOCAL
@writes_files
def deconvolve(
    images: tuple[Path, ...],
    output: Place,
    psf: str | None,
    other_channel: bool,
    context: str | None,
    method: str,
    steps: int | None,
    stop: str | None,
    edges: str | None,
    hdu: int | None,
    plate_scale_arcsec: float | None,
    region: str | None,
    region_error: float | None,
    noise: tuple[float, float] | None,
    saturation_dn: float | None,
    error_draws: int,
    plot: Path | None,
    changes: Path | None,
    timings: bool,
    again: bool,
    server: str | None,
    local: bool,
    overwrite: bool,
) -> None:
    """Deconvolve IMAGES (FITS files, or folders of them) with the PSF of their instrument, or with the PSF that you name.

    The output is a folder if there are several images, or if its name ends in /. Images whose product is in the folder
    are skipped. At most four jobs are open on a service at the same time. If an image fails, the command continues with
    the others and lists the failures at the end; the exit status is then 1.
    """
    files = fits_files(images)
    if not files:
        raise click.UsageError("expected FITS files; the folders that you named contain none")
    parameters: dict[str, Any] = {
        "context": context,
        "method": method,
        "noise": noise or None,
        "saturation_dn": saturation_dn,
        "error_draws": error_draws,
        "steps": steps,
        "stop": stop,
        "edges": edges,
        "hdu": hdu,
        "plate_scale_arcsec": plate_scale_arcsec,
        "region": region,
        "region_error": region_error,
        "other_channel": other_channel,
        "again": again,
        "overwrite": overwrite,
    }
    if timings and not local:
        raise click.UsageError(
            "--timings: expected --local, because a service measures the stages of all jobs together; see its /metrics"
        )
    into_folder = len(files) > 1 or any(path.is_dir() for path in images) or output.is_folder
    if into_folder and (plot or changes):
        raise click.UsageError(
            "--plot and --changes: expected one image and an output file; for several images use `heliopsf changes`"
        )
    with user_errors():
        psf_files = [Path(psf)] if psf and Path(psf).is_file() else []
        if into_folder:
            check_output_folder(output.path)
        else:
            check_outputs((output.path, plot, changes), inputs=[*files, *psf_files], overwrite=overwrite)
    with (
        user_errors(),
        connection(server, local, previews=plot is not None) as service,
        progress_bar() as report,
    ):
        parameters["psf_id"] = named_psf(service, psf)
        if not into_folder:
            lines = _one(service, files[0], output.path, plot, changes, report, parameters)
            failures: list[Outcome] = []
        else:
            lines, failures = _many(service, files, output.path, report, parameters)
        if timings:
            lines += _timings(service)
    click.echo("\n".join(lines))
    if failures:
        raise click.ClickException(
            f"{len(failures)} of {counted(len(files), 'image')} failed; see the list above"
        )


def _timings(service: Operations) -> list[str]:
    """The lines that say how long each stage took: the stages of the job, and the rest of the command."""
    from service.local import LocalService  # already loaded: the option needs --local

    assert isinstance(service, LocalService)
    spent = service.stage_seconds()
    whole = time.perf_counter() - STARTED
    rows = [
        *sorted(spent.items(), key=lambda row: -row[1]),
        ("Python, libraries, output", whole - sum(spent.values())),
    ]
    return [f"{seconds:7.2f} s  {stage}" for stage, seconds in rows] + [f"{whole:7.2f} s  whole command"]


def _one(
    service: Operations,
    image: Path,
    output: Path,
    plot: Path | None,
    changes: Path | None,
    report: Report,
    parameters: dict[str, Any],
) -> list[str]:
    """Deconvolve one image into a file; returns the lines to print."""
    product = service.deconvolve(image, output, preview=plot, changes=changes, progress=report, **parameters)
    say_warnings(product)
    details = product["details"]
    return [
        f"{output}: PSF {product['psf_version']}, product {short(product['id'])}",
        f"{details['steps_done']} steps ({details['stopped_because']}), edges {details['edges']}",
        *_told_region(details),
        f"flux {percent(details['flux_change_pct'], 3)}, brightest 1 % of pixels "
        f"{percent(details['bright_change_pct'])}, darkest 1 % {percent(details['dark_change_pct'])}",
    ]


def _told_region(details: dict[str, Any]) -> list[str]:
    """The line about the region that was deconvolved."""
    found = details.get("region")  # products of earlier versions have no such detail
    if found is None:
        return []
    return [
        f"region {found['box']}, rim {found['rim_px']} px: differs from the same pixels of the whole image by at most "
        f"{found['error']:.3g} (estimated bound, in the unit of the image)"
    ]


def _many(
    service: Operations, files: list[Path], folder: Path, report: Report, parameters: dict[str, Any]
) -> tuple[list[str], list[Outcome]]:
    """Deconvolve images into a folder; returns the lines to print, and the failures."""
    outcomes = list(
        deconvolve_many(
            service, files, folder, progress=lambda done, of: report("images", done, of), **parameters
        )
    )
    for one in outcomes:
        for warning in one.warnings:
            click.echo(f"warning: {one.image}: {warning}", err=True)
    failures = [one for one in outcomes if one.failure is not None]
    existed = sum(one.existed for one in outcomes)
    done = len(outcomes) - len(failures) - existed
    lines = [f"{one.image}: {one.output}" for one in outcomes if one.failure is None and not one.existed]
    lines += [f"failed: {one.image}: {one.failure}" for one in failures]
    return [
        *lines,
        f"{counted(len(outcomes), 'image')}: {done} deconvolved, {existed} existed already, {len(failures)} failed",
    ], failures
