"""The commands for operators: ``heliopsf database``, ``store`` and ``key``."""

from __future__ import annotations

import json
import re
import shutil
import time
from functools import wraps
from pathlib import Path

import click
from sqlalchemy import make_url
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from psfcore.files import sha256_of
from psfcore.fits.header import read_summary
from service.cli.connection import print_rows
from service.cli.options import DATA, Command, Text, read_settings
from service.cli.progress import echo, moment
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
from workers.intake.uploads import Upload, uploaded_psf_row
from workers.settings import Settings
from workers.texts import check_line
from workers.versions import TOTAL

TO_MINUTES = "%Y-%m-%d %H:%MZ"
DAY_S = 86_400
UNITS_S = {"h": 3600, "d": DAY_S, "w": 7 * DAY_S}
DEFAULT_SCOPES = (Scope.READ, Scope.SUBMIT)
SENTENCES = {
    "empty": "the database is empty; the first start of a server makes its tables at revision {wanted}",
    "unversioned": "the database has tables without a revision; this version needs revision {wanted}",
    "obsolete": "the database is at revision {revision} of a development version, which this version cannot upgrade; "
    "it needs {wanted}",
    "older": "the database is at revision {revision}; this version needs {wanted}",
    "current": "the database is at revision {revision}, which this version needs",
    "newer": "the database is at revision {revision} of a later version of heliopsf; this version knows revisions up "
    "to {wanted}",
}


def _seconds(text: str) -> float:
    """A duration in seconds, written as 12h, 30d or 8w."""
    parts = re.fullmatch(r"([0-9]{1,5})([hdw])", text)
    if parts is None or not int(parts[1]):
        raise ValueError(f"expected a duration such as 12h, 30d or 8w; got {text!r}")
    return int(parts[1]) * UNITS_S[parts[2]]


def _owner(text: str) -> str:
    if not OWNER.fullmatch(text):
        raise ValueError(f"expected {OWNER_RULE}; got {text!r}")
    return text


DURATION, OWNER_NAME = Text(_seconds, name="duration"), Text(_owner)


def on_catalogue(command: Command) -> Command:
    """Give a command the option ``--data``, and as arguments the settings, and the catalogue of the data folder.

    The database is not upgraded. An error of the database becomes a ``ClickException``.
    """

    @DATA
    @wraps(command)
    def opened(data: Path | None, **given: object) -> None:
        settings = read_settings(data)
        keep_private()
        if settings.database_url is None:
            private_folder(settings.data_dir)
        try:
            catalogue = Catalogue(settings.catalogue_url)
        except (ArgumentError, ImportError, ValueError) as error:
            raise click.ClickException(
                f"HELIOPSF_DATABASE_URL cannot be used ({type(error).__name__}); set it to postgresql://..., or unset "
                "it"
            ) from error
        try:
            command(settings, catalogue, **given)
        except SchemaError as error:
            raise click.ClickException(str(error)) from error
        except SQLAlchemyError as error:
            raise click.ClickException(f"the database: {checks.database_said(error)}") from error
        finally:
            catalogue.close()

    return opened  # type: ignore[return-value]  # wraps keeps the signature


# The database ------------------------------------------------------------------------------


@click.group(short_help="Show or upgrade the database's tables.")
def database() -> None:
    """Show or upgrade the revision of the database's tables."""


@database.command("status", short_help="Show the revision of the tables.")
@on_catalogue
def status(_settings: Settings, catalogue: Catalogue) -> None:
    """Show the revision of the database and the revision that this version needs. If they differ, the exit status is
    1.
    """
    schema = catalogue.schema.status()
    echo(sentence(schema))
    if schema.state != "current":
        raise click.exceptions.Exit(1)


@database.command("upgrade", short_help="Upgrade the tables.")
@on_catalogue
def upgrade(_settings: Settings, catalogue: Catalogue) -> None:
    """Upgrade the tables to the revision of this version, as the next `heliopsf serve` would.

    The command also restores missing tables and indexes. A database of SQLite is copied first, into a file beside it;
    of PostgreSQL, make a copy yourself.
    """
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


