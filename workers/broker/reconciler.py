"""Keeps the broker and the store consistent with the tables.

Lost messages and jobs of lost workers are submitted again. Removed files are deleted for good.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from celery import Celery
from sqlalchemy.exc import SQLAlchemyError

from workers.broker import app as queue
from workers.bulk.runs import keep_turns
from workers.catalogue.catalogue import Catalogue
from workers.files.garbage import retain, settle_old
from workers.files.store import Store
from workers.settings import Settings

log = logging.getLogger(__name__)
# This number is small: an urgent job may arrive while jobs are submitted, and must not wait for many other
# jobs.
AT_ONCE = 50
ALIVE_S = 30.0
SETTLE_EVERY_S = 60.0
RETAIN_EVERY_S = 3600.0


def reconcile(catalogue: Catalogue, app: Celery, settings: Settings) -> int:
    """Correct the job table and submit queued jobs to the broker.

    In this order: queue the jobs of lost workers again; enforce the time limits and destruction times of UWS jobs;
    queue the turns that bulk runs need, and delete ended turns; submit queued jobs.
    Returns the number of submitted jobs, at most ``AT_ONCE``. Several processes may do this at the same time.
    """
    for job_id in catalogue.jobs.give_up_silent(settings.lease_s, settings.max_attempts):
        log.warning("job %s: no heartbeat from its worker; queued again", job_id)
    for job_id in catalogue.uws.end_by_terms():
        log.info("job %s: destroyed at the time its client set", job_id)
    keep_turns(catalogue, settings)
    submitted: list[str] = []
    idle = catalogue.jobs.nobody_works(settings.resubmit_s) and bool(
        catalogue.census.workers(settings.lease_s)
    )
    for job_id, name in catalogue.jobs.unsubmitted(settings.resubmit_s, limit=AT_ONCE, idle=idle):
        if not queue.submit(app, job_id, name):
            break
        submitted.append(job_id)
    if submitted:
        catalogue.jobs.mark_submitted(*submitted)
    return len(submitted)


class Reconciler:
    """A thread that reconciles every ``settings.reconcile_s`` seconds, and immediately after ``wake``.

    A second thread cares for the files of ``store``, which may take long. Once a minute it deletes files that were
    removed, and temporary files of ended processes. Once an hour it deletes what is older than the operator keeps it.
    """

    def __init__(self, catalogue: Catalogue, store: Store, app: Celery, settings: Settings) -> None:
        self._catalogue, self._store, self._app, self._settings = catalogue, store, app, settings
        self._ended_at = time.monotonic()
        self._wake, self._stopping = threading.Event(), threading.Event()
        self._threads = (
            threading.Thread(target=self._reconcile, name="reconciler", daemon=True),
            threading.Thread(target=self._keep_house, name="housekeeping", daemon=True),
        )

    def start(self) -> None:
        """Start the threads."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Stop the threads, and wait for them for ``settings.stop_s`` seconds each."""
        self._stopping.set()
        self._wake.set()
        for thread in self._threads:
            thread.join(self._settings.stop_s)

    def wake(self) -> None:
        """Reconcile now, without waiting for the interval to end, because there is a job to submit."""
        self._wake.set()

    @property
    def alive(self) -> bool:
        """True if a round of the reconciler succeeded in the last ``ALIVE_S`` seconds (longer, if rounds are rarer)."""
        return time.monotonic() - self._ended_at < max(ALIVE_S, 3 * self._settings.reconcile_s)

    def _reconcile(self) -> None:
        while not self._stopping.is_set():
            self._wake.clear()
            submitted = 0
            with _trying_again("reconciler"):
                submitted = reconcile(self._catalogue, self._app, self._settings)
                self._ended_at = time.monotonic()
            if submitted < AT_ONCE:
                self._wake.wait(self._settings.reconcile_s)

    def _keep_house(self) -> None:
        retained_at = -RETAIN_EVERY_S
        while True:
            if time.monotonic() - retained_at > RETAIN_EVERY_S:
                retained_at = time.monotonic()
                with _trying_again("retention"):
                    retain(self._catalogue, self._store, self._settings)
            if self._stopping.wait(SETTLE_EVERY_S):
                return
            with _trying_again("housekeeping"):
                self._store.sweep()
                settle_old(self._catalogue, self._store)


@contextmanager
def _trying_again(what: str) -> Iterator[None]:
    """Log that the database or the store cannot be used now. The thread goes on, and does its work later."""
    try:
        yield
    except SQLAlchemyError as error:
        log.warning("%s: the database does not answer: %s", what, error)
    except OSError as error:
        log.warning("%s: the store does not answer: %s", what, error)
