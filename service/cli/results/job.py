"""``heliopsf job``: list, show, wait for and cancel jobs on a service."""

from __future__ import annotations

from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Any

import click

from service.cli.connection import SERVER, id_argument, remote, short
from service.cli.options import JSON, progress_bar, user_errors, write_json, writes_files
from service.cli.progress import duration, told
from service.client.errors import ServiceError
from workers.contract.phases import Phase

# How to get the result of a job, by the part of its address that names the type of the result.
NEXT = {
    "products": "product {id}: heliopsf product get {id} -o FILE{at}",
    "psfs": "PSF {id}: heliopsf psf download {id} -o FILE{at}",
    "reports": "report {id}: repeat the command that started the job; it ends at once and writes its files",
    "bulk": "bulk run {id}: heliopsf bulk status {id}{at}",
}
NAMES = {"products": "product", "psfs": "PSF", "reports": "report", "bulk": "bulk run"}
MOST = click.option(
    "--most",
    default=20,
    show_default=True,
    type=click.IntRange(1),
    help="Number of lines to show, newest first",
)


@click.group(short_help="List, show, wait for and cancel jobs.")
def job() -> None:
    """List, show, wait for and cancel jobs on a service."""


@job.command("list", short_help="List your jobs.")
@click.option("--phase", type=click.Choice([str(phase) for phase in Phase]), help="Only jobs in this phase")
@MOST
@SERVER
def list_jobs(phase: str | None, most: int, server: str | None) -> None:
    """List your jobs, newest first."""
    filters = {} if phase is None else {"phase": phase}
    with user_errors(), remote(server) as service:
        rows = list(islice(service.jobs(**filters), most))
    if not rows:
        click.echo("no job yet" if phase is None else f"no job in phase {phase}")
    for row in rows:
        click.echo(
            f"{short(row['id'])}  {row['phase']:<9}  {row['kind']:<14}  {moment(row['created_at'])}  {_state(row, server)}".rstrip()
        )


@job.command("show", short_help="Show a job.")
@id_argument()
@JSON
@SERVER
@writes_files
def show(identity: str, json_file: Path | None, server: str | None, overwrite: bool) -> None:
    """Show the phase, progress, and result or error of a job."""
    with user_errors(), remote(server) as service:
        found = service.job(identity)
    click.echo("\n".join(_lines(found, server)))
    write_json(json_file, found, overwrite=overwrite)


@job.command("wait", short_help="Wait for jobs.")
@id_argument("identities", several=True)
@SERVER
def wait(identities: tuple[str, ...], server: str | None) -> None:
    """Wait until jobs have ended. If one of them failed or was cancelled, the exit status is 1."""
    failed = 0
    with user_errors(), remote(server) as service:
        for identity in identities:
            found = service.job(identity)
            try:
                with progress_bar() as report:
                    found = service.wait(found, progress=report)
            except ServiceError as error:
                if error.status is not None or error.code is None:  # the request failed, not the job
                    raise
                failed += 1
                ended = Phase.ABORTED if error.code == "cancelled" else error
                click.echo(f"job {short(found['id'])}: {ended}", err=True)
                continue
            click.echo(f"job {short(found['id'])}: {_state(found, server)}")
    if failed:
        raise click.exceptions.Exit(1)


@job.command("cancel", short_help="Cancel jobs.")
@id_argument("identities", several=True)
@SERVER
def cancel(identities: tuple[str, ...], server: str | None) -> None:
    """Cancel jobs. A queued job ends at once, an executing job at its next step."""
    with user_errors(), remote(server) as service:
        for identity in identities:
            found = service.cancel(identity)
            stops = found["cancel_requested"] and not Phase(found["phase"]).ended
            click.echo(f"job {short(found['id'])}: {'stops at its next step' if stops else found['phase']}")


COMMANDS = (job,)


def moment(seconds: float) -> str:
    """A time as text, in UTC."""
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%M:%SZ")


def _state(found: dict[str, Any], server: str | None) -> str:
    """The progress, result or error of a job in one line; empty for a job that waits. server: the value of --server, if
    given."""
    if found["error"] is not None:
        return str(found["error"]["message"])
    if found["result"] is not None:
        things, identity = found["result"].split("/")[-2:]
        if found["result_deleted"]:
            return f"{NAMES[things]} {short(identity)} was deleted; the same request makes it again"
        at = "" if server is None else f" --server {server}"
        return NEXT[things].format(id=short(identity), at=at)
    now = found["progress"]
    if Phase(found["phase"]) != Phase.EXECUTING:
        return ""
    left = "" if now["time_left_s"] is None else f", {duration(now['time_left_s'])} left"
    return f"{told(now['stage'], now['step'], now['steps'])}{left}"


def _lines(found: dict[str, Any], server: str | None) -> list[str]:
    lines = [
        f"job {found['id']}: {found['kind']}, {found['phase']}",
        f"  queue {found['queue']}, attempt {found['attempt']}",
    ]
    for name, key in (("created", "created_at"), ("started", "started_at"), ("ended", "ended_at")):
        if found[key] is not None:
            lines.append(f"  {name:<8} {moment(found[key])}")
    lines += [f"  {name} {_value(value)}" for name, value in found["parameters"].items() if value is not None]
    state = _state(found, server)
    return [*lines, f"  {state}"] if state else lines


def _value(value: Any) -> str:
    """A parameter in one line: an id is shortened, and a long text is cut."""
    text = str(value)
    if isinstance(value, str) and len(text) == 64 and set(text) <= set("0123456789abcdef"):
        return short(text)
    return text if len(text) <= 100 else f"{text[:100]}..."
