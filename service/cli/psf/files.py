"""The commands ``psf download`` and ``psf instruments``."""

from __future__ import annotations

from pathlib import Path

import click

from service.cli.connection import SERVER, id_argument, remote, short
from service.cli.options import JSON, OUTPUT_PLACE, PLOT, Place, user_errors, writes_files


@click.command("download")
@id_argument()
@click.option("-o", "--output", required=True, type=OUTPUT_PLACE, metavar="FILE|FOLDER/",
              help="Write the PSF (FITS) to this file, or into this folder")  # fmt: skip
@PLOT
@JSON
@SERVER
@writes_files
def download(
    identity: str,
    output: Place,
    plot: Path | None,
    json_file: Path | None,
    server: str | None,
    overwrite: bool,
) -> None:
    """Download a PSF, and if wanted its plot and the report of its fit."""
    with user_errors(), remote(server) as service:
        found = service.psf(identity)
        file = output.file(f"psf-{short(found['id'])}.fits")
        for part, path in (("file", file), ("preview", plot), ("report", json_file)):
            if path is not None:
                service.download(f"/v1/psfs/{found['id']}/{part}", path, overwrite=overwrite)
    click.echo(f"{file}: PSF {short(found['id'])}, {found['name']} {found['version']} ({found['status']})")


@click.command("instruments")
def instruments() -> None:
    """List the instruments whose PSF can be built, with their wavelength and the status of their instrument files."""
    from psfcore.instruments.files import instrument_names
    from psfcore.instruments.model import load_instrument

    for name in instrument_names():
        found = load_instrument(name)
        click.echo(
            f"{name:<12}  {found.wavelength_angstrom:6.1f} angstrom  {found.version}  {found.status}  "
            f"`heliopsf psf build --instrument {name} -o FILE`"
        )


COMMANDS = (download, instruments)
