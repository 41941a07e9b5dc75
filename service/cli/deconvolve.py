"""The command ``deconvolve``: deconvolves one image."""

from __future__ import annotations

from pathlib import Path

import click

from service.cli.connection import CONTEXT, LOCAL, PSF, SERVER, connection, named_psf, short
from service.cli.options import (
    FILE,
    METHOD,
    NOISE,
    OUTPUT,
    SATURATION,
    STEPS,
    check_writable,
    percent,
    progress_bar,
    user_errors,
)


@click.command()
@click.argument("image", type=FILE)
@click.option("-o", "--output", required=True, type=OUTPUT, help="Write the deconvolved image (FITS)")
@PSF
@CONTEXT
@METHOD
@STEPS
@click.option("--stop", type=click.Choice(["fixed", "discrepancy"]), help="When to stop [default: fixed]")
@click.option(
    "--edges",
    type=click.Choice(["zero", "symmetric", "extended"]),
    help="Assumed scene outside the image [default: the method's own]",
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
@SERVER
@LOCAL
def deconvolve(
    image: Path,
    output: Path,
    psf: str | None,
    context: str | None,
    method: str,
    steps: int | None,
    stop: str | None,
    edges: str | None,
    noise: tuple[float, float] | None,
    saturation_dn: float | None,
    error_draws: int,
    plot: Path | None,
    changes: Path | None,
    server: str | None,
    local: bool,
) -> None:
    """Deconvolve IMAGE (FITS) with the PSF of its instrument, or with the PSF that you name."""
    check_writable(output, plot, changes)
    with user_errors(), connection(server, local) as service, progress_bar() as report:
        product = service.deconvolve(
            image,
            output,
            psf_id=named_psf(service, psf),
            context=context,
            method=method,
            preview=plot,
            progress=report,
            noise=noise or None,
            saturation_dn=saturation_dn,
            error_draws=error_draws,
            changes=changes,
            steps=steps,
            stop=stop,
            edges=edges,
        )
    details = product["details"]
    click.echo(f"{output}: PSF {product['psf_version']}, product {short(product['id'])}")
    click.echo(f"{details['steps_done']} steps ({details['stopped_because']}), edges {details['edges']}")
    click.echo(
        f"flux {percent(details['flux_change_pct'], 3)}, brightest 1 % of pixels "
        f"{percent(details['bright_change_pct'])}, darkest 1 % {percent(details['dark_change_pct'])}"
    )
