"""The commands ``psf series`` and ``psf interpolate``: PSFs that change with time."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from service.cli.connection import ID, SERVER, remote, short, whole_id
from service.cli.options import OUTPUT, progress_bar, user_errors, writes_files
from service.cli.psf.make import say_fit

if TYPE_CHECKING:
    from service.client.http import Client


@click.command("series")
@click.argument("series", required=False, metavar="[SERIES]")
@click.option(
    "--interpolate/--no-interpolate",
    "interpolated",
    default=None,
    help="Allow or forbid interpolation between the certified PSFs of SERIES",
)
@click.option("--reason", default="", help="Reason, kept in the history")
@SERVER
def series(series: str | None, interpolated: bool | None, reason: str, server: str | None) -> None:
    """List the series of which a PSF was certified, or say whether the PSFs of SERIES may be interpolated in time.

    SERIES is instrument/channel/kind, such as hri_euv/174/total. If its PSFs may be interpolated, an image whose time is
    between the ranges of two certified PSFs is deconvolved with a PSF between the two. Contexts that exist do not change.
    """
    if (series is None) != (interpolated is None):
        raise click.UsageError(
            "expected SERIES with --interpolate or --no-interpolate, or neither; got only one of them"
        )
    with user_errors(), remote(server) as service:
        if series is not None and interpolated is not None:
            rows = [service.interpolate_series(series, interpolated, reason=reason)]
        else:
            rows = list(service.series())
    if not rows:
        click.echo("no series yet; `heliopsf psf certify` begins a series")
    for row in rows:
        click.echo(f"{row['series']}  {'may be interpolated' if row['interpolated'] else 'not interpolated'}")


@click.command("interpolate")
@click.argument("before", type=ID, metavar="BEFORE")
@click.argument("after", type=ID, metavar="AFTER")
@click.option("--time", required=True, metavar="TIME", help="Time of the new PSF, such as 2024-03-01")
@click.option(
    "--before-until",
    metavar="TIME",
    help="Last time at which BEFORE holds [default: the end of its range]",
)
@click.option(
    "--after-from", metavar="TIME", help="First time at which AFTER holds [default: the start of its range]"
)
@click.option("-o", "--output", type=OUTPUT, help="Write the PSF (FITS)")
@SERVER
@writes_files
def interpolate(
    before: str,
    after: str,
    time: str,
    before_until: str | None,
    after_from: str | None,
    output: Path | None,
    server: str | None,
    overwrite: bool,
) -> None:
    """Interpolate between two fitted PSFs, BEFORE and AFTER, in time. Both must have the same shape and diffraction PSF.

    The new PSF is a draft. `heliopsf psf series --interpolate` lets deconvolutions do this by themselves.
    """
    with user_errors(), remote(server) as service, progress_bar() as report:
        first, second = (whole_id(service, "psfs", one) for one in (before, after))
        made = service.interpolate_psf(
            first,
            second,
            time,
            before_time=before_until or _end(service, first, "valid_to", "--before-until"),
            after_time=after_from or _end(service, second, "valid_from", "--after-from"),
            progress=report,
        )
        if output is not None:
            service.download(made["file"], output, overwrite=overwrite)
    click.echo(f"{short(made['id'])}  {made['name']}  {made['version']}  {made['status']}")
    say_fit(made["details"]["fit"])


def _end(service: Client, psf_id: str, name: str, option: str) -> str:
    """The end or the start of the range for which a PSF is certified."""
    at: str | None = service.psf(psf_id)[name]
    if at is None:
        raise click.UsageError(
            f"expected {option}, because PSF {short(psf_id)} has no {'end' if name == 'valid_to' else 'start'} of a range of times"
        )
    return at


COMMANDS = (series, interpolate)
