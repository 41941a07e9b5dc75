"""``heliopsf database``: show the revision of the database's tables, and upgrade them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from service.cli.options import DATA, read_settings
from workers import checks
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.schema import SchemaError, SchemaStatus
from workers.files.modes import keep_private, private_folder

SENTENCES = {
    "empty": "the database is empty; the first start of a server makes its tables at revision {wanted}",
    "unversioned": "the database has tables without a revision; this version needs revision {wanted}",
    "obsolete": "the database is at revision {revision} of a development version, which this version cannot upgrade; it needs {wanted}",
    "older": "the database is at revision {revision}; this version needs {wanted}",
    "current": "the database is at revision {revision}, which this version needs",
    "newer": "the database is at revision {revision} of a later version of heliopsf; this version knows revisions up to {wanted}",
}


@click.group(short_help="Show or upgrade the database's tables.")
def database() -> None:
    """Show or upgrade the revision of the database's tables."""


@database.command("status", short_help="Show the revision of the tables.")
@DATA
def status(data: Path | None) -> None:
    """Show the revision of the database and the revision that this version needs. If they differ, the exit status is 1."""
    with opened_catalogue(data) as catalogue:
        found = catalogue.schema.status()
    click.echo(sentence(found))
    if found.state != "current":
        raise click.exceptions.Exit(1)


@database.command("upgrade", short_help="Upgrade the tables.")
@DATA
def upgrade(data: Path | None) -> None:
    """Upgrade the tables to the revision of this version, as the next `heliopsf serve` would.

    The command also restores missing tables and indexes. Make a copy of the database first.
    """
    with opened_catalogue(data) as catalogue:
        before = catalogue.schema.status()
        catalogue.upgrade()
        catalogue.schema.mend()
        now = catalogue.schema.status()
    if now != before:
        click.echo(f"upgraded from {before.revision or 'no revision'} to {now.revision}")
    click.echo(sentence(now))


def sentence(found: SchemaStatus) -> str:
    """The revision of a database as a sentence."""
    return SENTENCES[found.state].format(revision=found.revision, wanted=found.wanted)


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


COMMANDS = (database,)
