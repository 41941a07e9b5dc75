"""``heliopsf gap``: where the fitted model and the images of a transit part, and which effect explains it."""

from __future__ import annotations

import json
from pathlib import Path

import click

from psfcore.errors import DataError
from psfcore.gap.diagnose import diagnose
from psfcore.gap.evidence import gather
from psfcore.gap.library import LIBRARY
from psfcore.header import FitsLimits
from psfcore.noise import Noise
from psfcore.scatter.inversion import invert
from psfcore.scatter.shapes import SOFTENED_POWER_LAW
from psfcore.transit.folder import read_transit
from workers.settings import Settings, cores


@click.command()
@click.argument("transit", type=click.Path(exists=True, file_okay=False, path_type=Path))
@click.option(
    "--json",
    "report_file",
    required=True,
    type=click.Path(dir_okay=False, path_type=Path),
    help="Write the report",
)
@click.option("--noise", nargs=2, type=float, metavar="GAIN READ", help="DN a photon, DN rms of the readout")
def gap(transit: Path, report_file: Path, noise: tuple[float, float] | None) -> None:
    """Diagnose the gap between the images of TRANSIT, a folder, and the model fitted to them."""
    if not report_file.resolve().parent.is_dir():
        raise click.ClickException(
            f"cannot write {report_file}: there is no folder {report_file.resolve().parent}"
        )
    try:
        read = read_transit(
            transit, FitsLimits(max_pixels=Settings().max_pixels), noise=Noise(*noise) if noise else None
        )
        found = diagnose(gather(invert(read, SOFTENED_POWER_LAW, threads=cores()), LIBRARY))
    except DataError as error:
        raise click.ClickException(error.message) from error
    report = found.to_json() | {"inputs_sha256": read.sha256}
    report_file.write_text(json.dumps(report, indent=1, allow_nan=False), "utf-8")
    click.echo(found.sentence)
    click.echo(f"verdict: {found.verdict}" + (f" ({', '.join(found.answer)})" if found.answer else ""))
    for effect in report["effects"][:5]:
        closure = effect["closure"]
        closed = "" if closure is None else f", held-out closure {100 * closure['value']:.0f} %"
        numbers = ", ".join(
            f"{name} {p['value']:.3g} +- {p['sigma']:.2g} {p['unit']}".strip()
            for name, p in effect["parameters"].items()
        )
        click.echo(f"  {effect['name']:<24} p = {effect['p_value']:.2g}{closed}: {numbers}")
    for effect in report["untestable"]:
        click.echo(f"  not testable: {effect['name']} ({effect['why']})")


COMMANDS = (gap,)
