"""The commands for operators: ``heliopsf database``, ``store`` and ``key``."""

from __future__ import annotations

import json
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

import click
from sqlalchemy import make_url
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from psfcore.files import sha256_of
from psfcore.fits.header import read_summary
from service.cli.options import DATA, read_settings, user_errors
from service.cli.progress import echo
from service.cli.psf.query import NAMES, SOURCE, brought
from workers import checks
from workers.catalogue.access import MEANINGS, OWNER, OWNER_RULE, Scope
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.quotas import MIB, MOST_QUOTA_MIB, Usage
from workers.catalogue.schema import SchemaError, SchemaStatus
from workers.catalogue.tables import DEFAULT_OWNER, KeyRow
from workers.files.garbage import collect, examine
from workers.files.modes import keep_private, private_folder
from workers.files.store import open_store
from workers.intake.repair import repair
from workers.intake.uploads import uploaded_psf_row
from workers.texts import check_line
from workers.versions import TOTAL

DAY_S = 86_400
UNITS_S = {"h": 3600, "d": DAY_S, "w": 7 * DAY_S}
DEFAULT_SCOPES = (Scope.READ, Scope.SUBMIT)
SENTENCES = {
    "empty": "the database is empty; the first start of a server makes its tables at revision {wanted}",
    "unversioned": "the database has tables without a revision; this version needs revision {wanted}",
    "obsolete": "the database is at revision {revision} of a development version, which this version cannot upgrade; it needs {wanted}",
    "older": "the database is at revision {revision}; this version needs {wanted}",
    "current": "the database is at revision {revision}, which this version needs",
    "newer": "the database is at revision {revision} of a later version of heliopsf; this version knows revisions up to {wanted}",
}


class Duration(click.ParamType):
    """A duration in seconds, written as 12h, 30d or 8w."""

    name = "duration"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Convert a text such as 30d to seconds."""
        parts = re.fullmatch(r"([0-9]{1,5})([hdw])", str(value))
        if parts is None or not int(parts[1]):
            self.fail(f"expected a duration such as 12h, 30d or 8w; got {value!r}", param, ctx)
        return int(parts[1]) * UNITS_S[parts[2]]


# The database ------------------------------------------------------------------------------


@click.group(short_help="Show or upgrade the database's tables.")
def database() -> None:
    """Show or upgrade the revision of the database's tables."""


@database.command("status", short_help="Show the revision of the tables.")
@DATA
def status(data: Path | None) -> None:
    """Show the revision of the database and the revision that this version needs. If they differ, the exit status is 1."""
    with opened_catalogue(data) as catalogue:
        schema = catalogue.schema.status()
    echo(sentence(schema))
    if schema.state != "current":
        raise click.exceptions.Exit(1)


@database.command("upgrade", short_help="Upgrade the tables.")
@DATA
def upgrade(data: Path | None) -> None:
    """Upgrade the tables to the revision of this version, as the next `heliopsf serve` would.

    The command also restores missing tables and indexes. A database of SQLite is copied first, into a file beside it; of
    PostgreSQL, make a copy yourself.
    """
    with opened_catalogue(data) as catalogue:
        before = catalogue.schema.status()
        copy = catalogue.upgrade()
        catalogue.schema.mend()
        now = catalogue.schema.status()
    if copy is not None:
        echo(f"the database as it was: {copy}")
    if now != before:
        echo(f"upgraded from {before.revision or 'no revision'} to {now.revision}")
    echo(sentence(now))


def sentence(schema: SchemaStatus) -> str:
    """The revision of a database as a sentence."""
    return SENTENCES[schema.state].format(revision=schema.revision, wanted=schema.wanted)


@contextmanager
def opened_catalogue(data: Path | None) -> Iterator[Catalogue]:
    """The catalogue of a data folder. Its database is not upgraded; an error of the database becomes a ``ClickException``."""
    settings = read_settings(data)
    keep_private()
    if settings.database_url is None:
        private_folder(settings.data_dir)
    try:
        catalogue = Catalogue(settings.catalogue_url)
    except (ArgumentError, ImportError, ValueError) as error:
        raise click.ClickException(
            f"HELIOPSF_DATABASE_URL cannot be used ({type(error).__name__}); set it to postgresql://..., or unset it"
        ) from error
    try:
        yield catalogue
    except SchemaError as error:
        raise click.ClickException(str(error)) from error
    except SQLAlchemyError as error:
        raise click.ClickException(f"the database: {checks.database_said(error)}") from error
    finally:
        catalogue.close()


# The stored files --------------------------------------------------------------------------


