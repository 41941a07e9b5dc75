"""The command ``changes``: deconvolves several images and shows what changed, with the highest artefact scores first."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from psfcore.errors import DataError
from psfcore.files import sha256_of
from service.cli.connection import LOCAL, PSF, SERVER, connection, named_psf
from service.cli.fields import options_of
from service.cli.options import (
    OUTPUT_FOLDER,
    OVERWRITE,
    counted,
    fits_files,
    limits,
    progress_bar,
    say_warnings,
    user_errors,
    write_json,
)
from service.cli.progress import echo
from service.client.errors import ServiceError
from service.client.operations import Operations
from service.client.outputs import check_output_folder, check_outputs, written
from workers.contract.requests import Deconvolve

if TYPE_CHECKING:
    from psfcore.deconvolve.assess.pictures import Treated

TABLE, SHEET = "changes.json", "contact-sheet.png"
SHOWN = 20
# These errors concern every image, so the command stops.
FOR_ALL = (401, 403)


@click.command()
@click.argument("images", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=OUTPUT_FOLDER, help=f"Folder for {TABLE} and {SHEET}")
@PSF
@options_of(Deconvolve, "other_channel", "context", "method", "steps", "noise", "saturation_dn", "again")
@click.option("--most", default=60, type=click.IntRange(1, 200), help="Images on the contact sheet")
@SERVER
@LOCAL
@OVERWRITE
def changes(
    images: tuple[Path, ...],
    output: Path,
    psf: str | None,
    most: int,
    server: str | None,
    local: bool,
    overwrite: bool,
    **parameters: Any,
) -> None:
    """Deconvolve IMAGES (FITS files, or folders of them); write a table of what changed and a contact sheet.

    Images with the highest artefact score come first. Images that cannot be deconvolved are listed with the reason.
    Each image gets the same PSF and the same treatment as by `heliopsf deconvolve`.
    """
    from psfcore.deconvolve.assess.pictures import contact_sheet_png, table, treat_many

    files = [str(path) for path in fits_files(images)]
    if not files:
        raise click.UsageError("expected FITS files; the folders that you named contain none")
    table_file, sheet_file = output / TABLE, output / SHEET
    with user_errors():
        check_output_folder(output)
        if output.is_dir():
            psf_file = psf if psf and Path(psf).is_file() else None
            check_outputs((table_file, sheet_file), inputs=(*files, psf_file), overwrite=overwrite)
    with user_errors(), connection(server, local) as service, progress_bar() as report:
        parameters["psf_id"] = named_psf(service, psf)
        products: dict[str, dict[str, Any]] = {}
        treated, failures = treat_many(
            files,
            _one_by_one(service, parameters, products),
            progress=lambda done, of: report("images", done, of),
        )
        inputs = {row.name: sha256_of(Path(row.name)) for row in treated}
        content = table(treated, failures) | {
            "method": {"name": parameters["method"], "steps": parameters["steps"]},
            "products": products,
            "inputs_sha256": inputs,
        }
        output.mkdir(parents=True, exist_ok=True)
        write_json(table_file, content, overwrite=overwrite)
        with written(sheet_file, overwrite=overwrite) as picture:
            contact_sheet_png(treated, failures, picture, most=most)
    echo("\n".join(_lines(content)))
    echo(f"{table_file}, {sheet_file}")
    if not treated:
        raise click.ClickException("no image could be deconvolved; the reasons are listed above")


def _one_by_one(
    service: Operations, parameters: dict[str, Any], products: dict[str, dict[str, Any]]
) -> Callable[[str], Treated]:
    """A function that deconvolves one image with the service and measures what changed. The function adds the ids of
    the products to ``products``."""
    from psfcore.deconvolve.assess.pictures import changes_in_product

    def one(name: str) -> Treated:
        with TemporaryDirectory(prefix="heliopsf-") as folder:
            file = Path(folder) / "product.fits"
            try:
                product = service.deconvolve(name, file, **parameters)
            except ServiceError as error:
                if error.code is None or error.status in FOR_ALL:
                    raise
                raise DataError(error.code, str(error)) from error
            say_warnings(product)
            version = product["details"]["software_version"]
            products[name] = {"id": product["id"], "psf_id": product["psf_id"], "software_version": version}
            service.release(product)
            return changes_in_product(name, name, file, product["details"], limits())

    return one


def _lines(content: dict[str, Any]) -> list[str]:
    lines = []
    for row in content["images"][:SHOWN]:
        changed = "  ".join(
            f"{kind} {row[kind]['sum_pct']:+6.1f} % (to {row[kind]['up_to_pct']:+.0f})"
            for kind in ("bright", "dark")
            if row[kind] is not None
        )
        lines.append(f"{row['score']:8.2f}  {changed}  {row['file']}")
    if len(content["images"]) > SHOWN:
        lines.append(f"... and {len(content['images']) - SHOWN} with lower scores")
    lines += [f"not deconvolved: {failure['name']}: {failure['reason']}" for failure in content["failures"]]
    summary = content["summary"]
    lines.append(
        f"{counted(summary['images'], 'image')}, {summary['to_look_at']} to look at, {summary['failures']} not deconvolved"
    )
    return lines
