"""``heliopsf job`` and ``heliopsf product``: the jobs of a service, and the deconvolved images that they make."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING

import click

from service.cli.connection import (
    CHOSEN_SERVER,
    ID,
    id_argument,
    on_service,
    print_rows,
    short,
    whole_id,
)
from service.cli.options import (
    JSON,
    OUTPUT,
    OUTPUT_PLACE,
    PLOT,
    OutputPath,
    write_json,
    writes_files,
)
from service.cli.progress import duration, echo, moment, progress_bar, step_text
from service.client.errors import ServiceError
from workers.contract.jobs import Phase

if TYPE_CHECKING:
    from service.client.answers import Job
    from service.client.http import Client

# The name of a result and how to get it, by the part of its address that names the type of the result.
RESULTS = {
    "products": ("product", "heliopsf product get {id} -o FILE{at}"),
    "psfs": ("PSF", "heliopsf psf download {id} -o FILE{at}"),
    "reports": ("report", "repeat the command that started the job; it ends at once and writes its files"),
    "bulk": ("bulk run", "heliopsf bulk status {id}{at}"),
}
MOST = click.option("--most", default=20, type=click.IntRange(1),
                    help="Number of lines to show, newest first")  # fmt: skip
IDS = id_argument("identities", several=True)


@click.group(short_help="List, show, wait for and cancel jobs.")
def job() -> None:
    """List, show, wait for and cancel jobs on a service."""


@job.command("list", short_help="List your jobs.")
@click.option("--phase", type=click.Choice([str(phase) for phase in Phase]), help="Only jobs in this phase")
@MOST
@on_service
def list_jobs(service: Client, phase: str | None, most: int) -> None:
    """List your jobs, newest first."""

    def line(row: Job) -> str:
        return f"{short(row['id'])}  {row['phase']:<9}  {row['kind']:<14}  {moment(row['created_at'])}  {_state(row)}"

    jobs = service.jobs() if phase is None else service.jobs(phase=phase)
    print_rows(
        islice(jobs, most), line, if_none="no job yet" if phase is None else f"no job in phase {phase}"
    )


@job.command("show", short_help="Show a job.")
@id_argument()
@JSON
@on_service
@writes_files
def show(service: Client, identity: str, json_file: Path | None, overwrite: bool) -> None:
    """Show the phase, progress, and result or error of a job."""
    row = service.job(identity)
    echo(f"job {row['id']}: {row['kind']}, {row['phase']}")
    echo(f"  queue {row['queue']}, attempt {row['attempt']}")
    for name, at in (
        ("created", row["created_at"]),
        ("started", row["started_at"]),
        ("ended", row["ended_at"]),
    ):
        if at is not None:
            echo(f"  {name:<8} {moment(at)}")
    for name, value in row["parameters"].items():
        if value is not None:
            echo(f"  {name} {_value(value)}")
    if state := _state(row):
        echo(f"  {state}")
    write_json(json_file, row, overwrite=overwrite)


@job.command("wait", short_help="Wait for jobs.")
@IDS
@on_service
def wait(service: Client, identities: tuple[str, ...]) -> None:
    """Wait until jobs have ended. If one of them failed or was cancelled, the exit status is 1."""
    failed = False
    for identity in identities:
        row = service.job(identity)
        try:
            with progress_bar() as report:
                row = service.wait(row, progress=report)
        except ServiceError as error:
            if error.status is not None or error.code is None:  # the request failed, not the job
                raise
            failed = True
            ended = Phase.ABORTED if error.code == "cancelled" else error
            echo(f"job {short(row['id'])}: {ended}", err=True)
        else:
            echo(f"job {short(row['id'])}: {_state(row)}")
    if failed:
        raise click.exceptions.Exit(1)


@job.command("cancel", short_help="Cancel jobs.")
@IDS
@on_service
def cancel(service: Client, identities: tuple[str, ...]) -> None:
    """Cancel jobs. A queued job ends at once, an executing job at its next step."""
    for identity in identities:
        row = service.cancel(identity)
        stops = row["cancel_requested"] and not Phase(row["phase"]).ended
        echo(f"job {short(row['id'])}: {'stops at its next step' if stops else row['phase']}")


@click.group(short_help="List, download and delete products.")
def product() -> None:
    """List, download and delete products: deconvolved images that a service keeps."""


@product.command("list", short_help="List your products.")
@click.option("--image", "image_id", type=ID, metavar="ID", help="Only products of this uploaded image")
@click.option("--psf", "psf_id", type=ID, metavar="ID", help="Only products made with this PSF")
@MOST
@on_service
def list_products(service: Client, image_id: str | None, psf_id: str | None, most: int) -> None:
    """List your products, newest first."""
    filters = {}
    if image_id is not None:
        filters["image_id"] = whole_id(service, "images", image_id)
    if psf_id is not None:
        filters["psf_id"] = whole_id(service, "psfs", psf_id)
    print_rows(
        islice(service.products(**filters), most),
        lambda row: (
            f"{short(row['id'])}  {moment(row['created_at'])}  image {short(row['image_id'])}  "
            f"PSF {short(row['psf_id'])} {row['psf_version']}  {row['details']['method']['name']}"
        ),
        if_none="no such product" if filters else "no product yet; `heliopsf deconvolve` makes a product",
    )


@product.command("get", short_help="Download a product.")
@id_argument()
@click.option("-o", "--output", type=OUTPUT_PLACE, metavar="FILE|FOLDER/",
              help="Write the product (FITS) to this file, or into this folder")  # fmt: skip
@PLOT
@click.option(
    "--changes", type=OUTPUT, help="Write difference, ratio and histograms (PNG), if the job drew them"
)
@on_service
@writes_files
def get(
    service: Client,
    identity: str,
    output: OutputPath | None,
    plot: Path | None,
    changes: Path | None,
    overwrite: bool,
) -> None:
    """Download a product and its pictures. Name at least one output."""
    if output is None and plot is None and changes is None:
        raise click.UsageError("expected an output: -o FILE, --plot FILE or --changes FILE; got none of them")
    row = service.product(identity)
    file = None if output is None else output.file(row["details"]["filename"])
    parts = {"file": file, "preview": plot, "changes": changes}
    files = {part: path for part, path in parts.items() if path is not None}
    for part, path in files.items():
        service.download(f"/v1/products/{row['id']}/{part}", path, overwrite=overwrite)
    written = ", ".join(map(str, files.values()))
    echo(f"{written}: product {short(row['id'])}, PSF {row['psf_version']}")


@product.command("delete", short_help="Delete products.")
@IDS
@on_service
def delete(service: Client, identities: tuple[str, ...]) -> None:
    """Delete products from the service, so that they no longer count in your quota. The same request makes them
    again.
    """
    for identity in identities:
        whole = whole_id(service, "products", identity)
        service.delete_product(whole)
        echo(f"product {short(whole)} is deleted")


def _state(row: Job) -> str:
    """The progress, result or error of a job in one line; empty for a job that waits."""
    if row["error"] is not None:
        return str(row["error"]["message"])
    if row["result"] is not None:
        things, identity = row["result"].split("/")[-2:]
        name, way = RESULTS[things]
        if row["result_deleted"]:
            return f"{name} {short(identity)} was deleted; the same request makes it again"
        server = click.get_current_context().meta[CHOSEN_SERVER]
        at = "" if server is None else f" --server {server}"
        return f"{name} {short(identity)}: {way.format(id=short(identity), at=at)}"
    if row["phase"] != Phase.EXECUTING:
        return ""
    now = row["progress"]
    left = "" if now["time_left_s"] is None else f", {duration(now['time_left_s'])} left"
    return f"{step_text(now['stage'], now['step'], now['steps'])}{left}"


def _value(value: object) -> str:
    """A parameter in one line: an id is shortened, and a long text is cut."""
    text = str(value)
    if isinstance(value, str) and len(text) == 64 and set(text) <= set("0123456789abcdef"):
        return short(text)
    return text if len(text) <= 100 else f"{text[:100]}..."