@click.group(short_help="Check and clean up stored files; set quotas.")
def store() -> None:
    """Check and clean up the files of a service. Run it on the machine of the service, with its settings."""


@store.command("collect", short_help="Remove files that nothing refers to.")
@click.option("--dry-run", is_flag=True, help="List the files that would be removed, but remove nothing")
@click.option("--older-than", "older_than_s", type=Duration(), default="30d",
              help="Remove only files older than this")  # fmt: skip
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
        result = collect(catalogue, open_store(settings), older_than_s, dry_run=dry_run, even_most=even_most)
    if dry_run:
        for blob in result.removed:
            echo(f"{blob.digest}  {blob.bytes:>12}")
    echo(
        f"{len(result.removed)} of {result.files} files {'would be' if dry_run else 'were'} removed, "
        f"{result.removed_bytes / MIB:.1f} of {result.bytes / MIB:.1f} MiB"
    )


@store.command("check", short_help="Find lost and damaged files.")
@click.option("--sizes", is_flag=True, help="Compare only the sizes of files; do not read the files")
@click.option("--repair", "repairs", is_flag=True,
              help="Set damaged files aside, and queue the jobs that make lost results again")  # fmt: skip
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
            line = f"{fault.row.thing():<8}  {fault.row.owner}  {fault.row.id}  {bad}"
            echo(f"{line}: {repair(fault, catalogue, files)}" if repairs else line)
    if count == 0:
        echo("all files are good")
        return
    advice = "" if repairs else "; to let jobs make them again where this is possible, add --repair"
    echo(f"the catalogue has {count} entries with lost or damaged files{advice}", err=True)
    raise click.exceptions.Exit(1)


@store.command("usage", short_help="Show how much each owner stores.")
@DATA
def usage(data: Path | None) -> None:
    """Show how much each owner stores, and the quota of each owner."""
    settings = read_settings(data)
    with opened_catalogue(data) as catalogue:
        for one in catalogue.quotas.all(settings.quota_mib):
            echo(_line(one))


@store.command("quota", short_help="Set the quota of an owner.")
@click.argument("owner")
@click.argument("mib", type=click.IntRange(0, MOST_QUOTA_MIB), required=False)
@click.option("--default", "as_all", is_flag=True, help="Use the default limit again (HELIOPSF_QUOTA_MIB)")
@DATA
def quota(owner: str, mib: int | None, as_all: bool, data: Path | None) -> None:
    """Set the quota of an OWNER to MIB; 0: unlimited."""
    if (mib is None) != as_all:
        raise click.UsageError("expected either a number of MiB or --default")
    if not OWNER.fullmatch(owner):
        raise click.BadParameter(f"OWNER: expected {OWNER_RULE}; got {owner!r}")
    with opened_catalogue(data) as catalogue:
        catalogue.quotas.set_quota(owner, mib)
        echo(_line(catalogue.quotas.usage(owner, read_settings(data).quota_mib)))


@store.group("psf", short_help="Add published PSFs to a service.")
def store_psf() -> None:
    """Add published PSFs to a service, for all of its owners."""


@store_psf.command("get", short_help="Bring a published PSF and add it for all owners.")
@NAMES
@SOURCE
@click.option("--owner", "owners", multiple=True,
              help="Add it for this owner; can be repeated [default: every owner with a valid key, and requests without a key]")  # fmt: skip
@DATA
def store_psf_get(
    names: tuple[str, ...], source: Path | None, owners: tuple[str, ...], data: Path | None
) -> None:
    """Bring published PSFs and add them to the service as drafts of kind total, so that requests name them and
    `heliopsf psf certify` makes one the PSF of its telescope.

    Owners who get their first key later need the command again.
    """
    for owner in owners:
        if not OWNER.fullmatch(owner):
            raise click.BadParameter(f"expected {OWNER_RULE}; got {owner!r}", param_hint="--owner")
    settings = read_settings(data)
    with opened_catalogue(data) as catalogue:
        catalogue.upgrade()
        valid = {key.owner for key in catalogue.keys.all() if _state(key) == "good"}
        store = open_store(settings)
        for name in names:
            file = brought(name, source)
            for owner in sorted(owners or valid | {DEFAULT_OWNER}):
                with user_errors(), store.temporary() as copy:
                    shutil.copyfile(file, copy)
                    summary, sha256 = read_summary(copy, settings.psf_limits), sha256_of(copy)
                    row = uploaded_psf_row(owner, sha256, copy.stat().st_size, file.name, summary, kind=TOTAL)
                    with store.kept_if(copy, sha256):
                        row, new = catalogue.add(row)
                echo(f"  {row.id}  {owner}: {'added' if new else 'was there'}")