# The stored files --------------------------------------------------------------------------


@click.group(short_help="Check and clean up stored files; set quotas.")
def store() -> None:
    """Check and clean up the files of a service. Run it on the machine of the service, with its settings."""


@store.command("collect", short_help="Remove files that nothing refers to.")
@click.option("--dry-run", is_flag=True, help="List the files that would be removed, but remove nothing")
@click.option(
    "--older-than", "older_than_s", type=DURATION, default="30d", help="Remove only files older than this"
)
@click.option("--even-most", is_flag=True, help="Allow that more than half of all files are removed")
@on_catalogue
def collect_command(
    settings: Settings, catalogue: Catalogue, dry_run: bool, older_than_s: float, even_most: bool
) -> None:
    """Remove files that no upload, PSF, product, report or job refers to. Killed processes leave such files.

    Recent files are kept, because uploads and running jobs store a file before the database refers to it. If two
    databases share one store, this command removes the files of the other database. Therefore use a store for one
    database only.
    """
    if older_than_s < settings.max_job_s:
        days = -(-settings.max_job_s // DAY_S)
        raise click.BadParameter(
            f"expected {days:.0f}d or more, because a job may run for this time (HELIOPSF_MAX_JOB_S)",
            param_hint="--older-than",
        )
    if catalogue.schema.status().state != "current":
        raise click.ClickException(
            "the database is not at the revision of this version, so this command may not find all references to "
            "files; see `heliopsf database status`"
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
@click.option(
    "--repair",
    "repairs",
    is_flag=True,
    help="Set damaged files aside, and queue the jobs that make lost results again",
)
@on_catalogue
def check_command(settings: Settings, catalogue: Catalogue, sizes: bool, repairs: bool) -> None:
    """Compare every file of the store with its recorded SHA-256. If a file is lost or damaged, the exit status is 1.

    Each line names a product, PSF, report, solution or upload with such a file. Uploads cannot be made again: their
    owners must upload them again.
    """
    count = 0
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
@on_catalogue
def usage(settings: Settings, catalogue: Catalogue) -> None:
    """Show how much each owner stores, and the quota of each owner."""
    for one in catalogue.quotas.all(settings.quota_mib):
        echo(_line(one))


@store.command("quota", short_help="Set the quota of an owner.")
@click.argument("owner", type=OWNER_NAME)
@click.argument("mib", type=click.IntRange(0, MOST_QUOTA_MIB), required=False)
@click.option("--default", "as_all", is_flag=True, help="Use the default limit again (HELIOPSF_QUOTA_MIB)")
@on_catalogue
def quota(settings: Settings, catalogue: Catalogue, owner: str, mib: int | None, as_all: bool) -> None:
    """Set the quota of an OWNER to MIB; 0: unlimited."""
    if (mib is None) != as_all:
        raise click.UsageError("expected either a number of MiB or --default")
    catalogue.quotas.set_quota(owner, mib)
    echo(_line(catalogue.quotas.usage(owner, settings.quota_mib)))


@store.group("psf", short_help="Add published PSFs to a service.")
def store_psf() -> None:
    """Add published PSFs to a service, for all of its owners."""


@store_psf.command("get", short_help="Bring a published PSF and add it for all owners.")
@NAMES
@SOURCE
@click.option(
    "--owner",
    "owners",
    multiple=True,
    type=OWNER_NAME,
    help="Add it for this owner; can be repeated [default: every owner with a valid key, and requests without a key]",
)
@on_catalogue
def store_psf_get(
    settings: Settings,
    catalogue: Catalogue,
    names: tuple[str, ...],
    source: Path | None,
    owners: tuple[str, ...],
) -> None:
    """Bring published PSFs and add them to the service as drafts of kind total, so that requests name them and
    `heliopsf psf certify` makes one the PSF of its telescope.

    Owners who get their first key later need the command again.
    """
    catalogue.upgrade()
    valid = {key.owner for key in catalogue.keys.all() if _state(key) == "good"}
    store = open_store(settings)
    for name in names:
        file = brought(name, source)
        for owner in sorted(owners or valid | {DEFAULT_OWNER}):
            with store.temporary() as copy:
                shutil.copyfile(file, copy)
                summary, sha256 = read_summary(copy, settings.psf_limits), sha256_of(copy)
                upload = Upload(owner, sha256, copy.stat().st_size, file.name)
                row = uploaded_psf_row(upload, summary, kind=TOTAL)
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
@click.option(
    "--owner",
    required=True,
    type=OWNER_NAME,
    help="Owner of all data that is made with this key; an owner may have several keys",
)
@click.option(
    "--scope",
    "scopes",
    multiple=True,
    type=click.Choice([scope.value for scope in Scope]),
    help=f"Scope of the key; can be repeated [default: {', '.join(DEFAULT_SCOPES)}]",
)
@click.option("--expires", type=DURATION, metavar="30d", help="Lifetime [default: until it is revoked]")
@click.option(
    "--label",
    default="",
    type=Text(check_line),
    show_default=False,
    help="Note that `key list` shows, for example the purpose of the key",
)
@on_catalogue
def create(
    settings: Settings,
    catalogue: Catalogue,
    owner: str,
    scopes: tuple[str, ...],
    expires: float | None,
    label: str,
) -> None:
    """Create a key and print it once. Only its hash is stored, so it cannot be shown again."""
    allowed = {Scope(scope) for scope in scopes} or set(DEFAULT_SCOPES)
    expires_at = None if expires is None else time.time() + expires
    url = make_url(settings.catalogue_url).render_as_string(hide_password=True)
    catalogue.upgrade()
    echo(catalogue.keys.make(owner, allowed, label=label, expires_at=expires_at))
    ends = "until it is revoked" if expires_at is None else f"until {moment(expires_at, TO_MINUTES)}"
    echo(
        f"for {owner}: {', '.join(sorted(allowed))}; {ends}. The key cannot be shown again. Clients read it from "
        f"HELIOPSF_KEY. Servers that use the database {url} accept it.",
        err=True,
    )


@key.command("list", short_help="List all keys.")
@click.option("--json", "as_json", is_flag=True, help="Print as JSON")
@on_catalogue
def list_keys(_settings: Settings, catalogue: Catalogue, as_json: bool) -> None:
    """List all keys, oldest first, including expired and revoked keys.

    The list shows the ids, not the secret keys.
    """
    rows = catalogue.keys.all()
    if as_json:
        echo(json.dumps([_described(row) for row in rows], indent=1))
    else:
        print_rows(rows, _key_line, if_none="no key yet; `heliopsf key create --owner NAME` makes a key")


@key.command("revoke", short_help="Revoke a key.")
@click.argument("identity", metavar="ID")
@on_catalogue
def revoke(_settings: Settings, catalogue: Catalogue, identity: str) -> None:
    """Revoke the key with this id: further requests with it are refused. Jobs that were submitted with it continue."""
    # The whole key is also accepted instead of its id.
    identity = identity.removeprefix("hpsf_").partition("_")[0]
    if not catalogue.keys.revoke(identity):
        raise click.ClickException(f"there is no key {identity[:16]!r}; `heliopsf key list` shows all keys")
    echo(f"{identity} is revoked")


def _state(row: KeyRow) -> str:
    if row.revoked_at is not None:
        return "revoked"
    return "expired" if row.expires_at is not None and row.expires_at <= time.time() else "good"


def _key_line(row: KeyRow) -> str:
    used = "never used" if row.last_used_at is None else f"used {moment(row.last_used_at, TO_MINUTES)}"
    return (
        f"{row.id}  {row.owner:<16}  {_state(row):<8}  {','.join(row.scopes):<24}  "
        f"made {moment(row.created_at, TO_MINUTES)}, {used}  {row.label}"
    )


def _described(row: KeyRow) -> dict[str, object]:
    """A key as JSON, without its hash."""
    shown = ("id", "owner", "scopes", "label", "created_at", "expires_at", "revoked_at", "last_used_at")
    return {name: getattr(row, name) for name in shown} | {"state": _state(row)}
