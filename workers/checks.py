"""Is each thing there that the service stands on? Each check raises ``Unusable`` with a short plain sentence.

The sentences name no address and no credentials, so that they may be shown to anybody.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryFile

from sqlalchemy.exc import SQLAlchemyError

from workers import queue
from workers.catalogue import Catalogue
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


def free_bytes(folder: Path) -> int:
    """Room that is left where the files are."""
    return shutil.disk_usage(folder).free


def broker(settings: Settings) -> None:
    """The broker answers."""
    if "://" not in settings.broker_url:  # Celery would take it for a broker in its own memory
        raise Unusable("the broker's URL cannot be used (expected scheme://...)")
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
        workers = catalogue.workers(settings.lease_s)
    except SQLAlchemyError as error:
        raise Unusable(f"the database does not say ({_kind(error)})") from error
    if not workers:
        raise Unusable(f"no worker has been heard of for {settings.lease_s:g} s")


def needed(settings: Settings, catalogue: Catalogue) -> dict[str, Callable[[], None]]:
    """What must be there before requests are taken, by name."""
    checks: dict[str, Callable[[], None]] = {
        "database": lambda: database(catalogue),
        "storage": lambda: storage(settings.data_dir),
    }
    if settings.embedded:
        checks["worker"] = lambda: embedded_worker(catalogue, settings)
    else:
        checks["broker"] = lambda: broker(settings)
    return checks


def _kind(error: BaseException) -> str:
    """The error's name; that of its cause where it has one, which says more."""
    return type(getattr(error, "orig", None) or error.__cause__ or error).__name__
