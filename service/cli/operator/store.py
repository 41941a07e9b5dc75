"""``heliopsf store``: finds damaged files, removes files that nothing refers to, shows stored sizes, and sets quotas."""

from __future__ import annotations

from pathlib import Path

import click

from service.cli.operator.database import opened_catalogue
from service.cli.operator.key import Duration
from service.cli.options import DATA, read_settings, user_errors
from workers.catalogue.access import OWNER, OWNER_RULE
from workers.catalogue.owners import MIB, Usage
from workers.files.collection import collect
from workers.files.examination import examine
from workers.files.opened import open_store
from workers.intake.again import repair

DAY_S = 86_400


@click.group(short_help="Check and clean up stored files; set quotas.")
def store() -> None:
    """Check and clean up the files of a service. Run it on the machine of the service, with its settings."""


@store.command("collect", short_help="Remove files that nothing refers to.")
@click.option("--dry-run", is_flag=True, help="List the files that would be removed, but remove nothing")
@click.option(
    "--older-than",
    "older_than_s",
    type=Duration(),
    default="30d",
    show_default=True,
    help="Remove only files older than this",
)
@click.option("--even-most", is_flag=True, help="Allow that more than half of all files are removed")
@DATA
def collect_command(dry_run: bool, older_than_s: float, even_most: bool, data: Path | None) -> None:
    """Remove files that no upload, PSF, product, report or job refers to. Killed processes leave such files.

    Recent files are kept, because uploads and running jobs store a file before the database refers to it. If two databases
    share one store, this command removes the files of the other database. Therefore use a store for one database only.
    """
    settings = read_settings(data)
    if older_than_s < settings.max_job_s:
        days = -(-settings.max_job_s // DAY_S)
        raise click.BadParameter(
            f"expected {days:.0f}d or more, because a job may run for this time (HELIOPSF_MAX_JOB_S)",
            param_hint="--older-than",
        )
    with user_errors(), opened_catalogue(data) as catalogue:
        if catalogue.schema.status().state != "current":
            raise click.ClickException(
                "the database is not at the revision of this version, so this command may not find all references to files; see "
                "`heliopsf database status`"
            )
        found = collect(catalogue, open_store(settings), older_than_s, dry_run=dry_run, even_most=even_most)
    if dry_run:
        for blob in found.removed:
            click.echo(f"{blob.digest}  {blob.bytes:>12}")
    click.echo(
        f"{len(found.removed)} of {found.files} files {'would be' if dry_run else 'were'} removed, "
        f"{found.removed_bytes / MIB:.1f} of {found.bytes / MIB:.1f} MiB"
    )


@store.command("check", short_help="Find lost and damaged files.")
@click.option("--sizes", is_flag=True, help="Compare only the sizes of files; do not read the files")
@click.option(
    "--repair",
    "repairs",
    is_flag=True,
    help="Set damaged files aside, and queue the jobs that make lost results again",
)
@DATA
def check_command(sizes: bool, repairs: bool, data: Path | None) -> None:
    """Compare every file of the store with its recorded SHA-256. If a file is lost or damaged, the exit status is 1.

    Each line names a product, PSF, report, solution or upload with such a file. Uploads cannot be made again: their owners
    must upload them again.
    """
    settings = read_settings(data)
    count = 0
    with user_errors(), opened_catalogue(data) as catalogue:
        files = open_store(settings)
        for fault in examine(catalogue, files, content=not sizes):
            count += 1
            bad = ", ".join(f"{state} {digest}" for digest, state in fault.files)
            line = f"{fault.what:<8}  {fault.row.owner}  {fault.row.id}  {bad}"
            click.echo(f"{line}: {repair(fault, catalogue, files)}" if repairs else line)
    if count == 0:
        click.echo("all files are good")
        return
    advice = "" if repairs else "; to let jobs make them again where this is possible, add --repair"
    click.echo(f"the catalogue has {count} entries with lost or damaged files{advice}", err=True)
    raise click.exceptions.Exit(1)


@store.command("usage", short_help="Show how much each owner stores.")
@DATA
def usage(data: Path | None) -> None:
    """Show how much each owner stores, and the quota of each owner."""
    settings = read_settings(data)
    with opened_catalogue(data) as catalogue:
        for one in catalogue.owners.all(settings.quota_mib):
            click.echo(_line(one))


@store.command("quota", short_help="Set the quota of an owner.")
@click.argument("owner")
@click.argument("mib", type=click.IntRange(0), required=False)
@click.option("--default", "as_all", is_flag=True, help="Use the default limit again (HELIOPSF_QUOTA_MIB)")
@DATA
def quota(owner: str, mib: int | None, as_all: bool, data: Path | None) -> None:
    """Set the quota of an OWNER to MIB; 0: unlimited."""
    if (mib is None) != as_all:
        raise click.UsageError("expected either a number of MiB or --default")
    if not OWNER.fullmatch(owner):
        raise click.BadParameter(f"OWNER: expected {OWNER_RULE}; got {owner!r}")
    with opened_catalogue(data) as catalogue:
        catalogue.owners.set_quota(owner, mib)
        click.echo(_line(catalogue.owners.usage(owner, read_settings(data).quota_mib)))


COMMANDS = (store,)


def _line(usage: Usage) -> str:
    limit = "no limit" if usage.limit_bytes is None else f"of {usage.limit_bytes / MIB:.0f} MiB"
    return f"{usage.owner:<20} {usage.used_bytes / MIB:12.1f} MiB  {limit}"