def _line(usage: Usage) -> str:
    limit = "no limit" if usage.limit_bytes is None else f"of {usage.limit_bytes / MIB:.0f} MiB"
    return f"{usage.owner:<20} {usage.used_bytes / MIB:12.1f} MiB  {limit}"


# Keys --------------------------------------------------------------------------------------


@click.group(short_help="Create, list and revoke access keys.")
def key() -> None:
    """Create, list and revoke access keys for people and programs."""


@key.command(
    "create",
    short_help="Create a key and print it once.",
    epilog="Scopes: " + "; ".join(f"{name}: {text}" for name, text in MEANINGS.items()),
)
@click.option("--owner", required=True,
              help="Owner of all data that is made with this key; an owner may have several keys")  # fmt: skip
@click.option("--scope", "scopes", multiple=True, type=click.Choice([scope.value for scope in Scope]),
              help=f"Scope of the key; can be repeated [default: {', '.join(DEFAULT_SCOPES)}]")  # fmt: skip
@click.option("--expires", type=Duration(), metavar="30d", help="Lifetime [default: until it is revoked]")
@click.option(
    "--label",
    default="",
    callback=lambda _context, _option, text: _label(text),
    show_default=False,
    help="Note that `key list` shows, for example the purpose of the key",
)
@DATA
def create(owner: str, scopes: tuple[str, ...], expires: float | None, label: str, data: Path | None) -> None:
    """Create a key and print it once. Only its hash is stored, so it cannot be shown again."""
    if not OWNER.fullmatch(owner):
        raise click.BadParameter(
            "expected lower-case letters, digits, '.', '_' and '-', at most 64", param_hint="--owner"
        )
    allowed = {Scope(scope) for scope in scopes} or set(DEFAULT_SCOPES)
    expires_at = None if expires is None else time.time() + expires
    url = make_url(read_settings(data).catalogue_url).render_as_string(hide_password=True)
    with opened_catalogue(data) as catalogue:
        catalogue.upgrade()
        echo(catalogue.keys.make(owner, allowed, label=label, expires_at=expires_at))
    ends = "until it is revoked" if expires_at is None else f"until {_day(expires_at)}"
    echo(
        f"for {owner}: {', '.join(sorted(allowed))}; {ends}. The key cannot be shown again. Clients read it from "
        f"HELIOPSF_KEY. Servers that use the database {url} accept it.",
        err=True,
    )


@key.command("list", short_help="List all keys.")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
@DATA
def list_keys(as_json: bool, data: Path | None) -> None:
    """List all keys, oldest first, including expired and revoked keys.

    The list shows the ids, not the secret keys.
    """
    with opened_catalogue(data) as catalogue:
        rows = catalogue.keys.all()
    if as_json:
        echo(json.dumps([_described(row) for row in rows], indent=1))
    elif not rows:
        echo("no key yet; `heliopsf key create --owner NAME` makes a key")
    for row in () if as_json else rows:
        used = "never used" if row.last_used_at is None else f"used {_day(row.last_used_at)}"
        echo(
            f"{row.id}  {row.owner:<16}  {_state(row):<8}  {','.join(row.scopes):<24}  "
            f"made {_day(row.created_at)}, {used}  {row.label}".rstrip()
        )


@key.command("revoke", short_help="Revoke a key.")
@click.argument("identity", metavar="ID")
@DATA
def revoke(identity: str, data: Path | None) -> None:
    """Revoke the key with this id: further requests with it are refused. Jobs that were submitted with it continue."""
    # The whole key is also accepted instead of its id.
    identity = identity.removeprefix("hpsf_").partition("_")[0]
    with opened_catalogue(data) as catalogue:
        if not catalogue.keys.revoke(identity):
            raise click.ClickException(
                f"there is no key {identity[:16]!r}; `heliopsf key list` shows all keys"
            )
    echo(f"{identity} is revoked")


def _state(row: KeyRow) -> str:
    if row.revoked_at is not None:
        return "revoked"
    return "expired" if row.expires_at is not None and row.expires_at <= time.time() else "good"


def _described(row: KeyRow) -> dict[str, object]:
    """A key as JSON, without its hash."""
    shown = ("id", "owner", "scopes", "label", "created_at", "expires_at", "revoked_at", "last_used_at")
    return {name: getattr(row, name) for name in shown} | {"state": _state(row)}


def _label(text: str) -> str:
    try:
        return check_line(text)
    except ValueError as error:
        raise click.BadParameter(str(error)) from error


def _day(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%d %H:%MZ")
