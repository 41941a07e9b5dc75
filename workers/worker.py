"""The worker process: ``celery -A workers.worker`` or ``heliopsf worker``.

Nothing numerical is loaded before the fork: each child loads it for itself, with its share of the threads.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from functools import lru_cache
from typing import TYPE_CHECKING

from celery.signals import worker_process_init

from workers import queue
from workers.settings import Settings

if TYPE_CHECKING:
    from workers.runner import Runner

settings = Settings()
app = queue.make_app(settings)


@app.task(name=queue.RUN_JOB)
def run_job(job_id: str) -> None:
    """Run one job by its id."""
    _runner().run(job_id)


@app.task(name=queue.ASSIST)
def assist(job_id: str) -> None:
    """Share the parts of a job that another worker runs."""
    _runner().assist(job_id)


@worker_process_init.connect
def _prepare_child(**_: object) -> None:
    """Load the kernels when the child starts, so that the first job does not wait for it."""
    _runner()


@lru_cache(maxsize=1)
def _runner() -> Runner:
    # Before numba is imported: the omp layer kills forked children.
    os.environ["NUMBA_THREADING_LAYER"] = "workqueue"
    os.environ["NUMBA_NUM_THREADS"] = str(settings.threads)
    from workers.catalogue import Catalogue
    from workers.runner import Runner
    from workers.store import Store

    return Runner(
        settings,
        Catalogue(settings.catalogue_url),
        Store(settings.data_dir),
        call_for_help=lambda job_id, workers: queue.call_for_help(app, job_id, workers),
    )


def main(parent: int | None = None) -> None:
    """Run a worker in this process until it is told to stop, or until the process ``parent`` is gone."""
    if parent is not None:
        threading.Thread(target=_stop_with, args=(parent,), daemon=True).start()
    pool = ["--pool", "prefork", "--concurrency", str(settings.worker_processes)]
    quiet = ["--without-gossip", "--without-mingle", "--without-heartbeat"]
    app.worker_main(["worker", "--loglevel", "INFO", *pool, *quiet])


def _stop_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(1.0)
    os.kill(os.getpid(), signal.SIGTERM)
