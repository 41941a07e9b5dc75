"""The worker process: ``celery -A workers.run.worker`` or ``heliopsf worker``.

The parent loads no numerical libraries. Each child loads them after the fork, with its share of the threads.

On SIGTERM, or one Control-C, the worker takes no more jobs. The running job may continue for ``stop_s`` seconds; then
it is handed back and queued as if it had not started. After ``gone_s`` seconds the worker exits even if this has not
succeeded.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING

from celery import Task
from celery.signals import setup_logging, worker_init, worker_process_init, worker_shutting_down
from celery.worker import state
from sqlalchemy.exc import SQLAlchemyError

from workers import checks, logs, traces
from workers.broker import app as queue
from workers.broker.order import TakeWhatCanStart
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.database import is_away
from workers.catalogue.schema import SchemaError
from workers.contract.jobs import broker_name, queue_of_broker
from workers.files.store import open_store
from workers.run.child import Child, Idle, Stopping, worker_name
from workers.settings import Settings, software_version

if TYPE_CHECKING:
    from workers.run.runner import Runner

log = logging.getLogger(__name__)
settings = Settings()
app = queue.make_app(settings)
app.select_queues([broker_name(name) for name in settings.queues])
app.steps["consumer"].add(TakeWhatCanStart)
LOOK_EVERY_S = 0.5
WAIT_S = 2.0  # time after which a database that does not answer is tried again
MOST_LOOK_S = 5.0  # longest time between two looks into the table of jobs
# Both are made before the fork, so that the children share them with their parent.
stopping, idle = Stopping(), Idle()
until_idle_s: float | None = (
    None  # the worker ends when it has had nothing to do for this time, s; None: it does not end
)


@app.task(name=queue.RUN_JOB, bind=True)
def run_job(task: Task, job_id: str) -> None:
    """Run one job of the queue from which the message came.

    The message names a job of this queue, but another job may run.
    """
    with _waiting_for_the_database(job_id):
        _runner().run_next(job_id, queue_of_broker(task.request.delivery_info["routing_key"]))


@app.task(name=queue.ASSIST)
def assist(job_id: str) -> None:
    """Share the work of a job that another worker runs."""
    with _waiting_for_the_database(job_id):
        _runner().assist(job_id)


@contextmanager
def _waiting_for_the_database(job_id: str) -> Iterator[None]:
    """If the database cannot be used now, end the work with a line in the log.

    The row of the job says what to do: it is submitted again, at once or when its lease has expired.
    """
    try:
        yield
    except SQLAlchemyError as error:
        if not is_away(error):
            raise
        log.warning("message of job %s: the database cannot be used: %s", job_id, str(error).split("\n")[0])


@setup_logging.connect
def _logs(**_: object) -> None:
    """Do nothing. Celery does not configure the logs if a function is connected to this signal."""
    logs.configure(settings)


@worker_init.connect
def _watch(**_: object) -> None:
    try:
        check_tables()
    # Celery would log an Exception and continue; SystemExit ends the worker.
    except SchemaError as error:
        raise SystemExit(f"Error: {error}") from error
    except SQLAlchemyError as error:
        raise SystemExit(f"Error: expected a working database; got: {checks.database_said(error)}") from error
    threading.Thread(target=_end_at_the_latest, name="end at the latest", daemon=True).start()


@worker_shutting_down.connect
def _stop(**_: object) -> None:
    stopping.ask(settings.stop_s)


def check_tables() -> None:
    """Wait until the database answers, and check the revision of its tables.

    Raises ``workers.catalogue.schema.SchemaError`` if this version of the software needs another revision.
    """
    catalogue = Catalogue(
        settings.catalogue_url
    )  # closed below, because no connection may be open when the process forks
    try:
        while True:
            try:
                catalogue.schema.check()
                return
            except SQLAlchemyError as error:
                if not is_away(error):
                    raise
                log.warning("waiting for the database: %s", checks.database_said(error))
                time.sleep(WAIT_S)
    finally:
        catalogue.close()


def _end_at_the_latest() -> None:
    while not stopping.asked:
        time.sleep(LOOK_EVERY_S)
    time.sleep(settings.gone_s)
    log.warning("still running %g s after the signal to stop: exiting now", settings.gone_s)
    # When the parent exits, the kernel ends the children, on systems where Celery can request this.
    os._exit(0)


@worker_process_init.connect
def _prepare_child(**_: object) -> None:
    """Load all tasks when the child starts, so that the first job does not wait for their libraries."""
    traces.configure(settings, "worker")  # after the fork, because the sender has a thread
    _runner()
    threading.Thread(target=_be_present, name="presence", daemon=True).start()
    if until_idle_s is not None:
        looks = threading.Thread(target=_look_for_jobs, args=(until_idle_s,), name="jobs to do", daemon=True)
        looks.start()


def _look_for_jobs(within_s: float) -> None:
    """Tell the parent whether there is a job to do. A database that does not answer may have one."""
    while not stopping.asked:
        try:
            work = _catalogue().jobs.any_to_do(settings.queues, settings.lease_s, worker_name())
            idle.tell(work=work)
        except (SQLAlchemyError, MemoryError) as error:
            log.warning("could not look for jobs: %s", str(error).split("\n")[0])
            idle.tell(work=True)
        time.sleep(min(MOST_LOOK_S, within_s / 4))


def _end_when_idle(after_s: float) -> None:
    """End this worker in the same way as SIGTERM, when it has had nothing to do for ``after_s`` seconds.

    Messages do not count, because a long queue leaves many for jobs that have ended. Only the help for another worker's
    job is not in the table of jobs.
    """
    while not stopping.asked:
        if any(request.name == queue.ASSIST for request in state.active_requests):
            idle.tell(work=True)
        elif idle.seconds >= after_s:
            log.info("nothing to do for %g s: this worker ends", after_s)
            os.kill(os.getpid(), signal.SIGTERM)
            return
        time.sleep(min(LOOK_EVERY_S, after_s / 4))


def _be_present() -> None:
    """Announce this child in the list of workers at regular intervals; remove it when the worker stops."""
    started_at = time.time()
    while True:
        leaving = stopping.asked
        try:
            if leaving:
                _catalogue().census.take_leave(worker_name())
            else:
                _catalogue().census.announce(worker_name(), started_at, software_version())
        except (
            SQLAlchemyError,
            MemoryError,
        ) as error:  # MemoryError: the job of this process has reached its limit
            log.warning("could not announce this worker: %s", str(error).split("\n")[0])
        if leaving:
            return
        again = time.monotonic() + settings.presence_s
        while time.monotonic() < again and not stopping.asked:
            time.sleep(LOOK_EVERY_S)


@lru_cache(maxsize=1)
def _runner() -> Runner:
    # Set this before numba is imported, because numba's OpenMP layer ends forked child processes.
    os.environ["NUMBA_THREADING_LAYER"] = "workqueue"
    os.environ["NUMBA_NUM_THREADS"] = str(settings.threads)
    from workers.run.runner import Runner, load_tasks

    load_tasks()
    return Runner(
        settings,
        _catalogue(),
        open_store(settings),
        call_for_help=lambda job_id, workers: queue.call_for_help(app, job_id, workers),
        stopping=stopping,
        submit=lambda job_id, queue_name: queue.submit(app, job_id, queue_name),
        child=Child(settings.threads),
    )


@lru_cache(maxsize=1)
def _catalogue() -> Catalogue:
    return Catalogue(settings.catalogue_url)


def main(parent: int | None = None, idle_s: float | None = None) -> None:
    """Run a worker in this process until it is told to stop, until the process ``parent`` ends, or until the worker has
    had nothing to do for ``idle_s`` seconds.

    Raises SystemExit with status 1 if the worker ends for another reason; with a message if the database is not at the
    revision of this version.
    """
    logs.configure(settings)  # before Celery logs anything
    log.info("the worker starts; data in %s", settings.data_dir.resolve())
    if parent is not None:
        threading.Thread(target=_stop_with, args=(parent,), daemon=True).start()
    if idle_s is not None:
        global until_idle_s
        until_idle_s = idle_s
        threading.Thread(target=_end_when_idle, args=(idle_s,), daemon=True).start()
    pool = ["--pool", "prefork", "--concurrency", str(settings.worker_processes)]
    quiet = ["--without-gossip", "--without-mingle", "--without-heartbeat"]
    app.worker_main(["--quiet", "worker", "--loglevel", "INFO", *pool, *quiet])
    # Celery returns without a status, also after an error, which it has logged.
    if not stopping.asked:
        raise SystemExit(1)


def _stop_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os.kill(os.getpid(), signal.SIGTERM)
