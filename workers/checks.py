"""Checks the database, storage and broker on which the service depends. Each check raises ``Unusable`` with a short
sentence.

The sentences contain no address and no credentials, so they can be shown to anybody.
"""

from __future__ import annotations

import re
import shutil
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from threading import Lock, Thread
from weakref import WeakKeyDictionary

from sqlalchemy.exc import SQLAlchemyError

from workers.catalogue.catalogue import Catalogue
from workers.catalogue.database import READ_ONLY, sqlstate_of
from workers.files.store import Store
from workers.settings import Settings

OK = "ok"


class Unusable(Exception):
    """Something that the service needs does not work."""


CHECK_S = 5.0  # time after which something that has not answered counts as away
PAGES_S = CHECK_S / 2  # longest time that a check waits for the pages of a database
_pages: WeakKeyDictionary[Catalogue, _Pages] = WeakKeyDictionary()
PAGES_SHARE = 0.01  # largest share of the time that is spent on checking the pages
# While workers do nothing, a waiting job is sent to them every ``resubmit_s``. They count as deaf after this number of
# times.
RESUBMISSIONS = 4


def database(catalogue: Catalogue) -> None:
    """Check that the database answers, that it accepts changes, and that its file is not damaged.

    The last check reads the whole file of an SQLite database. The longer this takes, the less often it is done. While a
    large file is being read, it counts as good.
    """
    answers(catalogue)
    with _asking():
        catalogue.check_writable()
    _pages.setdefault(catalogue, _Pages()).check(catalogue)


def answers(catalogue: Catalogue) -> None:
    """Check that the database answers."""
    with _asking():
        catalogue.clock()


class _Pages:
    """The checks of the pages of a database, in a thread, because a large file takes longer than a check may."""

    def __init__(self) -> None:
        self._fault: Unusable | None = None
        self._good_until = 0.0
        self._reader: Thread | None = None

    def check(self, catalogue: Catalogue) -> None:
        """Raise the fault that was found. Read the pages again if it is time, and wait a moment for the result."""
        reader = self._reader
        if (reader is None or not reader.is_alive()) and time.monotonic() >= self._good_until:
            reader = self._reader = Thread(target=self._read, args=(catalogue,), name="pages", daemon=True)
            reader.start()
        if reader is not None:
            reader.join(PAGES_S)
        if self._fault is not None:
            raise self._fault

    def _read(self, catalogue: Catalogue) -> None:
        started = time.monotonic()
        try:
            catalogue.check_pages()
        except SQLAlchemyError as error:
            self._fault = _damage(error)
            return
        ended = time.monotonic()
        self._fault, self._good_until = None, ended + (ended - started) / PAGES_SHARE


@contextmanager
def _asking() -> Iterator[None]:
    """Turn the errors of the database into ``Unusable``."""
    try:
        yield
    except SQLAlchemyError as error:
        if damaged(error):
            raise _damage(error) from error
        state = "accepts no changes" if sqlstate_of(error) == READ_ONLY else "does not answer"
        raise Unusable(f"the database {state} ({_kind(error)})") from error


def _damage(error: SQLAlchemyError) -> Unusable:
    return Unusable(f"the database is damaged ({_kind(error)}); restore a copy of it")


def storage(folder: Path, min_free_mib: int) -> None:
    """Check that the data folder is writable and that its disk has this much free space, MiB."""
    try:
        with TemporaryFile(dir=folder) as probe:
            probe.write(b"heliopsf")
            probe.flush()
    except OSError as error:
        raise Unusable(f"the data folder cannot be written to ({error.strerror or _kind(error)})") from error
    free_mib = free_bytes(folder) / 2**20
    if free_mib < min_free_mib:
        raise Unusable(
            f"the disk of the data folder has {free_mib:.0f} MiB of free space, expected {min_free_mib} MiB or more"
        )


def object_store(store: Store) -> None:
    """Check that the object store is writable."""
    try:
        store.check()
    except OSError as error:
        raise Unusable(f"the object store cannot be written to ({_kind(error)})") from error


def free_bytes(folder: Path) -> int:
    """Free space of the data folder, bytes."""
    return shutil.disk_usage(folder).free


def broker(settings: Settings) -> None:
    """Check that the broker answers and accepts messages."""
    if "://" not in settings.broker_url:  # for such a URL Celery would use a broker in its own memory
        raise Unusable("the broker's URL cannot be used (expected scheme://...)")
    from workers.broker import app as queue  # Celery takes half a second to import

    try:
        queue.check(settings.broker_url)
    except queue.REFUSED as error:
        raise Unusable(f"the broker refuses messages ({_refusal(error)})") from error
    except queue.AWAY as error:
        raise Unusable(f"the broker does not answer ({_kind(error)})") from error
    # The text is not a URL, or the library for its scheme is not installed.
    except (ValueError, KeyError, ImportError, AttributeError) as error:
        raise Unusable(f"the broker's URL cannot be used ({_kind(error)})") from error


