"""Commands about the PSFs that a service keeps: ``heliopsf psf list``, ``upload``, ``certify``, ``series``,
``lineage``, ... and ``heliopsf context``.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypedDict, cast

import click

from psfcore.instruments.psf_statements import title
from service.cli.connection import (
    CONTEXT,
    ID,
    id_argument,
    on_service,
    print_rows,
    short,
    whole_id,
)
from service.cli.options import (
    FILE,
    JSON,
    OUTPUT,
    OUTPUT_PLACE,
    PLOT,
    Command,
    OutputPath,
    write_json,
    writes_files,
)
from service.cli.progress import echo, progress_bar
from service.cli.psf.make import say_fit
from service.client.operations import without_none
from workers.versions import TOTAL, PsfStatus

if TYPE_CHECKING:
    from service.client.answers import Ancestor, Choice, ChosenPsf, ContextLine, Pin, Psf
    from service.client.answers import PsfStatus as Status
    from service.client.http import Client


class Reasoned(TypedDict):
    """The PSF that a deconvolution of an image would use, and why."""

    psf: Psf | ChosenPsf
    why: str


PSF_ID = id_argument("psf_id")
REASON = click.option("--reason", default="", show_default=False, help="Reason, kept in the history")
PRODUCT = click.option(
    "--product",
    "of",
    flag_value="product",
    default="psf",
    show_default=False,
    help="The ID is of a product, not of a PSF",
)


def _series_options(command: Command) -> Command:
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
    return _series_options(version(status(at(CONTEXT(command)))))


@click.command("list")
@_filter_options
@on_service
def list_psfs(service: Client, **options: str | None) -> None:
    """List the PSFs of a service."""
    filters = without_none(options)
    none = "no PSF with " + ", ".join(f"{name} {value}" for name, value in filters.items())
    if not filters:
        none = "no PSF yet; `heliopsf psf build` or the first deconvolution makes a PSF"

    def line(row: Psf) -> str:
        return (
            f"{_named(row)}  {row['status']}  {'x'.join(map(str, row['details']['shape']))}{_validity(row)}"
        )

    print_rows(service.psfs(**filters), line, if_none=none)


@click.command("download")
@id_argument()
@click.option("-o", "--output", required=True, type=OUTPUT_PLACE, metavar="FILE|FOLDER/",
              help="Write the PSF (FITS) to this file, or into this folder")  # fmt: skip
@PLOT
@JSON
@on_service
@writes_files
def download(
    service: Client,
    identity: str,
    output: OutputPath,
    plot: Path | None,
    json_file: Path | None,
    overwrite: bool,
) -> None:
    """Download a PSF, and if wanted its plot and the report of its fit."""
    row = service.psf(identity)
    file = output.file(f"psf-{short(row['id'])}.fits")
    for part, path in (("file", file), ("preview", plot), ("report", json_file)):
        if path is not None:
            service.download(f"/v1/psfs/{row['id']}/{part}", path, overwrite=overwrite)
    echo(f"{file}: {title(row['name'], row['version'], row['status'])}, id {short(row['id'])}")


@click.command("instruments")
def instruments() -> None:
    """List the instruments whose PSF can be built, with their wavelength and the status of their instrument files."""
    from psfcore.instruments.files import instrument_names
    from psfcore.instruments.model import load_instrument

    for instrument in map(load_instrument, instrument_names()):
        echo(
            f"{instrument.name:<12}  {instrument.wavelength_angstrom:6.1f} angstrom  {instrument.version}  "
            f"{instrument.status}  `heliopsf psf build --instrument {instrument.name} -o FILE`"
        )


@click.command("upload")
@click.argument("file", type=FILE)
@click.option("--name", help="Name [default: PSFNAME in the header, or the file name]")
@click.option("--version", help="Version [default: PSFVERS in the header]")
@_series_options
@on_service
def upload_psf(service: Client, file: Path, **description: str | None) -> None:
    """Upload a PSF from FILE (FITS). A PSF of kind total is used for images of its instrument when it is certified."""
    row = service.upload_psf(file, **description)
    series = f"{row['instrument'] or 'unknown instrument'} {row['channel'] or '-'} {row['kind']}"
    echo(f"{_named(row)}  {row['status']}  {series}")


@click.command("certify")
@PSF_ID
@click.option(
    "--version",
    help="Version of a draft, such as 1.2.0, which the series does not have yet; a certified PSF keeps its version",
)
@click.option("--from", "valid_from", metavar="TIME",
              help="Start of its time range (included) [default: no start]")  # fmt: skip
@click.option("--to", "valid_to", metavar="TIME", help="End of its time range (excluded) [default: open]")
@click.option("--supersedes", multiple=True, type=ID, metavar="ID",
              help="Also deprecate this certified PSF; can be repeated")  # fmt: skip
@REASON
@_series_options
@on_service
def certify(
    service: Client, psf_id: str, supersedes: tuple[str, ...], reason: str, **change: str | None
) -> None:
    """Certify a PSF for a range of times of observation, or change the range of a certified PSF."""
    superseded = [whole_id(service, "psfs", identity) for identity in supersedes]
    now = service.certify_psf(psf_id, supersedes=superseded, reason=reason, **change)
    echo(f"{now['series']} {now['version']}: {now['status']}{_validity(now)}")


@click.command("deprecate")
@PSF_ID
@click.option("--successor", type=ID, metavar="ID", help="Certified PSF to use instead")
@REASON
@on_service
def deprecate(service: Client, psf_id: str, successor: str | None, reason: str) -> None:
    """Deprecate a certified PSF, so that it is no longer chosen; or name the successor of a deprecated PSF."""
    successor_id = None if successor is None else whole_id(service, "psfs", successor)
    now = service.deprecate_psf(psf_id, successor_id, reason=reason)
    count = sum(1 for _ in service.affected(psf_id))
    instead = f", use {short(now['successor'])}" if now["successor"] else ""
    echo(f"{now['series']} {now['version']}: {now['status']}{instead}")
    echo(f"products made with it: {count}")


@click.command("delete")
@PSF_ID
@on_service
def delete_psf(service: Client, psf_id: str) -> None:
    """Delete a draft with its files.

    A PSF is not deleted if it is used by a product, a job that has not ended, an open bulk run, a context or another
    PSF.
    """
    echo(f"deleted {_named(service.delete_psf(psf_id))}")


@click.command("best")
@click.option("--image", type=FILE, help="Image (FITS) for which a PSF is wanted")
@_filter_options
@JSON
@on_service
@writes_files
def best(
    service: Client, image: Path | None, json_file: Path | None, overwrite: bool, **filters: str | None
) -> None:
    """With --image, show the PSF that `heliopsf deconvolve` would use for the image, and why. Without it, find the PSF
    with the given properties. With --image and a --kind other than total, only certified PSFs or the PSFs of a context
    are searched.
    """
    filters = without_none(filters)
    if image is not None and set(filters) - {"context", "kind"}:
        raise click.UsageError(
            "--image can only be combined with --context and --kind; leave out the other filters"
        )
    if image is None:
        choice: Choice | Reasoned = service.best_psf(**filters)
    elif filters.get("kind", TOTAL) == TOTAL:
        choice = _choice(service, image, filters.get("context"))
    else:
        choice = service.psf_for_image(service.upload_image(image)["id"], **filters)
    psf = cast("Psf", choice["psf"])  # the entry of an estimate has neither status nor range
    status = "not built yet" if psf["status"] is None else f"{psf['status']}{_validity(psf)}"
    echo(f"{_named(psf)}  {status}")
    if why := choice.get("why"):
        echo(f"  {why}")
    write_json(json_file, choice, overwrite=overwrite)


@click.command("lineage")
@id_argument()
@PRODUCT
@JSON
@click.option("--prov", "prov_file", type=OUTPUT,
              help="Write the lineage as W3C PROV: PROV-N if the name ends in .provn, otherwise PROV-JSON")  # fmt: skip
@on_service
@writes_files
def lineage(
    service: Client,
    identity: str,
    of: Literal["product", "psf"],
    json_file: Path | None,
    prov_file: Path | None,
    overwrite: bool,
) -> None:
    """Show from which images, transits and PSFs a PSF or a product was made, back to the uploads."""
    entry = service.lineage(of, identity)
    if prov_file is not None:
        service.provenance(of, entry["id"], prov_file, overwrite=overwrite)
    echo("\n".join(_tree(entry, 0)))
    write_json(json_file, entry, overwrite=overwrite)


@click.command("rerun")
@id_argument()
@PRODUCT
@JSON
@on_service
@writes_files
def rerun(
    service: Client, identity: str, of: Literal["product", "psf"], json_file: Path | None, overwrite: bool
) -> None:
    """Make a PSF or a product again and compare both results. If they differ, the exit status is 1."""
    with progress_bar() as progress:
        report = service.rerun(of, whole_id(service, f"{of}s", identity), progress=progress)
    if json_file is not None:
        service.download(report["file"], json_file, overwrite=overwrite)
    echo(report["details"]["sentence"])
    sys.exit(0 if report["details"]["same"] else 1)


@click.command("series")
@click.argument("series", required=False, metavar="[SERIES]")
@click.option("--interpolate/--no-interpolate", "interpolated", default=None,
              help="Allow or forbid interpolation between the certified PSFs of SERIES")  # fmt: skip
@REASON
@on_service
def series(service: Client, series: str | None, interpolated: bool | None, reason: str) -> None:
    """List the series of which a PSF was certified, or say whether the PSFs of SERIES may be interpolated in time.

    SERIES is instrument/channel/kind, such as hri_euv/174/total. If its PSFs may be interpolated, an image whose time
    is between the ranges of two certified PSFs is deconvolved with a PSF between the two. Contexts that exist do not
    change.
    """
    if (series is None) != (interpolated is None):
        raise click.UsageError(
            "expected SERIES with --interpolate or --no-interpolate, or neither; got only one of them"
        )
    rows = service.series()
    if series is not None and interpolated is not None:
        rows = iter([service.interpolate_series(series, interpolated, reason=reason)])
    print_rows(
        rows,
        lambda row: (
            f"{row['series']}  {'may be interpolated' if row['interpolated'] else 'not interpolated'}"
        ),
        if_none="no series yet; `heliopsf psf certify` begins a series",
    )


@click.command("interpolate")
@click.argument("before", type=ID, metavar="BEFORE")
@click.argument("after", type=ID, metavar="AFTER")
@click.option("--time", required=True, metavar="TIME", help="Time of the new PSF, such as 2024-03-01")
@click.option("--before-until", metavar="TIME",
              help="Last time at which BEFORE holds [default: the end of its range]")  # fmt: skip
@click.option("--after-from", metavar="TIME",
              help="First time at which AFTER holds [default: the start of its range]")  # fmt: skip
@click.option("-o", "--output", type=OUTPUT, help="Write the PSF (FITS)")
@on_service
@writes_files
def interpolate(
    service: Client,
    before: str,
    after: str,
    time: str,
    before_until: str | None,
    after_from: str | None,
    output: Path | None,
    overwrite: bool,
) -> None:
    """Interpolate between two fitted PSFs, BEFORE and AFTER, in time. Both must have the same shape and diffraction
    PSF.

    The new PSF is a draft. `heliopsf psf series --interpolate` lets deconvolutions do this by themselves.
    """
    first, second = (whole_id(service, "psfs", one) for one in (before, after))
    times = {
        "before_time": before_until or _limit(service, first, "valid_to", "--before-until"),
        "after_time": after_from or _limit(service, second, "valid_from", "--after-from"),
    }
    with progress_bar() as report:
        psf = service.interpolate_psf(first, second, time, progress=report, **times)
    if output is not None:
        service.download(psf["file"], output, overwrite=overwrite)
    echo(f"{_named(psf)}  {psf['status']}")
    say_fit(psf["details"]["fit"])


@click.group(short_help="Pin sets of PSFs that never change.")
def context() -> None:
    """Pin sets of PSFs that never change, so that years of work use the same PSFs."""


@context.command("create", short_help="Create a context from certified PSFs.")
@click.argument("name")
@click.option("--psf", "psf_ids", multiple=True, type=ID, metavar="ID",
              help="Id of a PSF to pin; can be repeated [default: all certified PSFs]")  # fmt: skip
@REASON
@on_service
def create(service: Client, name: str, psf_ids: tuple[str, ...], reason: str) -> None:
    """Create a context NAME that pins all PSFs that are certified now, or the PSFs that you name."""
    pins = [{"psf_id": whole_id(service, "psfs", psf_id)} for psf_id in psf_ids] or None
    row = service.create_context(name, pins, reason=reason)
    echo(f"{short(row['id'])}  {row['name']}  {row['size']} pinned")


@context.command("list", short_help="List contexts.")
@on_service
def list_contexts(service: Client) -> None:
    """List contexts. A * marks the default context."""
    default = service.default_context()["context"]

    def line(row: ContextLine) -> str:
        sign = "*" if default is not None and default["id"] == row["id"] else " "
        return f"{sign} {short(row['id'])}  {row['name']}  {row['size']} pinned  {row['reason']}"

    none = "no context yet; `heliopsf context create NAME` pins the certified PSFs"
    print_rows(service.contexts(), line, if_none=none)


@context.command("show", short_help="List the PSFs of a context.")
@click.argument("name")
@on_service
def show(service: Client, name: str) -> None:
    """List the PSFs that the context NAME (or id) pins."""
    row = service.context(name)
    echo(f"{short(row['id'])}  {row['name']}")
    for pin in row["pins"]:
        may = "  may be interpolated" if pin["interpolated"] else ""
        echo(f"  {pin['series']}  {_range(pin)}  {pin['version']}  {short(pin['psf_id'])}{may}")


@context.command("use", short_help="Set the default context.")
@click.argument("name", required=False)
@click.option("--none", "no_context", is_flag=True,
              help="Set no default: use the PSFs that are certified at the time of a request")  # fmt: skip
@REASON
@on_service
def use(service: Client, name: str | None, no_context: bool, reason: str) -> None:
    """Make the context NAME (or id) the default: the PSF is chosen from it if a request names no context."""
    if (name is None) != no_context:
        raise click.UsageError("expected either NAME or --none")
    now = service.use_context(name, reason=reason)["context"]
    echo(
        "no default context: the certified PSFs are used"
        if now is None
        else f"default: {now['name']}  {short(now['id'])}"
    )


def _choice(service: Client, image: Path, context: str | None) -> Reasoned:
    """The PSF that a deconvolution of an image would use, and why. If the PSF is not built yet, only its entry in the
    estimate is known.
    """
    image_id = service.upload_image(image)["id"]
    choice = service.estimate("deconvolve", image_id=image_id, context=context)["psf"]
    assert choice is not None  # of a job that deconvolves
    return {"psf": choice if choice["status"] is None else service.psf(choice["id"]), "why": choice["why"]}


def _limit(service: Client, psf_id: str, name: Literal["valid_from", "valid_to"], option: str) -> str:
    """The end or the start of the range for which a PSF is certified."""
    at = service.psf(psf_id)[name]
    if at is None:
        raise click.UsageError(
            f"expected {option}, because PSF {short(psf_id)} has no {'end' if name == 'valid_to' else 'start'} of a "
            "range of times"
        )
    return at


def _named(psf: Psf) -> str:
    """The short id, the name and the version of a PSF."""
    return f"{short(psf['id'])}  {psf['name']}  {psf['version']}"


def _validity(row: Psf | Status) -> str:
    """The time range of a PSF; empty if the PSF was never certified."""
    return f"  {_range(row)}" if row["was_certified"] else ""


def _range(row: Psf | Status | Pin) -> str:
    return f"[{row['valid_from'] or 'always'}, {row['valid_to'] or 'open'})"


def _tree(entry: Ancestor, depth: int) -> Iterator[str]:
    """A lineage as lines. The inputs of an entry follow it on indented lines."""
    details: Mapping[str, object] = entry["made"] or {}
    name = " ".join(str(details[key]) for key in ("name", "version", "status") if details.get(key))
    by = [f"heliopsf {details['software_version']}"] if details.get("software_version") else []
    by += [f"job {short(str(details['job_id']))}"] if details.get("job_id") else []
    share = f"weight {entry['weight']:.3f}" if entry.get("weight") is not None else ""
    gone = "" if entry["there"] or entry["type"] == "instrument-file" else "deleted since"
    cut = "shown above" if entry["cut"] else ""
    text = "; ".join(part for part in (name, share, ", ".join(by), gone, cut) if part)
    yield "  " * depth + f"{entry['type']} {short(entry['id'])}" + (f"  ({text})" if text else "")
    for parent in entry["parents"]:
        yield from _tree(parent, depth + 1)
