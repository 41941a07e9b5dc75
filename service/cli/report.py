"""The command ``report``: a transit and its PSF as one page that can be read, printed and sent."""

from __future__ import annotations

from pathlib import Path

import click

from service.cli.connection import LOCAL, SERVER, connection, named_psf
from service.cli.options import NOISE, OUTPUT, SATURATION, check_writable, progress_bar, user_errors


@click.command()
@click.argument("transit", type=click.Path(exists=True, path_type=Path))
@click.option("-o", "--output", required=True, type=OUTPUT, help="The page (HTML)")
@click.option("--json", "json_file", type=OUTPUT, help="Write all of its numbers too")
@click.option("--psf", metavar="ID|FILE", help="A PSF to judge as it is [default: fit the transit]")
@click.option("--dark-offsets/--no-dark-offsets", default=True, help="Also fit with wrong dark levels (slow)")
@click.option("--seed", type=click.IntRange(0, 2**31 - 1), default=1, show_default=True, help="Of all draws")
@NOISE
@SATURATION
@SERVER
@LOCAL
def report(
    transit: Path,
    output: Path,
    json_file: Path | None,
    psf: str | None,
    dark_offsets: bool,
    seed: int,
    noise: tuple[float, float] | None,
    saturation_dn: float | None,
    server: str | None,
    local: bool,
) -> None:
    """Show what TRANSIT, a folder (or a .zip or .tar of one) with a transit.json, says of a PSF: one HTML page."""
    check_writable(output, json_file)
    with user_errors(), connection(server, local) as service, progress_bar() as say:
        found = service.evaluate(
            transit,
            json_file,
            page=output,
            progress=say,
            noise=noise or None,
            psf_id=named_psf(service, psf),
            seed=seed,
            dark_offsets=dark_offsets,
            saturation_dn=saturation_dn,
        )
    click.echo(f"{output}: {found['details']['sentence']}")
    for limit in found["details"]["limits"]:
        click.echo(f"  note: {limit}")
    for missing in found["details"]["not_shown"]:
        click.echo(f"  not shown: {missing['what']} ({missing['why']})")


COMMANDS = (report,)
