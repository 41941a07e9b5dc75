"""Two services for the whole run of the tests, shared by all its processes: one that is open, one that asks for keys.

The first process that asks for a service starts it, in a session of its own; the process that began the run stops it at
the end, also when the run is interrupted. Tests bring names or owners of their own, look only at their own rows, and
kill, fill and change nothing; those that do start a stack of their own (``tests.whole.stack``).
"""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import mkdtemp
from typing import TYPE_CHECKING

import psutil
import pytest

if TYPE_CHECKING:
    from tests.whole.stack import Stack

FOLDER = "HELIOPSF_TEST_STACKS"  # names the folder of the run; worker processes of xdist inherit it
# No test kills these workers, so a busy machine must not make one count as lost.
BOTH = {"HELIOPSF_BROKER_URL": "filesystem://", "HELIOPSF_LEASE_S": "60"}
OWN = {
    "open": {"HELIOPSF_ACCESS": "open"},
    "keys": {"HELIOPSF_ACCESS": "keys", "HELIOPSF_ALLOWED_HOSTS": "*"},
}


def pytest_configure(config: pytest.Config) -> None:
    """Choose the folder of the run."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        return
    os.environ[FOLDER] = mkdtemp(prefix="heliopsf-stacks-")
    if config.getoption("dist", "no") != "no":
        _end_in_order()


def _end_in_order() -> None:
    """Let SIGTERM end this process as Control-C does, which stops the services first."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)


def pytest_unconfigure() -> None:
    """Stop what this run started."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        return
    folder = Path(os.environ.pop(FOLDER))
    for file in folder.glob("*/server.pid"):
        _stop(*map(float, file.read_text().split()))
    shutil.rmtree(folder, ignore_errors=True)


def _stop(pid: float, created: float) -> None:
    """Stop a server and its worker by process id; ``created`` tells whether the id is still that of the server."""
    try:
        server = psutil.Process(int(pid))
        if abs(server.create_time() - created) > 1:
            return
        processes = [server, *server.children(recursive=True)]
        server.terminate()
    except psutil.NoSuchProcess:
        return
    _, left = psutil.wait_procs(processes, timeout=40)
    for process in left:
        process.kill()
    psutil.wait_procs(left, timeout=5)


def _stack(name: str) -> Stack:
    """The service of this name, started if no process has started it yet."""
    from tests.whole.stack import Stack  # imports a database: only where a test needs a service

    folder = Path(os.environ[FOLDER]) / name
    for part in ("archive", "out"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    own = {
        "HELIOPSF_BULK_ROOTS": str(folder / "archive"),
        "HELIOPSF_BULK_OUTPUT_ROOTS": str(folder / "out"),
        "HELIOPSF_CACHE_DIR": str(folder / "cache"),
    }
    working = folder / "working" if name == "keys" else None
    stack = Stack(folder / "data", BOTH | OWN[name] | own, working)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if (folder / "started").exists():
            stack.attach()
        else:
            if "PYTEST_XDIST_WORKER" not in os.environ:
                _end_in_order()
            if working is not None:
                _lay_traps(working)
                (folder / "data").mkdir(mode=0o755)  # readable, as an operator may have made it
            stack.start_server()
            (folder / "started").touch()
    return stack


def _lay_traps(folder: Path) -> None:
    """Put modules into a working folder that tell by the file "sprung" that they were imported.

    They have the names of modules that a server or a worker imports only after its start, or that another program may
    have left.
    """
    folder.mkdir()
    names = {
        "kombu",
        "celery",
        "celeryconfig",
        "redis",
        "service",
        "workers",
        "psfcore",
        "numpy",
        "matplotlib",
    }
    names |= {"sitecustomize"} | {one for one in sys.stdlib_module_names if not one.startswith("_")}
    for name in names:
        (folder / f"{name}.py").write_text(
            f"import os\nos.close(os.open({str(folder / 'sprung')!r}, os.O_CREAT | os.O_WRONLY))\n"
            f"raise ImportError('{name} of the working folder was imported')\n"
        )


@pytest.fixture(scope="session")
def open_stack() -> Iterator[Stack]:
    """A running service with its worker; everybody is the owner ``local``."""
    stack = _stack("open")
    yield stack
    stack.client.close()


@pytest.fixture(scope="session")
def keyed_stack() -> Iterator[Stack]:
    """A running service with its worker that asks for keys; ``Stack.key`` makes one."""
    stack = _stack("keys")
    yield stack
    stack.client.close()
