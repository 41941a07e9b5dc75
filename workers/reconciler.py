"""Keeps the broker in step with the job table: what it lost, and what a dead worker held, goes in again."""

from __future__ import annotations

import logging
import threading

from celery import Celery
from sqlalchemy.exc import SQLAlchemyError

from workers import queue
from workers.catalogue import Catalogue
from workers.settings import Settings

log = logging.getLogger(__name__)


def reconcile(catalogue: Catalogue, app: Celery, settings: Settings) -> int:
    """One pass; returns how many jobs were submitted. Any number of processes may do this at once."""
    for job_id in catalogue.give_up_silent(settings.lease_s, settings.max_attempts):
        log.warning("job %s: its worker fell silent; queued again", job_id)
    for job_id in catalogue.end_by_terms():
        log.info("job %s: its time had come; destroyed", job_id)
    submitted = 0
    for job_id in catalogue.unsubmitted(settings.resubmit_s):
        if not queue.submit(app, job_id):
            break
        catalogue.mark_submitted(job_id)
        submitted += 1
    return submitted


class Reconciler:
    """A thread that reconciles every ``settings.reconcile_s`` seconds, and at once when it is woken."""

    def __init__(self, catalogue: Catalogue, app: Celery, settings: Settings) -> None:
        self._catalogue, self._app, self._settings = catalogue, app, settings
        self._wake = threading.Event()
        self._stopping = False
        self._thread = threading.Thread(target=self._loop, name="reconciler", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread and wait for it."""
        self._stopping = True
        self._wake.set()
        self._thread.join()

    def wake(self) -> None:
        """There is something to submit now."""
        self._wake.set()

    @property
    def alive(self) -> bool:
        """True while the thread runs."""
        return self._thread.is_alive()

    def _loop(self) -> None:
        while not self._stopping:
            self._wake.clear()
            try:
                reconcile(self._catalogue, self._app, self._settings)
            except SQLAlchemyError as error:
                # The database may be restarting; the next pass finds out.
                log.warning("reconciler: database away: %s", error)
            self._wake.wait(self._settings.reconcile_s)
