"""``heliopsf database``: the revision of the catalogue's tables, and the way to this version's."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import click
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from service.cli.options import OUTPUT_FOLDER, read_settings
from workers import checks
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.schema import SchemaError, SchemaStatus

SENTENCES = {
    "empty": "the database is empty; its tables are made at revision {wanted}",
    "unversioned": "the database says no revision: its tables are from before there were any; wanted {wanted}",
    "older": "the database is at revision {revision}; this version works with {wanted}",
    "current": "the database is at revision {revision}, which this version works with",
    "newer": "the database is at revision {revision}, made by a later version; this one knows up to {wanted}",
}

DATA = click.option("--data", type=OUTPUT_FOLDER, help="Folder for everything kept")


@click.group()
def database() -> None:
    """The revision of the database's tables."""


@database.command("status")
@DATA
def status(data: Path | None) -> None:
    """Say which revision the database is at, and which this version works with. Status 1: they differ."""
    with opened_catalogue(data) as catalogue:
        found = catalogue.schema.status()
    click.echo(sentence(found))
    if found.state != "current":
        raise click.exceptions.Exit(1)


@database.command("upgrade")
@DATA
def upgrade(data: Path | None) -> None:
    """Bring the database to this version's tables, as the next `heliopsf serve` would.

    Tables and indexes that somebody removed are made again. Keep a copy of the database before.
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
    """Which revision a database is at, in words."""
    return SENTENCES[found.state].format(revision=found.revision, wanted=found.wanted)


@contextmanager
def opened_catalogue(data: Path | None) -> Iterator[Catalogue]:
    """The catalogue of a data folder, as it is; what is wrong with its database as one line (``ClickException``)."""
    settings = read_settings(data)
    if settings.database_url is None:
        settings.data_dir.mkdir(parents=True, exist_ok=True)
    try:
        catalogue = Catalogue(settings.catalogue_url)
    except (ArgumentError, ImportError, ValueError) as error:
        raise click.ClickException(
            f"HELIOPSF_DATABASE_URL cannot be used ({type(error).__name__}): expected postgresql://... or none"
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
