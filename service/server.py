"""``heliopsf serve``: the web process and, in embedded mode, also a worker process."""

from __future__ import annotations

import gc
import logging
import os
import resource
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import ceil
from pathlib import Path
from types import FrameType

import uvicorn
from fastapi import FastAPI

from service.app import create_app
from service.http.state import check_can_serve
from workers import logs
from workers.catalogue.catalogue import Catalogue
from workers.files.modes import private_folder
from workers.settings import Settings

log = logging.getLogger(__name__)

# Clients such as httpx reuse an idle connection for up to 5 s. A server that closes it at the same moment resets the
# request.
IDLE_CONNECTION_S = 15
MOST_OPEN_FILES = 65_536  # each connection and each file that is sent needs one


def serve(
    settings: Settings, host: str, port: int, announce: Callable[[str], None], *, verbose: bool = False
) -> None:
    """Serve until interrupted. Port 0: any free port. ``announce`` is called with the address of the server. verbose:
    also log every request on a terminal.

    On SIGTERM or Control-C the server accepts no more connections. Running requests may continue for ``stop_s``
    seconds. Then the server stops the embedded worker, which takes at most ``gone_s`` seconds.
    """
    logs.configure(settings, verbose=verbose)
    with listening(host, port) as listener:
        host_name = f"[{host}]" if ":" in host else host
        address = f"http://{host_name}:{listener.getsockname()[1]}"
        server = _Server(
            uvicorn.Config(
                create_app(settings, host),
                log_config=None,
                log_level="warning",
                access_log=False,
                server_header=False,
                timeout_keep_alive=IDLE_CONNECTION_S,
                timeout_graceful_shutdown=ceil(settings.stop_s),
                http="h11",
                ws="none",
                # Without this setting, headers about the address of the client are ignored: a client could write any
                # address.
                proxy_headers=bool(settings.proxies),
                forwarded_allow_ips=list(settings.proxies),
            )
        )
        _prepare(settings, host)
        _allow_open_files()
        # After its shutdown the server raises the signal again. This handler turns the signal into an
        # exception, so that the worker is stopped too.
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
        with embedded_worker(settings):
            announce(address)
            try:
                server.run(sockets=[listener])
            except KeyboardInterrupt:
                log.info("interrupted")


def listening(host: str, port: int) -> socket.socket:
    """A socket bound to an address. Port 0: any free port.

    asyncio sets TCP_NODELAY for a connection only if its listener states the protocol TCP. Without it, an answer on a
    connection that is used again waits for the delayed acknowledgement of the client: 40 ms.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((host, port))
    except OSError:
        listener.close()
        raise
    return listener


def _prepare(settings: Settings, host: str) -> None:
    """Upgrade the database before the worker uses it, and check that a public address requires keys.

    Raises ``SchemaError``, ``NoKeyYet``.
    """
    private_folder(settings.data_dir)
    catalogue = Catalogue(settings.catalogue_url)
    try:
        catalogue.upgrade()
        check_can_serve(settings, host, catalogue)
    finally:
        catalogue.close()


def _allow_open_files() -> None:
    """Raise the number of files that this process may open, up to MOST_OPEN_FILES or the limit of the system."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = MOST_OPEN_FILES if hard == resource.RLIM_INFINITY else min(hard, MOST_OPEN_FILES)
    if soft != resource.RLIM_INFINITY and soft < most:
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


class _Server(uvicorn.Server):
    """Tells the application about a shutdown. Requests that wait for a job are then answered at once."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen, and keep the objects that the start has made."""
        await super().startup(sockets)
        # All modules are loaded now. Their objects stay, so the garbage collector need not look at them again: this
        # took up to 0.2 s, in which no request was answered.
        gc.collect()
        gc.freeze()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Tell the application, then let the server handle the signal."""
        assert isinstance(self.config.app, FastAPI)
        self.config.app.state.stopping = True
        super().handle_exit(sig, frame)


@contextmanager
def embedded_worker(settings: Settings) -> Iterator[None]:
    """Run a worker process while the block runs; restart it if it ends.

    With an external broker it does nothing, because workers are started separately.
    """
    if not settings.embedded:
        yield
        return
    stopping = threading.Event()
    keeper = threading.Thread(target=_keep_worker, args=(settings, stopping), name="worker keeper")
    keeper.start()
    try:
        yield
    finally:
        stopping.set()
        keeper.join()


def _keep_worker(settings: Settings, stopping: threading.Event) -> None:
    while not stopping.is_set():
        try:
            worker = _start_worker(settings)
        except OSError as error:
            log.error("cannot start the worker, will try again: %s", error)
            stopping.wait(5.0)
            continue
        while worker.poll() is None and not stopping.wait(0.5):
            pass
        if stopping.is_set():
            _stop(worker, settings.gone_s + 3.0)
        else:
            log.error("the worker ended with exit status %s; restarting it", worker.returncode)
            stopping.wait(1.0)


def _start_worker(settings: Settings) -> subprocess.Popen[bytes]:
    log_file = settings.data_dir / "worker.log"
    private_folder(log_file.parent)
    with log_file.open("ab") as output:
        return subprocess.Popen(
            # -P: Python imports nothing from the working folder, because other users may be able to write there.
            [sys.executable, "-P", "-m", "service.cli", "worker", "--stop-with-parent", str(os.getpid())],
            env=os.environ | environment(settings),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,  # Celery prints a banner here; the logs go to standard error
            stderr=output,
            # With this, Control-C reaches only this process, which then stops the worker.
            start_new_session=True,
        )


def environment(settings: Settings) -> dict[str, str]:
    """Settings as environment variables for another process."""
    set_here = settings.model_dump(mode="json", exclude_none=True)
    set_here["data_dir"] = str(Path(settings.data_dir).resolve())
    return {f"HELIOPSF_{name.upper()}": str(value) for name, value in set_here.items()}


def _stop(worker: subprocess.Popen[bytes], within_s: float) -> None:
    worker.send_signal(signal.SIGTERM)
    try:
        worker.wait(within_s)
    except subprocess.TimeoutExpired:
        # A worker normally ends before this time. If it does not, the next server queues its job again, so no
        # job is lost.
        os.killpg(worker.pid, signal.SIGKILL)
        worker.wait()
