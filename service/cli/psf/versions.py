"""Commands about PSF versions: ``psf list``, ``upload``, ``certify``, ``deprecate``, ``delete``, ``best``, ``lineage``, ``rerun``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import click

from service.cli.connection import CONTEXT, ID, SERVER, id_argument, remote, short, whole_id, whole_ids
from service.cli.options import FILE, JSON, OUTPUT, progress_bar, user_errors, write_json, writes_files
from workers.versions import TOTAL, PsfStatus

if TYPE_CHECKING:
    from service.client.http import Client

Command = TypeVar("Command", bound=Callable[..., Any])
REASON = click.option("--reason", default="", help="Reason, kept in the history")
FROM = click.option(
    "--from", "valid_from", metavar="TIME", help="Start of its time range (included) [default: no start]"
)
TO = click.option("--to", "valid_to", metavar="TIME", help="End of its time range (excluded) [default: open]")
PRODUCT = click.option("--product", is_flag=True, help="The ID is of a product, not of a PSF")


def _line_options(command: Command) -> Command:
    for name, what in (
        ("kind", "Kind: total, uploaded, or a component such as diffraction"),
        ("channel", "Channel: wavelength in whole angstrom, such as 174; or a variant, such as 174-open_2"),
        ("instrument", "Instrument, such as hri_euv"),
    ):
        command = click.option(f"--{name}", help=what)(command)
    return command


def _filter_options(command: Command) -> Command:
    at = click.option("--valid-at", metavar="TIME", help="Time of observation, such as 2024-03-01T12:00:00")
    status = click.option(
        "--status", type=click.Choice([str(status) for status in PsfStatus]), help="Status of the PSF"
    )
    version = click.option("--version", help="Version of the PSF")
    return _line_options(version(status(at(CONTEXT(command)))))


@click.command("list")
@_filter_options
@SERVER
def list_psfs(server: str | None, **filters: str | None) -> None:
    """List the PSFs of a service."""
    with user_errors(), remote(server) as service:
        rows = list(service.psfs(**_given(filters)))
    if not rows and not _given(filters):
        click.echo("no PSF yet; `heliopsf psf build` or the first deconvolution makes a PSF")
    elif not rows:
        click.echo("no PSF with " + ", ".join(f"{name} {value}" for name, value in _given(filters).items()))
    for row in rows:
        size = "x".join(map(str, row["details"]["shape"]))
        line = f"{short(row['id'])}  {row['name']}  {row['version']}  {row['status']}  {size}"
        click.echo(line + _validity(row))


@click.command("upload")
@click.argument("file", type=FILE)
@click.option("--name", help="Name [default: PSFNAME in the header, or the file name]")
@click.option("--version", help="Version [default: PSFVERS in the header]")
@_line_options
@SERVER
def upload_psf(file: Path, server: str | None, **said: str | None) -> None:
    """Upload a PSF from FILE (FITS). A PSF of kind total is used for images of its instrument when it is certified."""
    with user_errors(), remote(server) as service:
        row = service.upload_psf(file, **said)
    line = f"{row['instrument'] or 'unknown instrument'} {row['channel'] or '-'} {row['kind']}"
    click.echo(f"{short(row['id'])}  {row['name']}  {row['version']}  {row['status']}  {line}")


@click.command("certify")
@id_argument("psf_id")
@click.option(
    "--version",
    help="Version of a draft, such as 1.2.0, which the series does not have yet; a certified PSF keeps its version",
)
@FROM
@TO
@click.option(
    "--supersedes",
    multiple=True,
    type=ID,
    metavar="ID",
    help="Also deprecate this certified PSF; can be repeated",
)
@REASON
@_line_options
@SERVER
def certify(
    psf_id: str,
    version: str | None,
    valid_from: str | None,
    valid_to: str | None,
    supersedes: tuple[str, ...],
    reason: str,
    server: str | None,
    **line: str | None,
) -> None:
    """Certify a PSF for a range of times of observation, or change the range of a certified PSF."""
    with user_errors(), remote(server) as service:
        said = service.certify_psf(
            psf_id,
            version,
            valid_from=valid_from,
            valid_to=valid_to,
            supersedes=whole_ids(service, "psfs", supersedes),
            reason=reason,
            **line,
        )
    click.echo(f"{said['series']} {said['version']}: {said['status']}{_validity(said)}")


@click.command("deprecate")
@id_argument("psf_id")
@click.option("--successor", type=ID, metavar="ID", help="Certified PSF to use instead")
@REASON
@SERVER
def deprecate(psf_id: str, successor: str | None, reason: str, server: str | None) -> None:
    """Deprecate a certified PSF, so that it is no longer chosen; or name the successor of a deprecated PSF."""
    with user_errors(), remote(server) as service:
        instead_id = None if successor is None else whole_id(service, "psfs", successor)
        said = service.deprecate_psf(psf_id, instead_id, reason=reason)
        count = sum(1 for _ in service.affected(psf_id))
    instead = f", use {short(said['successor'])}" if said["successor"] else ""
    click.echo(f"{said['series']} {said['version']}: {said['status']}{instead}")
    click.echo(f"products made with it: {count}")


@click.command("delete")
@id_argument("psf_id")
@SERVER
def delete_psf(psf_id: str, server: str | None) -> None:
    """Delete a draft with its files.

    A PSF is not deleted if it is used by a product, a job that has not ended, an open bulk run, a context or another
    PSF.
    """
    with user_errors(), remote(server) as service:
        row = service.delete_psf(psf_id)
    click.echo(f"deleted {short(row['id'])}  {row['name']}  {row['version']}")


@click.command("best")
@click.option("--image", type=FILE, help="Image (FITS) for which a PSF is wanted")
@_filter_options
@JSON
@SERVER
@writes_files
def best(
    image: Path | None, json_file: Path | None, server: str | None, overwrite: bool, **filters: str | None
) -> None:
    """With --image, show the PSF that `heliopsf deconvolve` would use for the image, and why. Without it, find the PSF
    with the given properties. With --image and a --kind other than total, only certified PSFs or the PSFs of a context are
    searched."""
    given = _given(filters)
    if image is not None and set(given) - {"context", "kind"}:
        raise click.UsageError(
            "--image can only be combined with --context and --kind; leave out the other filters"
        )
    with user_errors(), remote(server) as service:
        if image is None:
            found = service.best_psf(**given)
        elif given.get("kind", TOTAL) == TOTAL:
            found = _chosen(service, image, given.get("context"))
        else:
            found = service.psf_for_image(service.upload_image(image)["id"], **given)
    psf = found["psf"]
    status = "not built yet" if psf["status"] is None else f"{psf['status']}{_validity(psf)}"
    click.echo(f"{short(psf['id'])}  {psf['name']}  {psf['version']}  {status}")
    if "why" in found:
        click.echo(f"  {found['why']}")
    write_json(json_file, found, overwrite=overwrite)


@click.command("lineage")
@id_argument()
@PRODUCT
@JSON
@click.option(
    "--prov",
    "prov_file",
    type=OUTPUT,
    help="Write the lineage as W3C PROV: PROV-N if the name ends in .provn, otherwise PROV-JSON",
)
@SERVER
@writes_files
def lineage(
    identity: str,
    product: bool,
    json_file: Path | None,
    prov_file: Path | None,
    server: str | None,
    overwrite: bool,
) -> None:
    """Show from which images, transits and PSFs a PSF or a product was made, back to the uploads."""
    of: Literal["product", "psf"] = "product" if product else "psf"
    with user_errors(), remote(server) as service:
        told = service.lineage(of, identity)
        if prov_file is not None:
            service.provenance(of, told["id"], prov_file, overwrite=overwrite)
    for line in _tree(told, 0):
        click.echo(line)
    write_json(json_file, told, overwrite=overwrite)


@click.command("rerun")
@id_argument()
@PRODUCT
@JSON
@SERVER
@writes_files
def rerun(identity: str, product: bool, json_file: Path | None, server: str | None, overwrite: bool) -> None:
    """Make a PSF or a product again and compare both results. If they differ, the exit status is 1."""
    with user_errors(), remote(server) as service, progress_bar() as report:
        of: Literal["product", "psf"] = "product" if product else "psf"
        found = service.rerun(of, whole_id(service, f"{of}s", identity), progress=report)
        if json_file is not None:
            service.download(found["file"], json_file, overwrite=overwrite)
    click.echo(found["details"]["sentence"])
    sys.exit(0 if found["details"]["same"] else 1)


COMMANDS = (list_psfs, upload_psf, certify, deprecate, delete_psf, best, lineage, rerun)


def _chosen(service: Client, image: Path, context: str | None) -> dict[str, Any]:
    """The PSF that a deconvolution of an image would use, and why. If the PSF is not built yet, only its entry in the
    estimate is known."""
    image_id = service.upload_image(image)["id"]
    chosen = service.estimate("deconvolve", image_id=image_id, context=context)["psf"]
    psf = chosen if chosen["status"] is None else service.psf(chosen["id"])
    return {"psf": psf, "why": chosen["why"]}


def _given(filters: dict[str, str | None]) -> dict[str, str]:
    return {name: value for name, value in filters.items() if value is not None}


def _validity(row: dict[str, Any]) -> str:
    """The time range of a PSF; empty if the PSF was never certified."""
    if not row["was_certified"]:
        return ""
    return f"  [{row['valid_from'] or 'always'}, {row['valid_to'] or 'open'})"


def _tree(told: dict[str, Any], depth: int) -> Iterator[str]:
    """A lineage as lines. The inputs of an entry follow it on indented lines."""
    made = told["made"] or {}
    named = " ".join(str(made[key]) for key in ("name", "version", "status") if made.get(key))
    by = [f"heliopsf {made['software_version']}"] if made.get("software_version") else []
    by += [f"job {short(made['job_id'])}"] if made.get("job_id") else []
    share = f"weight {told['weight']:.3f}" if told.get("weight") is not None else ""
    gone = "" if told["there"] or told["type"] == "instrument-file" else "deleted since"
    cut = "shown above" if told["cut"] else ""
    said = "; ".join(part for part in (named, share, ", ".join(by), gone, cut) if part)
    yield "  " * depth + f"{told['type']} {short(told['id'])}" + (f"  ({said})" if said else "")
    for parent in told["parents"]:
        yield from _tree(parent, depth + 1)
