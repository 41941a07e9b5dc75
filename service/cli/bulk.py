"""``heliopsf bulk``: bulk runs, which deconvolve many images on a service."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import click

from psfcore.deconvolve.summary import percent
from service.cli.connection import (
    CONTEXT,
    ID,
    id_argument,
    named_psf,
    on_service,
    print_rows,
    psf_option,
    short,
    whole_id,
)
from service.cli.jobs import MOST
from service.cli.options import OUTPUT, Text, fits_files, options_of, write_file, writes_files
from service.cli.progress import duration, echo, moment, progress_bar
from service.client.errors import ServiceError
from service.client.operations import treatment
from workers.contract.requests import Treatment
from workers.versions import PsfStatus

if TYPE_CHECKING:
    from service.client.answers import Bulk, BulkEstimate, BulkLine, BulkResult
    from service.client.http import Client

_CONDITION = re.compile(r"([A-Z0-9_-]{1,8})\s*(=|!=|<=|>=|<|>)\s*(.+)")
# HTTP statuses with which the service refuses one file. After any other refusal, the next file would be refused too.
OF_ONE_FILE, OF_ALL_FILES = (400, 413, 415, 422), ("quota-exceeded",)
Value = bool | int | float | str
BULK_ID = id_argument("bulk_id")
WAIT = click.option(
    "--wait", is_flag=True, help="Wait until the bulk run ends; the exit status is 1 if an image failed"
)


def _condition(text: str) -> tuple[str, str, Value]:
    """Keyword, comparison sign and value of a text such as WAVELNTH=174."""
    parts = _CONDITION.fullmatch(text.strip())
    if parts is None:
        raise ValueError(f"expected KEYWORD=VALUE, or != < <= > >= instead of =; got {text!r}")
    return parts[1], parts[2], _value(parts[3])


@click.group(short_help="Deconvolve many images on a service.")
def bulk() -> None:
    """Deconvolve many images on a service in the same way: your own images, or files of an archive that the service can
    read.
    """


@bulk.command("submit", short_help="Start a bulk run.")
@click.argument("patterns", nargs=-1)
@psf_option("PSF for all images: an id or a file")
@CONTEXT
@click.option("--upload", "uploads", multiple=True, type=click.Path(exists=True, path_type=Path),
              help="FITS file, or folder of FITS files, to upload and deconvolve; can be repeated")  # fmt: skip
@click.option("--image", "images", multiple=True, type=ID, metavar="ID",
              help="Id of an uploaded image; can be repeated")  # fmt: skip
@click.option("--where", "conditions", multiple=True, type=Text(_condition), metavar="KEYWORD=VALUE",
              help="Use only files whose header meets this condition; several conditions must all be met")  # fmt: skip
@click.option("--output", help="Write products to this folder on the machine of the service")
@click.option(
    "--only", is_flag=True, help="Write products only to the --output folder; the service keeps no copy"
)
@click.option(
    "--layout",
    help="Path of each product in the --output folder, for example {telescop}/{date:%Y/%m/%d}/{stem}_deconvolved.fits",
)
@options_of(Treatment, "method", "steps", "noise", "saturation_dn", "other_channel", "again")
@click.option("--name", default="", show_default=False, help="Label of the bulk run")
@click.option(
    "--dry-run", is_flag=True, help="Estimate the run and list inputs that it would refuse; start nothing"
)
@WAIT
@on_service
def submit(
    service: Client,
    patterns: tuple[str, ...],
    psf: str | None,
    uploads: tuple[Path, ...],
    images: tuple[str, ...],
    conditions: tuple[tuple[str, str, Value], ...],
    dry_run: bool,
    wait: bool,
    **parameters: object,
) -> None:
    """Start a bulk run: deconvolve the files on the machine of the service that match PATTERNS.

    A pattern is an absolute path in a folder that the operator allows. * ? and [ab] match parts of a name, ** matches
    any number of folders. Put the pattern in quotation marks. Choose the PSF with either --psf or --context. If the
    service refuses files of --upload, the command names them, starts the run with the others, and ends with status 1.

    --dry-run examines the headers of a sample of the images and starts nothing; it ends with status 1 if the run would
    refuse an examined image.
    """
    request = {name: parameters.pop(name) for name in ("context", "output", "only", "layout", "name")}
    if (psf is None) == (request["context"] is None):
        raise click.UsageError("expected either --psf or --context")
    if request["layout"] is not None and request["output"] is None:
        raise click.UsageError("--layout names the files of the folder --output: give --output, too")
    if dry_run and (uploads or wait):
        raise click.UsageError(
            "--dry-run uploads and starts nothing: use it with PATTERNS or --image, without --upload and --wait"
        )
    files = fits_files(uploads)
    if not (files or images or patterns):
        raise click.UsageError(
            "expected images: FITS files or folders of them (--upload), ids (--image) or PATTERNS; got none"
        )
    uploaded, refused = _upload(service, files)
    if refused and not (uploaded or images or patterns):
        raise click.ClickException(
            "no file could be uploaded, so no bulk run was started; the reasons are listed above"
        )
    psf_id = named_psf(service, psf)
    if psf_id is not None and service.psf(psf_id)["status"] == PsfStatus.DEPRECATED:
        echo(f"warning: PSF {short(psf_id)} was deprecated; every product has this warning", err=True)
    request |= {
        "images": [*(whole_id(service, "images", image) for image in images), *uploaded],
        "files": [{"glob": pattern, "where": _where(conditions)} for pattern in patterns],
        "psf_id": psf_id,
        **treatment(**parameters),
    }
    if dry_run:
        estimate = service.estimate_bulk(sample=None, **request)
        _print_estimate(estimate)
        sys.exit(1 if estimate["refused_images"] else 0)
    run = service.submit_bulk(**request)
    echo(f"bulk {short(run['id'])}")
    if wait:
        run = _wait(service, run["id"])
    _end(run, wait and not refused)
    if refused:
        were = "file was" if refused == 1 else "files were"
        raise click.ClickException(f"{refused} {were} not uploaded; the reasons are listed above")


@bulk.command("list", short_help="List your bulk runs.")
@MOST
@on_service
def list_bulks(service: Client, most: int) -> None:
    """List your bulk runs, newest first."""

    def line(row: BulkLine) -> str:
        return (
            f"{short(row['id'])}  {row['phase']:<9}  {moment(row['created_at'])}  {row['done']} of "
            f"{_total(row, row['total'])} done, {row['failed']} failed  {row['name']}"
        )

    print_rows(
        islice(service.bulks(), most), line, if_none="no bulk run yet; `heliopsf bulk submit` starts one"
    )


@bulk.command("status", short_help="Show progress, speed and time left.")
@BULK_ID
@WAIT
@on_service
def status(service: Client, bulk_id: str, wait: bool) -> None:
    """Show the progress, speed and time left of a bulk run. `bulk list` lists your bulk runs."""
    run = _wait(service, bulk_id) if wait else service.bulk(bulk_id)
    _end(run, wait)


def _add_action(action: str, short_help: str, text: str) -> None:
    @bulk.command(action, short_help=short_help, help=text)
    @BULK_ID
    @on_service
    def act(service: Client, bulk_id: str) -> None:
        _print_run(getattr(service, f"{action}_bulk")(bulk_id))


for _action in (
    ("retry", "Try failed images again.", "Try the failed images of a bulk run again."),
    ("pause", "Pause a bulk run.",
     "Pause a bulk run: start no more images, but finish the images in progress."),
    ("resume", "Resume a paused or failed bulk run.", "Resume a paused or failed bulk run."),
    ("cancel", "End a bulk run permanently.",
     "End a bulk run permanently. Products that are done are kept."),
):  # fmt: skip
    _add_action(*_action)


@bulk.command("delete", short_help="Delete bulk runs.")
@id_argument("bulk_ids", several=True)
@on_service
def delete(service: Client, bulk_ids: tuple[str, ...]) -> None:
    """Delete bulk runs from the service, so that they no longer count in your quota. Their products are kept.

    The manifest of a run is deleted with the run. To keep the manifest, save it first with `bulk report -o FILE`.
    Before you delete a run that is LISTING or RUNNING, cancel it.
    """
    for bulk_id in bulk_ids:
        whole = whole_id(service, "bulk", bulk_id)
        service.delete_bulk(whole)
        echo(f"bulk run {short(whole)} is deleted")


@bulk.command("report", short_help="Show artefact scores and failures.")
@BULK_ID
@click.option("-o", "--output", type=OUTPUT, help="Write the manifest of all products (.ndjson or .csv)")
@click.option("--failures", type=OUTPUT, help="Write the failures with their reasons (.ndjson)")
@click.option("--most", default=20, type=click.IntRange(0, 10_000), help="Number of images to show")
@on_service
@writes_files
def report(
    service: Client, bulk_id: str, output: Path | None, failures: Path | None, most: int, overwrite: bool
) -> None:
    """Show the results of a bulk run: first the images, sorted by artefact score, then the failures."""
    _print_run(service.bulk(bulk_id))
    for row in service.bulk_results(bulk_id, order="worst", limit=most) if most else ():
        echo(_line(row))
    failed = list(service.bulk_failures(bulk_id))
    for one in failed[:most]:
        echo(f"failed: {one['source']}: {one['error']['message']}")
    if len(failed) > most:
        echo(f"... and {len(failed) - most} more {'failure' if len(failed) == most + 1 else 'failures'}")
    if output is not None:
        form = "csv" if output.suffix.lower() == ".csv" else "ndjson"
        service.write_bulk_manifest(bulk_id, output, format=form, overwrite=overwrite)
        echo(str(output))
    if failures is not None:
        lines = "".join(f"{json.dumps(row)}\n" for row in failed)
        write_file(failures, lambda file: file.write_text(lines, "utf-8"), overwrite=overwrite)
        echo(str(failures))


def _upload(service: Client, files: Sequence[Path]) -> tuple[list[str], int]:
    """Upload files; returns the ids of the images, and how many files were refused. Each refused file is named on
    standard error.
    """
    uploaded: list[str] = []
    for file in files:
        try:
            uploaded.append(service.upload_image(file)["id"])
        except (ServiceError, OSError) as error:
            if isinstance(error, ServiceError) and (
                error.status not in OF_ONE_FILE or error.code in OF_ALL_FILES
            ):
                raise
            echo(f"not uploaded: {file}: {error}", err=True)
    return uploaded, len(files) - len(uploaded)


def _wait(service: Client, bulk_id: str) -> Bulk:
    """Wait until a run ends; returns its description."""
    with progress_bar() as report:
        return service.wait_for_bulk(bulk_id, progress=report)


def _end(run: Bulk, wait: bool) -> None:
    """Print the state of a run. With ``wait``, exit with status 1 if the run is not completed or if an image failed."""
    _print_run(run)
    if wait and (run["phase"] != "COMPLETED" or run["images"]["failed"]):
        sys.exit(1)


def _print_estimate(estimate: BulkEstimate) -> None:
    """Print the result of a dry run."""
    workers, more = estimate["workers"], estimate["refused_images"] - len(estimate["refused"])
    lines = [
        f"{estimate['images']} images, about {duration(estimate['seconds'])} with {workers} worker "
        f"{'process' if workers == 1 else 'processes'}, at most {estimate['memory_mib']} MiB of memory for one image",
        f"products: about {estimate['output_bytes'] / 2**20:.1f} MiB, without their pictures",
        f"examined: {estimate['examined']} of {estimate['images']} images; {estimate['refused_images']} would be "
        "refused" + (f", {estimate['existing']} products exist already" if estimate["existing"] else ""),
    ]
    if estimate["example_output"]:
        lines.append(f"for example: {estimate['example_output']}")
    lines.append(
        "complete: no other file matches"
        if estimate["complete"]
        else "the time of a dry run was not enough to find and examine all of them: the run may be larger"
    )
    lines += [f"refused: {one['source']}: {one['error']['message']}" for one in estimate["refused"]]
    if more > 0:
        lines.append(f"... and {more} more")
    echo("\n".join(lines))


def _print_run(run: Bulk) -> None:
    """Print the state of a run."""
    images = run["images"]
    existed = f" ({images['reused']} existed already)" if images["reused"] else ""
    echo(
        f"{run['phase']}: {images['done']} of {_total(run, images['total'])} done{existed}, {images['failed']} failed, "
        f"{images['at_work']} in progress, {images['waiting']} waiting"
    )
    if images["to_look_at"]:
        echo(f"{images['to_look_at']} to look at: `heliopsf bulk report {short(run['id'])}`")
    if run["images_an_hour"]:
        left = "" if run["time_left_s"] is None else f", {duration(run['time_left_s'])} left"
        echo(f"{run['images_an_hour']:.0f} images per hour{left}")
    if run["error"]:
        echo(f"stopped: {run['error']['message']}")


def _total(run: Bulk | BulkLine, total: int) -> str:
    """The number of images of a run, as far as it is known."""
    return str(total) if run["listed"] else f"at least {total}"


def _line(row: BulkResult) -> str:
    changes = "  ".join(
        f"{kind} {percent(change['sum_pct'])} (to {change['up_to_pct']:+.0f})"
        for kind, change in (("bright", row["bright"]), ("dark", row["dark"]))
        if change is not None
    )
    warnings = f"  (warnings: {', '.join(row['warnings'])})" if row["warnings"] else ""
    return f"{row['score']:8.2f}  {changes}  {row['source']}{warnings}"


def _where(conditions: Sequence[tuple[str, str, Value]]) -> dict[str, object]:
    """The conditions in the form that the request needs. If a keyword has several values, one of these values is
    enough.
    """
    where: dict[str, object] = {}
    for key, sign, value in conditions:
        before = where.get(key)
        if before is not None and isinstance(before, dict) == (sign == "="):
            raise click.UsageError(
                f"--where {key}: use either values (=) or comparisons for one keyword, not both"
            )
        if sign != "=":
            where[key] = {**(before if isinstance(before, dict) else {}), sign: value}
        elif before is None:
            where[key] = value
        else:
            where[key] = [*(before if isinstance(before, list) else [before]), value]
    return where


def _value(text: str) -> Value:
    """The value of a text: T or F is a logical value, a number is a number, anything else is a text. Quotation marks
    make any value a text.
    """
    if text in ("T", "F"):
        return text == "T"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    quoted = len(text) >= 2 and text[0] == text[-1] and text[0] in "'\""
    return text[1:-1] if quoted else text
