"""Is each thing there that the service stands on? Each check raises ``Unusable`` with a short plain sentence.

The sentences name no address and no credentials, so that they may be shown to anybody.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryFile

from sqlalchemy.exc import SQLAlchemyError

from workers.catalogue.catalogue import Catalogue
from workers.files.store import Store
from workers.settings import Settings


class Unusable(Exception):
    """Something that the service needs is not there."""


def database(catalogue: Catalogue) -> None:
    """The database answers."""
    try:
        catalogue.ping()
    except SQLAlchemyError as error:
        raise Unusable(f"the database does not answer ({_kind(error)})") from error


def storage(folder: Path) -> None:
    """The folder of files can be written to."""
    try:
        with TemporaryFile(dir=folder) as probe:
            probe.write(b"heliopsf")
            probe.flush()
    except OSError as error:
        raise Unusable(f"the data folder cannot be written to ({error.strerror or _kind(error)})") from error


def object_store(store: Store) -> None:
    """Files can be kept elsewhere, where that is where they are kept."""
    try:
        store.check()
    except OSError as error:
        raise Unusable(f"the object store cannot be written to ({_kind(error)})") from error


def free_bytes(folder: Path) -> int:
    """Room that is left where the files are."""
    return shutil.disk_usage(folder).free


def broker(settings: Settings) -> None:
    """The broker answers."""
    if "://" not in settings.broker_url:  # Celery would take it for a broker in its own memory
        raise Unusable("the broker's URL cannot be used (expected scheme://...)")
    from workers.broker import app as queue  # Celery takes half a second to import

    try:
        queue.check(settings)
    except queue.AWAY as error:
        raise Unusable(f"the broker does not answer ({_kind(error)})") from error
    except (
        ValueError,
        KeyError,
        ImportError,
        AttributeError,
    ) as error:  # what is no URL, or of no transport we have
        raise Unusable(f"the broker's URL cannot be used ({_kind(error)})") from error


def embedded_worker(catalogue: Catalogue, settings: Settings) -> None:
    """A worker said that it is there."""
    try:
        workers = catalogue.census.workers(settings.lease_s)
    except SQLAlchemyError as error:
        raise Unusable(f"the database does not say ({_kind(error)})") from error
    if not workers:
        raise Unusable(f"no worker has been heard of for {settings.lease_s:g} s")


def needed(settings: Settings, catalogue: Catalogue, store: Store) -> dict[str, Callable[[], None]]:
    """What must be there before requests are taken, by name."""
    checks: dict[str, Callable[[], None]] = {
        "database": lambda: database(catalogue),
        "storage": lambda: storage(settings.data_dir),
    }
    if settings.store_url is not None:
        checks["object store"] = lambda: object_store(store)
    if settings.embedded:
        checks["worker"] = lambda: embedded_worker(catalogue, settings)
    else:
        checks["broker"] = lambda: broker(settings)
    return checks


_REASONS = {
    r"refused": "the connection is refused",
    r"resolve|name or service|getaddrinfo": "the host's name is unknown",
    r"authentication failed|no password supplied|no pg_hba": "the user or the password is not accepted",
    r'database ".*" does not exist': "there is no database of that name",
    r"timeout|timed out": "no answer within seconds",
    r"unable to open|readonly": "the file cannot be opened or written to",
    r"not a database|malformed": "the file is no SQLite database",
    r"locked": "the file is locked by another process",
}


def database_said(error: SQLAlchemyError) -> str:
    """What a database's error comes to. Its own words may repeat the URL, so they are not passed on."""
    words = str(getattr(error, "orig", None) or error).lower()
    known = [reason for pattern, reason in _REASONS.items() if re.search(pattern, words)]
    return (
        known[0] if known else f"it does not answer ({type(getattr(error, 'orig', None) or error).__name__})"
    )


def _kind(error: BaseException) -> str:
    """The error's name; that of its cause where it has one, which says more."""
    return type(getattr(error, "orig", None) or error.__cause__ or error).__name__
