"""The commands ``deconvolve``, which deconvolves one image into a file, or many images into a folder, and ``changes``,
which deconvolves several images and shows what changed, with the highest artefact scores first.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import click

from psfcore.deconvolve.summary import summary_lines
from psfcore.errors import DataError
from psfcore.files import sha256_of
from service.cli.connection import PSF, SERVER_OR_LOCAL, connection, named_psf, short
from service.cli.options import (
    DRAWN,
    OUTPUT_FOLDER,
    OUTPUT_PLACE,
    OVERWRITE,
    OutputPath,
    counted,
    fits_files,
    is_local,
    limits,
    methods_help,
    options_of,
    say_warnings,
    write_json,
)
from service.cli.progress import Report, echo, progress_bar
from service.client.errors import ServiceError
from service.client.operations import Operations
from service.client.outputs import check_output_folder, check_outputs, written
from service.start import STARTED
from workers.contract.requests import Deconvolve

if TYPE_CHECKING:
    from psfcore.deconvolve.assess.pictures import Treated
    from service.client.many import Outcome

# Every field of the request is an option, except what the command fills in itself.
_FILLED_IN = ("image_id", "psf_id", "changes_picture")
_OF_METHOD = ("method", "steps", "stop", "edges")
OPTIONS = (
    *_OF_METHOD,
    *(name for name in Deconvolve.model_fields if name not in (*_FILLED_IN, *_OF_METHOD)),
)

TABLE, SHEET = "changes.json", "contact-sheet.png"
SHOWN = 20


@click.command(epilog=methods_help())
@click.argument("images", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@click.option(
    "-o",
    "--output",
    required=True,
    type=OUTPUT_PLACE,
    metavar="FILE|FOLDER/",
    help="File of the product (FITS), or folder for the products of several images",
)
@PSF
@options_of(Deconvolve, *OPTIONS)
@click.option("--plot", type=DRAWN, help="Write the image before and after (PNG)")
@click.option("--changes", type=DRAWN, help="Write difference, ratio and histograms (PNG)")
@click.option("--timings", is_flag=True, help="Print how long each stage took; needs --local")
@SERVER_OR_LOCAL
@OVERWRITE
def deconvolve(
    images: tuple[Path, ...],
    output: OutputPath,
    psf: str | None,
    plot: Path | None,
    changes: Path | None,
    timings: bool,
    overwrite: bool,
    **parameters: object,
) -> None:
    """Deconvolve IMAGES (FITS files, or folders of them) with the PSF of their instrument, or with yours.

    The output is a folder for several images, or if its name ends in /. Images whose product is in the folder are
    skipped.
    """
    files = _fits_files(images)
    if timings and not is_local():
        raise click.UsageError(
            "--timings: expected --local, because a service measures the stages of all jobs together; see its /metrics"
        )
    into_folder = len(files) > 1 or any(path.is_dir() for path in images) or output.is_folder
    if into_folder and (plot or changes):
        raise click.UsageError(
            "--plot and --changes: expected one image and an output file; for several images use `heliopsf changes`"
        )
    psf_files = [Path(psf)] if psf and Path(psf).is_file() else []
    if into_folder:
        check_output_folder(output.path)
    else:
        check_outputs((output.path, plot, changes), inputs=[*files, *psf_files], overwrite=overwrite)
    with (
        connection() as service,
        progress_bar() as report,
    ):
        parameters |= {"psf_id": named_psf(service, psf, image=files[0])}
        if not into_folder:
            lines = _one(service, files[0], output.path, plot, changes, report, parameters, overwrite)
            failures: list[Outcome] = []
        else:
            lines, failures = _many(service, files, output.path, report, parameters, overwrite)
        if timings:
            lines += _timings(service)
    echo("\n".join(lines))
    if failures:
        raise click.ClickException(
            f"{len(failures)} of {counted(len(files), 'image')} failed; see the list above"
        )


def _fits_files(images: tuple[Path, ...]) -> list[Path]:
    files = fits_files(images)
    if not files:
        raise click.UsageError("expected FITS files; the folders that you named contain none")
    return files


def _timings(service: Operations) -> list[str]:
    """The lines that say how long each stage took: the stages of the job, and the rest of the command."""
    from service.cli.local import Local  # already loaded: the option needs --local

    assert isinstance(service, Local)
    spent = {stage: one.seconds for stage, one in service.times.end().items()}
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
    parameters: Mapping[str, object],
    overwrite: bool,
) -> list[str]:
    """Deconvolve one image into a file; returns the lines to print."""
    product = service.deconvolve(
        image, output, preview=plot, changes=changes, progress=report, overwrite=overwrite, **parameters
    )
    say_warnings(product)
    first, *others = summary_lines(product["details"])
    pictures = [str(path) for path in (plot, changes) if path is not None]
    return [
        f"{output}: {first}",
        *others,
        f"picture: {', '.join(pictures) or 'none; --plot FILE.png draws the image before and after'}",
        *([] if service.server is None else [f"product {short(product['id'])} of {service.server}"]),
    ]


def _many(
    service: Operations,
    files: list[Path],
    folder: Path,
    report: Report,
    parameters: Mapping[str, object],
    overwrite: bool,
) -> tuple[list[str], list[Outcome]]:
    """Deconvolve images into a folder; returns the lines to print, and the failures."""
    from service.client.many import deconvolve_many

    outcomes = list(
        deconvolve_many(
            service,
            files,
            folder,
            progress=lambda done, of: report("images", done, of),
            overwrite=overwrite,
            **parameters,
        )
    )
    for one in outcomes:
        for warning in one.warnings:
            echo(f"warning: {one.image}: {warning}", err=True)
    failures = [one for one in outcomes if one.failure is not None]
    existed = sum(one.existed for one in outcomes)
    done = len(outcomes) - len(failures) - existed
    lines = [f"{one.image}: {one.output}" for one in outcomes if one.failure is None and not one.existed]
    lines += [f"failed: {one.image}: {one.failure}" for one in failures]
    return [
        *lines,
        f"{counted(len(outcomes), 'image')}: {done} deconvolved, {existed} existed already, {len(failures)} failed",
    ], failures


# --- changes --------------------------------------------------------------------------------------------


@click.command()
@click.argument("images", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=OUTPUT_FOLDER, help=f"Folder for {TABLE} and {SHEET}")
@PSF
@options_of(Deconvolve, "other_channel", "context", "method", "steps", "noise", "saturation_dn", "again")
@click.option("--most", default=60, type=click.IntRange(1, 200), help="Images on the contact sheet")
@SERVER_OR_LOCAL
@OVERWRITE
def changes(
    images: tuple[Path, ...],
    output: Path,
    psf: str | None,
    most: int,
    overwrite: bool,
    **parameters: object,
) -> None:
    """Deconvolve IMAGES (FITS files, or folders of them); write a table of what changed and a contact sheet.

    Images with the highest artefact score come first. Images that cannot be deconvolved are listed with the reason.
    Each image gets the same PSF and the same treatment as by `heliopsf deconvolve`.
    """
    from psfcore.deconvolve.assess.pictures import contact_sheet_png, table, treat_many

    files = [str(path) for path in _fits_files(images)]
    table_file, sheet_file = output / TABLE, output / SHEET
    check_output_folder(output)
    if output.is_dir():
        psf_file = psf if psf and Path(psf).is_file() else None
        check_outputs((table_file, sheet_file), inputs=(*files, psf_file), overwrite=overwrite)
    with connection() as service, progress_bar() as report:
        parameters["psf_id"] = named_psf(service, psf, image=Path(files[0]))
        products: dict[str, dict[str, str]] = {}
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
    service: Operations, parameters: dict[str, Any], products: dict[str, dict[str, str]]
) -> Callable[[str], Treated]:
    """A function that deconvolves one image with the service and measures what changed. The function adds the ids of
    the products to ``products``.
    """
    from psfcore.deconvolve.assess.pictures import changes_in_product
    from service.client.many import FOR_ALL

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
        f"{counted(summary['images'], 'image')}, {summary['to_look_at']} to look at, {summary['failures']} not "
        "deconvolved"
    )
    return lines
