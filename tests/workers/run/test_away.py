"""A worker whose database hangs or only reads, or whose Redis accepts no messages: it waits, and no job is lost."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import psycopg
import pytest
import redis
from sqlalchemy import make_url
from sqlalchemy.exc import InternalError, OperationalError, ProgrammingError

from tests.frozen_proxy import proxy_of
from tests.whole.stack import Missing, Redis, free_port, wait_for
from tests.workers.jobs import Bench, job_row
from tests.workers.run.processes import started_worker, worker_of
from workers import checks
from workers.broker import app as queue
from workers.broker.reconciler import reconcile
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER
from workers.contract.jobs import Phase, Queue, broker_name
from workers.settings import Settings
from workers.tasks.catalogue_workspace import CatalogueWorkspace

QUICK = {"lease_s": 3.0, "heartbeat_s": 0.2, "resubmit_s": 1.0, "worker_threads": 1}
TASK = """
def task(context, _):
    return "result"
"""
# Connections that wait for a short time.
WORKER = f"""
from workers.broker import order
from workers.catalogue import postgres
postgres.PatientConnection.silence_s = postgres.PING_S = 0.5
postgres.SILENCE_S = 1.0
order.WAIT_S = 0.2
{worker_of(TASK)}"""


@pytest.mark.parametrize(
    ("error", "phase"),
    [
        (InternalError("UPDATE", {}, psycopg.errors.ReadOnlySqlTransaction("only reads")), Phase.QUEUED),
        (OperationalError("UPDATE", {}, psycopg.errors.AdminShutdown("shutdown")), Phase.QUEUED),
        (OperationalError("UPDATE", {}, sqlite3.OperationalError("locked")), Phase.QUEUED),
        (ProgrammingError("UPDATE", {}, psycopg.errors.UndefinedTable("no such table")), Phase.ERROR),
    ],
    ids=lambda value: type(getattr(value, "orig", value)).__name__,
)
def test_a_database_that_is_away_is_no_error_of_the_software(
    bench: Bench, error: Exception, phase: Phase
) -> None:
    def task(_: CatalogueWorkspace, __: Mapping[str, Any]) -> str:
        raise error

    row = bench.run(task)
    assert row.phase == phase and (phase == Phase.QUEUED or row.error is not None)


def ends(catalogue: Catalogue, settings: Settings, key: str) -> None:
    """Submit a job, and wait until a worker has completed it."""
    app = queue.make_app(settings)
    job, _ = catalogue.jobs.submit("psf-build", {}, key, DEFAULT_OWNER)

    def ended() -> bool:
        reconcile(catalogue, app, settings)
        return job_row(catalogue, job.id).phase == Phase.COMPLETED

    wait_for(ended, f"job {key} ends", 60.0)


def test_a_worker_goes_on_after_its_connections_fell_silent(
    tmp_path: Path, settings: Settings, postgres_tables: str
) -> None:
    settings.data_dir.mkdir()
    settings = settings.model_copy(update=QUICK | {"database_url": postgres_tables})
    catalogue, url = Catalogue(postgres_tables), make_url(postgres_tables)
    with proxy_of(url.host or "127.0.0.1", url.port or 5432) as proxy:
        here = url.set(host="127.0.0.1", port=proxy.port).render_as_string(hide_password=False)
        with started_worker(WORKER, settings, tmp_path / "log", **QUICK, database_url=here) as process:
            ends(catalogue, settings, "before")
            proxy.freeze()
            ends(catalogue, settings, "after")
            assert process.poll() is None
    catalogue.close()


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Redis]:
    try:
        with Redis(tmp_path) as server:
            yield server
    except Missing as missing:
        pytest.skip(str(missing))


def test_a_worker_waits_while_redis_accepts_no_messages(
    tmp_path: Path, catalogue: Catalogue, settings: Settings, server: Redis
) -> None:
    settings.data_dir.mkdir()
    url = catalogue._database.engine.url.render_as_string()
    settings = settings.model_copy(update=QUICK | {"database_url": url, "broker_url": server.url})
    log, client, name = tmp_path / "log", redis.Redis.from_url(server.url), broker_name(Queue.INTERACTIVE)
    refusals: dict[str, tuple[Callable[[], Any], Callable[[], Any]]] = {
        "its memory is full": (
            lambda: client.config_set("maxmemory", "1"),
            lambda: client.config_set("maxmemory", "0"),
        ),
        "it is a read-only replica": (
            lambda: client.replicaof("127.0.0.1", free_port()),
            lambda: client.replicaof("NO", "ONE"),
        ),
        "the name of a queue belongs to a key of another type": (
            lambda: client.set(name, "no list"),
            lambda: client.delete(name),
        ),
    }
    with started_worker(WORKER, settings, log, **QUICK, database_url=url) as process:
        ends(catalogue, settings, "before")
        checks.broker(settings)
        for count, (reason, (refuse, accept)) in enumerate(refusals.items()):
            refuse()
            with pytest.raises(checks.Unusable) as told:
                checks.broker(settings)
            assert str(told.value) == f"the broker refuses messages ({reason})"
            assert not queue.submit(queue.make_app(settings), 32 * "0")
            if reason != "its memory is full":  # a full Redis hands out messages
                wait_for(lambda n=count: log.read_text().count("waiting for the broker") == n, "it waits")
            accept()
            checks.broker(settings)
            ends(catalogue, settings, reason)
            assert process.poll() is None
    client.close()
