"""``heliopsf bulk``: an archive reprocessed."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from service.cli.connection import SERVER, named_psf, remote
from service.cli.options import METHODS, NOISE, OUTPUT, SATURATION, check_writable, progress_bar, user_errors
from service.client.http import percent

_CONDITION = re.compile(r"([A-Z0-9_-]{1,8})\s*(=|!=|<=|>=|<|>)\s*(.+)")
BULK_ID = click.argument("bulk_id", metavar="ID")


class _Condition(click.ParamType):
    name = "condition"

    def convert(
        self, value: object, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[str, str, Any]:
        """(keyword, sign, value) of a text such as WAVELNTH=174."""
        parts = _CONDITION.fullmatch(str(value).strip())
        if parts is None:
            self.fail(f"expected KEYWORD=VALUE, or one of != < <= > >= between; got {value!r}", param, ctx)
        return parts[1], parts[2], _value(parts[3])


@click.group()
def bulk() -> None:
    """Have many images deconvolved alike: uploads, or files of an archive that the service reads itself."""


@bulk.command("submit")
@click.argument("patterns", nargs=-1)
@click.option("--psf", metavar="ID|FILE", help="PSF for all images: an id, or a file of yours")
@click.option("--context", help="Or the context to find each image's PSF in: its id or name")
@click.option("--upload", "uploads", multiple=True, type=click.Path(exists=True, path_type=Path),
              help="A file of this machine, or a folder of FITS files, to send and deconvolve")  # fmt: skip
@click.option("--image", "images", multiple=True, metavar="ID", help="An image that was uploaded before")
@click.option("--where", "conditions", multiple=True, type=_Condition(), metavar="KEYWORD=VALUE",
              help="What a file's header must say; several must all be met")  # fmt: skip
@click.option("--output", help="Folder on the service's machine to write products to")
@click.option("--only", is_flag=True, help="There alone: the service keeps no product")
@click.option("--method", type=click.Choice(METHODS), default=METHODS[0], show_default=True)
@click.option("--steps", type=click.IntRange(1, 200), help="[default: the method's]")
@NOISE
@SATURATION
@click.option("--name", default="", help="A label")
@click.option("--wait", is_flag=True, help="Stay until it ends")
@SERVER
def submit(
    patterns: tuple[str, ...],
    psf: str | None,
    context: str | None,
    uploads: tuple[Path, ...],
    images: tuple[str, ...],
    conditions: tuple[tuple[str, str, Any], ...],
    output: str | None,
    only: bool,
    method: str,
    steps: int | None,
    noise: tuple[float, float] | None,
    saturation_dn: float | None,
    name: str,
    wait: bool,
    server: str | None,
) -> None:
    """Submit a bulk of the files that PATTERNS name on the service's machine, below a folder that its operator allows.

    A pattern is an absolute path; * ? and [ab] stand for parts of a name, ** for any folders between. Quote it.
    """
    if (psf is None) == (context is None):
        raise click.UsageError("expected one of --psf and --context")
    figures = {"photon_gain_dn": noise[0], "read_noise_dn": noise[1]} if noise else None
    with user_errors(), remote(server) as service:
        sent = [service.upload_image(path)["id"] for path in _fits_files(uploads)]
        made = service.submit_bulk(
            images=[*images, *sent],
            files=[{"glob": pattern, "where": _where(conditions)} for pattern in patterns],
            psf_id=named_psf(service, psf),
            context=context,
            output=output,
            only=only,
            name=name,
            method={"name": method} | ({} if steps is None else {"steps": steps}),
            noise=figures,
            saturation_dn=saturation_dn,
        )
        click.echo(f"bulk {made['id']}")
        if wait:
            with progress_bar() as report:
                made = service.wait_for_bulk(made["id"], progress=report)
        click.echo("\n".join(_said(made)))


@bulk.command("status")
@click.argument("bulk_id", metavar="[ID]", required=False)
@click.option("--wait", is_flag=True, help="Stay until it ends")
@SERVER
def status(bulk_id: str | None, wait: bool, server: str | None) -> None:
    """Say how far a bulk is, how fast, and until when; without an ID, list all."""
    with user_errors(), remote(server) as service:
        if bulk_id is None:
            for row in service.bulks():
                click.echo(
                    f"{row['id']}  {row['phase']:<9}  {row['done']} of {row['total']} done, {row['failed']} failed  "
                    f"{row['name']}".rstrip()
                )
            return
        if wait:
            with progress_bar() as report:
                service.wait_for_bulk(bulk_id, progress=report)
        click.echo("\n".join(_said(service.bulk(bulk_id))))


@bulk.command("retry")
@BULK_ID
@SERVER
def retry(bulk_id: str, server: str | None) -> None:
    """Try again the images that failed."""
    with user_errors(), remote(server) as service:
        click.echo("\n".join(_said(service.retry_bulk(bulk_id))))


@bulk.command("pause")
@BULK_ID
@SERVER
def pause(bulk_id: str, server: str | None) -> None:
    """Begin no more images; those at work are let end."""
    with user_errors(), remote(server) as service:
        click.echo("\n".join(_said(service.pause_bulk(bulk_id))))


@bulk.command("resume")
@BULK_ID
@SERVER
def resume(bulk_id: str, server: str | None) -> None:
    """Let a bulk that was paused, or could not go on, go on where it was."""
    with user_errors(), remote(server) as service:
        click.echo("\n".join(_said(service.resume_bulk(bulk_id))))


@bulk.command("cancel")
@BULK_ID
@SERVER
def cancel(bulk_id: str, server: str | None) -> None:
    """End a bulk for good; what is done stays."""
    with user_errors(), remote(server) as service:
        click.echo("\n".join(_said(service.cancel_bulk(bulk_id))))


@bulk.command("report")
@BULK_ID
@click.option("-o", "--output", type=OUTPUT, help="Write the manifest of all that is done (.ndjson or .csv)")
@click.option("--failures", type=OUTPUT, help="Write what failed, with reasons (.ndjson)")
@click.option("--most", default=20, show_default=True, type=click.IntRange(0, 10_000), help="Images to show")
@SERVER
def report(bulk_id: str, output: Path | None, failures: Path | None, most: int, server: str | None) -> None:
    """Say what a bulk did: the images whose artefacts are most doubtful first, then what failed."""
    check_writable(output, failures)
    with user_errors(), remote(server) as service:
        click.echo("\n".join(_said(service.bulk(bulk_id))))
        for row in service.bulk_results(bulk_id, order="worst", limit=most) if most else ():
            click.echo(_line(row))
        failed = list(service.bulk_failures(bulk_id))
        for row in failed[:most]:
            click.echo(f"failed: {row['source']}: {row['error']['message']}")
        if len(failed) > most:
            click.echo(f"... and {len(failed) - most} more that failed")
        if output is not None:
            is_table = output.suffix.lower() == ".csv"
            service.write_bulk_manifest(bulk_id, output, format="csv" if is_table else "ndjson")
            click.echo(str(output))
        if failures is not None:
            failures.write_text("".join(f"{json.dumps(row)}\n" for row in failed), "utf-8")
            click.echo(str(failures))


COMMANDS = (bulk,)


def _said(found: dict[str, Any]) -> list[str]:
    images = found["images"]
    lines = [
        f"{found['phase']}: {images['done']} of {images['total']} done"
        + (f" ({images['reused']} there already)" if images["reused"] else "")
        + f", {images['failed']} failed, {images['at_work']} at work, {images['waiting']} waiting"
    ]
    if images["to_look_at"]:
        lines.append(f"{images['to_look_at']} to look at: `heliopsf bulk report {found['id']}`")
    if found["images_an_hour"]:
        lines.append(f"{found['images_an_hour']:.0f} images an hour{_left(found['time_left_s'])}")
    if found["error"]:
        lines.append(f"stopped: {found['error']['message']}")
    return lines


def _left(seconds: float | None) -> str:
    if seconds is None:
        return ""
    for unit, length in (("days", 86_400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * length:
            return f", {seconds / length:.0f} {unit} left"
    return f", {seconds:.0f} s left"


def _line(row: dict[str, Any]) -> str:
    changes = "  ".join(
        f"{kind} {percent(row[kind]['sum_pct'])} (to {row[kind]['up_to_pct']:+.0f})"
        for kind in ("bright", "dark")
        if row[kind] is not None
    )
    return f"{row['score']:8.2f}  {changes}  {row['source']}"


def _fits_files(paths: Sequence[Path]) -> list[Path]:
    """Files as they were named; of a folder the FITS files in it."""
    found: list[Path] = []
    for path in paths:
        found += sorted(one for one in path.iterdir() if _is_fits(one)) if path.is_dir() else [path]
    return found


def _is_fits(path: Path) -> bool:
    return path.name.lower().endswith((".fits", ".fits.gz", ".fts", ".fit"))


def _where(conditions: Sequence[tuple[str, str, Any]]) -> dict[str, Any]:
    """Conditions as the service takes them; several values that a card may equal are one of these."""
    where: dict[str, Any] = {}
    for key, sign, value in conditions:
        if sign == "=":
            before = where.get(key)
            where[key] = value if before is None else [*_as_list(before, key), value]
            continue
        where.setdefault(key, {})
        if not isinstance(where[key], dict):
            raise click.UsageError(f"--where {key}: expected either values or comparisons; got both")
        where[key][sign] = value
    return where


def _as_list(before: Any, key: str) -> list[Any]:
    if isinstance(before, dict):
        raise click.UsageError(f"--where {key}: expected either values or comparisons; got both")
    return before if isinstance(before, list) else [before]


def _value(text: str) -> bool | int | float | str:
    """T and F, numbers, or else a text, which may stand in quotation marks to be one."""
    if text in ("T", "F"):
        return text == "T"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    quoted = len(text) >= 2 and text[0] == text[-1] and text[0] in "'\""
    return text[1:-1] if quoted else text
