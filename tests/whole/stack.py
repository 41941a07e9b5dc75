"""Real processes for tests: a service, workers, a Redis and a PostgreSQL database of the test's own."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
from sqlalchemy import create_engine, make_url, select, text
from sqlalchemy.exc import OperationalError

from service.client.http import Client
from workers.catalogue.access import Scope
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import BulkItemRow
from workers.settings import Settings

POSTGRES = os.environ.get("HELIOPSF_TEST_POSTGRES", "postgresql+psycopg://postgres@127.0.0.1:5432/postgres")
# A lost worker is noticed soon, so that tests need not wait as long as an operator would.
QUICK = {
    "HELIOPSF_RESUBMIT_S": "3",
    "HELIOPSF_LEASE_S": "3",
    "HELIOPSF_HEARTBEAT_S": "0.5",
    "HELIOPSF_RECONCILE_S": "0.5",
    # Tests run side by side: more threads would only burn more of the cores until a job at work is killed or cancelled.
    "HELIOPSF_WORKER_THREADS": "1",
}


class Missing(Exception):
    """A server that this machine does not have."""


class Stack:
    """A running service; ``workers`` are those that the test started itself (none when embedded).

    working: the working folder of the server, from which it must import nothing; None: that of the tests.
    """

    def __init__(self, data: Path, environment: dict[str, str], working: Path | None = None) -> None:
        self.data, self.working = data, working
        self.environment = os.environ | QUICK | {"HELIOPSF_DATA_DIR": str(data)} | environment
        self.server: subprocess.Popen[str] | None = None
        self.workers: list[subprocess.Popen[str]] = []
        self.redis: Redis | None = None
        self.client = Client()

    def start_server(self, port: int = 0) -> None:
        """Start the service at a port; 0: any free one. What it says is in ``server.out``, and its errors in
        ``server.log``."""
        folder = self.data.parent
        self.server = subprocess.Popen(
            [
                sys.executable,
                *(["-P"] if self.working else []),
                "-m",
                "service.cli",
                "serve",
                "--port",
                str(port),
            ],
            env=self.environment,
            cwd=self.working,
            umask=0o022,  # as usual
            stdout=(folder / "server.out").open("w"),
            stderr=(folder / "server.log").open("a"),
            text=True,
            start_new_session=True,
        )
        created = psutil.Process(self.server.pid).create_time()
        (folder / "server.pid").write_text(f"{self.server.pid} {created}")
        wait_for(lambda: self.said().count("\n") == 2 or self._ended(), "the service listens")
        assert not self._ended(), (folder / "server.log").read_text()
        self.attach()

    def attach(self) -> None:
        """Ask the service of this folder, which another process may have started."""
        self.client = Client(self.said().split(" serves ")[1].split()[0])
        self.client.wait_until_up()

    def said(self) -> str:
        """What the service has written for its operator since its start."""
        return (self.data.parent / "server.out").read_text()

    def key(self, owner: str, *scopes: Scope) -> str:
        """A new key of an owner; with all scopes but the administrator's where none is named."""
        catalogue = self.catalogue()
        try:
            return catalogue.keys.make(owner, set(scopes) or set(Scope) - {Scope.ADMIN})
        finally:
            catalogue.close()

    def catalogue(self) -> Catalogue:
        """The catalogue of the service; whoever asks for it closes it."""
        return Catalogue(self.catalogue_url)

    @property
    def catalogue_url(self) -> str:
        """The URL of the database of the service."""
        url = self.environment.get("HELIOPSF_DATABASE_URL")
        return Settings(data_dir=self.data, database_url=url).catalogue_url

    def start_worker(self) -> subprocess.Popen[str]:
        """Start a worker of the test's own."""
        worker = subprocess.Popen(
            [sys.executable, "-m", "service.cli", "worker"],
            env=self.environment,
            stdout=(self.data.parent / "workers.log").open("a"),
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        self.workers.append(worker)
        return worker

    def worker_processes(self) -> list[psutil.Process]:
        """Every worker process there is, parents and children: the embedded one's or the test's own."""
        roots = [psutil.Process(worker.pid) for worker in self.workers if worker.poll() is None]
        if self.server is not None and not self.workers:
            roots = [p for p in psutil.Process(self.server.pid).children() if "worker" in p.cmdline()]
        return [p for root in roots for p in (root, *root.children(recursive=True))]

    def kill_workers(self) -> None:
        """SIGKILL to every worker process at once, as when the power goes."""
        processes = self.worker_processes()
        assert processes
        for process in processes:
            process.kill()
        psutil.wait_procs(processes, timeout=10)

    def kill_everything(self) -> None:
        """SIGKILL to workers and server at once."""
        assert self.server is not None
        processes = {*self._all_processes(), *self.worker_processes()}
        for process in processes:
            process.kill()
        psutil.wait_procs(processes, timeout=10)
        self.server.wait()
        self.workers.clear()

    def stop(self) -> None:
        """Stop everything by its process id; nothing may be left running."""
        started = self._all_processes()
        own = [*self.workers, *([self.server] if self.server else [])]
        for process in (one for one in own if one.poll() is None):
            process.send_signal(signal.SIGTERM)
        for process in own:
            try:
                process.wait(40)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                raise
        _, left = psutil.wait_procs(started, timeout=5)
        for process in left:
            process.kill()
        assert not left, f"still running after the stop: {left}"

    def _ended(self) -> bool:
        return self.server is None or self.server.poll() is not None

    def _all_processes(self) -> list[psutil.Process]:
        running = [p for p in [*self.workers, self.server] if p is not None and p.poll() is None]
        roots = [psutil.Process(p.pid) for p in running]
        return [p for root in roots for p in (root, *root.children(recursive=True))]


@contextmanager
def embedded(folder: Path, changes: dict[str, str] | None = None) -> Iterator[Stack]:
    """A service with its worker beside it, in one folder. changes: further environment variables."""
    broker = {"HELIOPSF_BROKER_URL": "filesystem://"}
    with _running(Stack(folder / "data", broker | (changes or {}))) as stack:
        yield stack


@contextmanager
def alone(folder: Path, changes: dict[str, str] | None = None) -> Iterator[Stack]:
    """A service that nobody works for: its broker is not there. changes: further environment variables."""
    broker = {"HELIOPSF_BROKER_URL": f"redis://127.0.0.1:{free_port()}/0"}
    with _running(Stack(folder / "data", broker | (changes or {}))) as stack:
        yield stack


@contextmanager
def served(folder: Path, workers: int = 1, changes: dict[str, str] | None = None) -> Iterator[Stack]:
    """A service on Redis and PostgreSQL, with workers of its own; ``Missing`` where either is not there.

    changes: further environment variables.
    """
    with ExitStack() as resources:
        redis = resources.enter_context(Redis(folder))
        database_url = resources.enter_context(postgres_database())
        urls = {"HELIOPSF_BROKER_URL": redis.url, "HELIOPSF_DATABASE_URL": database_url}
        stack = Stack(folder / "data", urls | (changes or {}))
        stack.redis = redis
        resources.enter_context(_running(stack))
        for _ in range(workers):
            stack.start_worker()
        yield stack


MODES: dict[str, Callable[..., AbstractContextManager[Stack]]] = {
    "embedded": embedded,
    "redis and postgresql": served,
}
# For tests of which `make test` runs the first alone: the other takes minutes for little more.
EMBEDDED_FIRST = ["embedded", pytest.param("redis and postgresql", marks=pytest.mark.slow)]


@contextmanager
def running(
    mode: str, folder: Path, changes: dict[str, str] | None = None, **options: int
) -> Iterator[Stack]:
    """A service of this mode; skips the test where one of its servers is missing. options: of ``served``."""
    with ExitStack() as resources:
        try:
            yield resources.enter_context(MODES[mode](folder, changes=changes, **options))
        except Missing as missing:
            pytest.skip(str(missing))


@contextmanager
def _running(stack: Stack) -> Iterator[Stack]:
    try:
        stack.start_server()
        yield stack
    finally:
        stack.client.close()
        stack.stop()


class Redis:
    """A Redis server of the test's own, on a free port, that keeps nothing."""

    def __init__(self, folder: Path) -> None:
        binary = shutil.which("redis-server")
        if binary is None:
            raise Missing("no redis-server on this machine")
        self._port = free_port()
        where = ["--bind", "127.0.0.1", "--port", str(self._port), "--dir", str(folder)]
        self._command = [binary, *where, "--save", ""]
        self.url = f"redis://127.0.0.1:{self._port}/0"

    def __enter__(self) -> Redis:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def start(self) -> None:
        self._server = subprocess.Popen(self._command, stdout=subprocess.DEVNULL)
        wait_for(lambda: _listens(self._port), "Redis listens")

    def kill(self) -> None:
        """SIGKILL, as when the power goes; what was queued is gone."""
        self._server.kill()
        self._server.wait()


@contextmanager
def postgres_database(template: str | None = None) -> Iterator[str]:
    """The URL of a database that is there for as long as this lasts: empty, or a copy of the one with this URL."""
    admin = create_engine(POSTGRES, isolation_level="AUTOCOMMIT", connect_args={"connect_timeout": 3})
    name = f"heliopsf_test_{uuid.uuid4().hex[:12]}"
    try:
        with admin.connect() as connection:
            like = "" if template is None else f" TEMPLATE {make_url(template).database}"
            connection.execute(text(f"CREATE DATABASE {name}{like}"))
    except OperationalError as error:
        raise Missing(
            f"no PostgreSQL at {admin.url} (HELIOPSF_TEST_POSTGRES names one): {error.orig}"
        ) from error
    try:
        yield admin.url.set(database=name, drivername="postgresql").render_as_string(hide_password=False)
    finally:
        with admin.connect() as connection:
            connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))
        admin.dispose()


def items(stack: Stack) -> list[Any]:
    """The images of the only bulk run, as rows."""
    engine = create_engine(stack.catalogue_url)
    with engine.connect() as connection:
        rows = connection.execute(select(BulkItemRow.__table__).order_by("position")).all()
    engine.dispose()
    return list(rows)


def free_port() -> int:
    """A port that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def wait_for(condition: Callable[[], bool], what: str, timeout_s: float = 60.0) -> None:
    """Poll until the condition holds; fails the test, naming ``what``, where it does not in time."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, f"waited {timeout_s:g} s in vain: {what}"
        time.sleep(0.05)


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0