def embedded_worker(catalogue: Catalogue, settings: Settings) -> None:
    """Check that a worker has announced itself."""
    with _asking():
        workers = catalogue.census.workers(settings.lease_s)
    if not workers:
        raise Unusable(f"no worker has announced itself for {settings.lease_s:g} s")


def jobs(catalogue: Catalogue, settings: Settings) -> None:
    """Check that no job waits for workers that do nothing.

    Workers that run jobs are busy, and workers that have just started may take a job soon: neither is a fault.
    """
    idle_s = RESUBMISSIONS * settings.resubmit_s
    with _asking():
        left = catalogue.census.count_untaken(idle_s) if catalogue.jobs.nobody_works(idle_s) else 0
        workers = catalogue.census.workers(settings.lease_s) if left else ()
    if any(worker.started_at < time.time() - idle_s for worker in workers):
        raise Unusable(f"jobs wait ({left}), but the workers have taken none for {idle_s:g} s")


class Watch:
    """Runs checks in threads of their own, so that something that hangs holds one thread, and no request.

    A check that still runs is not started again: who asks meanwhile gets its result.
    """

    def __init__(self) -> None:
        self._running: dict[str, Future[str]] = {}
        self._lock = Lock()

    def ask(self, name: str, check: Callable[[], None]) -> Future[str]:
        """The result of a check, which may come later or never: "ok", or what is wrong."""
        with self._lock:
            answer = self._running.get(name)
            if answer is None or answer.done():
                answer = self._running[name] = Future()
                Thread(target=_answer, args=(answer, check), name=f"check of {name}", daemon=True).start()
            return answer


def _answer(answer: Future[str], check: Callable[[], None]) -> None:
    answer.set_running_or_notify_cancel()  # nobody can cancel it from now on
    try:
        check()
    except Unusable as fault:
        answer.set_result(str(fault))
    except BaseException as error:
        answer.set_exception(error)
        raise
    else:
        answer.set_result(OK)


def needed(settings: Settings, catalogue: Catalogue, store: Store) -> dict[str, Callable[[], None]]:
    """The checks that must pass before requests are accepted, by name."""
    checks: dict[str, Callable[[], None]] = {
        "database": lambda: database(catalogue),
        "storage": lambda: storage(settings.data_dir, settings.min_free_mib),
        "jobs": lambda: jobs(catalogue, settings),
    }
    if settings.store_url is not None:
        checks["object store"] = lambda: object_store(store)
    if settings.embedded:
        checks["worker"] = lambda: embedded_worker(catalogue, settings)
    else:
        checks["broker"] = lambda: broker(settings)
    return checks


_DAMAGED = r"not a database|malformed"
_REASONS = {
    r"refused": "the connection is refused",
    r"resolve|name or service|getaddrinfo": "the host name is unknown",
    r"authentication failed|no password supplied|no pg_hba": "the user or the password is not accepted",
    r'database ".*" does not exist': "there is no database with this name",
    r"timeout|timed out": "no answer within the time limit",
    r"read-only transaction": "it accepts no changes: expected the primary server; this one only reads",
    r"unable to open|readonly": "the file cannot be opened or written to",
    _DAMAGED: "the file is damaged, or is not an SQLite database",
    r"locked": "the file is locked by another process",
}


def damaged(error: SQLAlchemyError) -> bool:
    """Whether this error says that the file of an SQLite database is damaged."""
    return re.search(_DAMAGED, str(getattr(error, "orig", None) or error).lower()) is not None


def database_said(error: SQLAlchemyError) -> str:
    """A summary of a database error. The original text may contain the URL, so it is not shown."""
    original = getattr(error, "orig", None) or error
    known = (reason for pattern, reason in _REASONS.items() if re.search(pattern, str(original).lower()))
    return next(known, f"it does not answer ({type(original).__name__})")


def _refusal(error: Exception) -> str:
    """Why Redis refuses messages. Its own text may name a user, so it is not shown."""
    if str(error).startswith("WRONGTYPE"):
        return "the name of a queue belongs to a key of another type"
    known = {
        "OutOfMemoryError": "its memory is full",
        "ReadOnlyError": "it is a read-only replica",
        "NoPermissionError": "this user may not write",
    }
    return known.get(_kind(error), _kind(error))


def _kind(error: BaseException) -> str:
    """The name of the error's class; if the error has a cause, the name of the cause's class, which is more
    specific.
    """
    return type(getattr(error, "orig", None) or error.__cause__ or error).__name__
