"""Run a function on a file of strangers in a process of its own, behind a wall and with limited memory and time.

C libraries that read such files may crash, hang, use much memory, or return memory that they did not write. Here they
do so in a process that ends after one file. It is forked from a server process, which has read no file and was started
with a new environment, so it holds neither other files nor passwords. A fork takes some milliseconds; a new interpreter
would take half a second. The child can open its file alone, and no socket or program (`psfcore.wall`).

The server tells how a child ended that gave no answer. A crash, too much memory and too much processor time are the
fault of the file. If something else ended the child, it is tried again; if it was stopped or the machine is too busy,
the error is an OSError.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import errno
import gc
import importlib
import json
import os
import resource
import selectors
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, BinaryIO

from psfcore.errors import DataError, HeaderError
from psfcore.wall import raise_wall, walls

MIB = 2**20
SECONDS = 60  # of processor time; a child may take ten times as long if the machine is busy
LONGEST_S, PATIENCE_S = 10.0 * SECONDS, 10.0 * SECONDS + 30  # of a child, and of the wait for its answer
TRIES = 3
EXIT, LATE = -1, -2  # a child ended itself; the server ended it, because it took too long
# What ends a child because of its file; SIGXCPU is the limit of its processor time, SIGXFSZ that of what it writes.
_OF_FILE = (
    EXIT,
    signal.SIGSEGV,
    signal.SIGBUS,
    signal.SIGABRT,
    signal.SIGFPE,
    signal.SIGILL,
    signal.SIGTRAP,
    signal.SIGSYS,
    signal.SIGXCPU,
    signal.SIGXFSZ,
)
_BYTES_A_PIXEL, _MORE_BYTES = 64, 128 * MIB  # of memory, in addition to the libraries
# The first one lets its library do what it does once, before there is a wall.
_PRELOADED = ("psfcore.fits.hdus", "psfcore.transit.members")
_KEPT_VARIABLES = ("HOME", "PATH", "LANG", "TMPDIR", "OPENBLAS_CORETYPE", "OPENBLAS_L2_SIZE")
_M_PERTURB = -6  # option of mallopt(3): new memory is filled with this byte
FILLING = 0x55

Answer = dict[str, Any]
_server: _Server | None = None
_lock = threading.Lock()
_is_child = False


def run_limited(
    function: Callable[..., Answer],
    path: str | Path,
    target: BinaryIO,
    *,
    pixels: int,
    seconds: int = SECONDS,
    answer_bytes: int | None = None,
    **arguments: object,
) -> Answer:
    """Call ``function(target, path=path, **arguments)`` in a child process; returns its answer.

    Raises the DataError, HeaderError or OSError of the function; DataError "unreadable-pixels" if the child crashed, or
    needed more memory or processor time, or wrote more, than its pixels explain; OSError if the child was ended from
    outside again and again, or gave no answer in PATIENCE_S.

    Parameters
    ----------
    function
        A function of a module that reads the file ``path``.
    target
        An open file, to which the function may write.
    arguments
        Further arguments of the function. JSON must be able to hold these values and the answer of the function.
    pixels
        The number of pixels of the file, which limits the memory of the child.
    seconds
        The limit of the processor time of the child.
    answer_bytes
        The most bytes that the child may write to a file; default: as many as the pixels explain, and no limit if
        `pixels` is 0.
    """
    path, file = Path(path).absolute(), os.stat(path)
    if path.parent == Path("/dev/fd"):  # such a path has a meaning in this process alone
        path = path.resolve()
    if _is_child:
        return function(target, path=str(path), **arguments)
    memory_bytes = _BYTES_A_PIXEL * pixels + file.st_size + _MORE_BYTES
    request = {
        "function": f"{function.__module__}:{function.__qualname__}",
        "file": [file.st_dev, file.st_ino],
        "memory_bytes": memory_bytes,
        "answer_bytes": answer_bytes or (memory_bytes if pixels else None),
        "seconds": seconds,
        "filling": FILLING,
        "arguments": {"path": str(path)} | arguments,
    }
    content, start = json.dumps(request).encode(), target.tell()
    for _ in range(TRIES):
        reply = _answered(content, target)
        if not reply.keys() & {"ended", "lost"}:
            return _result(reply)
        if reply.get("ended") in _OF_FILE:
            raise DataError(
                "unreadable-pixels",
                f"expected readable pixels in {path.name}; reading {pixels} pixels crashed, or needed much more "
                "memory or time than they explain: copy or make the file again",
            )
        if reply.get("ended") == LATE:
            raise OSError(
                errno.ETIMEDOUT,
                f"the process that read {path.name} gave no answer in {LONGEST_S:g} s: try again",
            )
        if stat.S_ISREG(os.fstat(target.fileno()).st_mode):
            os.ftruncate(target.fileno(), start)
            os.lseek(target.fileno(), start, os.SEEK_SET)
    raise OSError(
        errno.EAGAIN, f"the process that read {path.name} was ended from outside {TRIES} times: try again"
    )


def _answered(request: bytes, target: BinaryIO) -> Answer:
    """The answer of a child to a request. If it gave none: "ended" with the signal that ended it, or "lost" if the
    server ended too.
    """
    ours, theirs = socket.socketpair()
    with ours:
        ours.settimeout(PATIENCE_S)
        with theirs:
            _send(theirs.fileno(), target.fileno())
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            ours.sendall(request + b"\n")
        with ours.makefile("rb") as stream, contextlib.suppress(ConnectionResetError):
            for line in stream:
                with contextlib.suppress(ValueError):  # a part of an answer; how the child ended comes next
                    return dict(json.loads(line))
    return {"lost": True}


def scratch_file() -> BinaryIO:
    """A file without a name, which ends with its last use. Behind the wall it is in memory, because no file can be made
    there.
    """
    if _is_child and hasattr(os, "memfd_create"):
        return os.fdopen(os.memfd_create("scratch"), "w+b")
    return TemporaryFile()


def acting(path: str | Path) -> dict[str, bool]:
    """Which parts of the wall stand around a child on this machine (`psfcore.wall.walls`).

    Parameters
    ----------
    path
        Any file, which is not read.
    """
    with Path(os.devnull).open("wb") as nowhere:
        return run_limited(_walls, path, nowhere, pixels=0)


def _walls(_target: BinaryIO, *, path: str) -> Answer:
    return dict(walls())


def prepare() -> None:
    """Start the server if there is none, so that it loads its libraries while this process loads its own."""
    with _lock:
        _running()


def _result(reply: Answer) -> Answer:
    if "answer" in reply:
        return dict(reply["answer"])
    if "errno" in reply:
        raise OSError(reply["errno"], os.strerror(reply["errno"]))
    if "fault" in reply:
        raise RuntimeError(f"a function in a child process failed:\n{reply['fault']}")
    error = HeaderError if reply["is_header_error"] else DataError
    raise error(reply["code"], reply["message"], reply["fields"])


class _Server:
    """The process that forks the children of this process. It ends when this process ends."""

    def __init__(self) -> None:
        self.owner = os.getpid()
        self.socket, theirs = socket.socketpair()
        environment = {key: os.environ[key] for key in _KEPT_VARIABLES if key in os.environ}
        environment |= {"PYTHONPATH": str(Path(__file__).parents[1]), "OPENBLAS_NUM_THREADS": "1"}
        environment |= {"GLIBC_TUNABLES": "glibc.malloc.tcache_count=0"}  # small blocks are filled too
        command = [sys.executable, "-P", "-m", "psfcore.limited"]
        with theirs:
            self._process = subprocess.Popen(
                command,
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                env=environment,
                start_new_session=True,
            )

    @property
    def ended(self) -> bool:
        """Whether the process has ended. Only its owner can tell."""
        return self.owner == os.getpid() and self._process.poll() is not None

    def close(self) -> None:
        self.socket.close()
        if self.owner == os.getpid():
            self._process.wait()


def _send(*handles: int) -> None:
    """Give open files to the server, which forks a child for them. Starts the server if there is none."""
    with _lock:
        try:
            socket.send_fds(_running().socket, [b"\n"], list(handles))
        except OSError:  # the server has just been killed
            _stop()
            socket.send_fds(_running().socket, [b"\n"], list(handles))


def _running() -> _Server:
    """The server of this process; a new one if there is none, or if it was killed."""
    global _server
    if _server is None or _server.owner != os.getpid() or _server.ended:
        _stop()
        _server = _Server()
    return _server


def _forget() -> None:
    """In a forked process: another thread may have held the lock in the process before."""
    global _lock
    _lock = threading.Lock()


os.register_at_fork(after_in_child=_forget)


@atexit.register
def _stop() -> None:
    global _server
    if _server is not None:
        _server.close()
        _server = None


def _serve() -> None:
    """Fork a child for each pair of files that the owner of this process sends, until the owner has ended."""
    hdus, *_ = [importlib.import_module(name) for name in _PRELOADED]
    hdus.prepare_library()
    gc.disable()
    gc.freeze()  # a search for garbage would copy the memory that a child shares with this process
    woken, wake = os.pipe()
    os.set_blocking(wake, False)
    signal.signal(signal.SIGCHLD, lambda _signal, _frame: None)
    signal.set_wakeup_fd(wake)
    # For each process its connection, and when it must have ended.
    children: dict[int, tuple[int, float]] = {}
    with socket.socket(fileno=0) as owner, selectors.DefaultSelector() as ready:
        ready.register(owner, selectors.EVENT_READ)
        ready.register(woken, selectors.EVENT_READ)
        while True:
            there = {key.fileobj for key, _ in ready.select(1.0 if children else None)}
            if woken in there:
                os.read(woken, 4096)
            _bury(children)
            if owner not in there:
                continue
            message, handles, _flags, _address = socket.recv_fds(owner, 1, 2)
            if not message:
                return
            if len(handles) == 2:  # else no file could be opened for them
                child = os.fork()
                if child == 0:
                    _work(*handles)
                children[child] = os.dup(handles[0]), time.monotonic() + LONGEST_S
            for handle in handles:
                os.close(handle)


def _bury(children: dict[int, tuple[int, float]]) -> None:
    """Tell of each child how it has ended, which counts if it gave no answer; and kill those that are late."""
    for child, (connection, until) in list(children.items()):
        late = time.monotonic() > until
        if late:
            os.kill(child, signal.SIGKILL)  # also if it was stopped
        ended, status = os.waitpid(child, os.WNOHANG)
        if not ended:
            continue
        how = LATE if late else os.WTERMSIG(status) if os.WIFSIGNALED(status) else EXIT
        with contextlib.suppress(OSError):  # the owner has the answer already
            os.write(connection, b'\n{"ended": %d}\n' % how)
        os.close(connection)
        del children[child]


def _work(connection: int, target: int) -> None:
    """Run one request and end this process."""
    signal.set_wakeup_fd(-1)
    nothing = os.open(os.devnull, os.O_RDONLY)  # in the place of the socket to the owner
    os.dup2(nothing, 0)
    low, high = sorted((connection, target))
    for first, end in ((3, low), (low + 1, high), (high + 1, resource.getrlimit(resource.RLIMIT_NOFILE)[0])):
        os.closerange(first, end)  # the connections of other children
    try:
        with socket.socket(fileno=connection) as ours, ours.makefile("rwb") as stream:
            request = json.loads(stream.readline())
            stream.write(json.dumps(_reply(request, target)).encode() + b"\n")
    finally:
        os._exit(0)


def _reply(request: Answer, target: int) -> Answer:
    of_functions: Any = importlib.import_module("psfcore.limited")  # this module is __main__ here
    of_functions._is_child = True
    module, name = request["function"].split(":")
    function = getattr(importlib.import_module(module), name)
    fill_new_memory(request["filling"])
    try:
        _limit(request["memory_bytes"], request["answer_bytes"], request["seconds"])
        raise_wall([path := request["arguments"]["path"]])
        # Behind the wall this file alone can be opened: not another one that gets its name now.
        if request["file"] != [os.stat(path).st_dev, os.stat(path).st_ino]:
            raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))
        with os.fdopen(target, "wb") as file:
            return {"answer": function(file, **request["arguments"])}
    except DataError as error:
        facts = {"code": error.code, "message": error.message, "fields": error.fields}
        return facts | {"is_header_error": isinstance(error, HeaderError)}
    except MemoryError:
        return {"ended": signal.SIGXCPU}
    except OSError as error:
        if error.errno == errno.EFBIG:
            return {"ended": signal.SIGXFSZ}
        return {"errno": error.errno} if error.errno else {"fault": traceback.format_exc()}
    except Exception:  # noqa: BLE001  (the owner raises it)
        return {"fault": traceback.format_exc()}


def _limit(memory_bytes: int, answer_bytes: int | None, seconds: int) -> None:
    """Limit the memory, the answer and the time of this process."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if answer_bytes is not None:
        _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
        limit = answer_bytes if most == resource.RLIM_INFINITY else min(most, answer_bytes)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    _, most = resource.getrlimit(resource.RLIMIT_CPU)
    unlimited = most == resource.RLIM_INFINITY
    soft = seconds if unlimited else min(seconds, most)
    # The hard limit is above the soft one, because at the hard limit the signal does not tell what it is about.
    resource.setrlimit(resource.RLIMIT_CPU, (soft, soft + 5 if unlimited else most))
    signal.alarm(round(PATIENCE_S))  # if the server has ended
    if sys.platform == "linux":
        # RLIMIT_DATA also counts what the libraries hold; other systems do not enforce it.
        held = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
        _, most = resource.getrlimit(resource.RLIMIT_DATA)
        limit = held + memory_bytes if most == resource.RLIM_INFINITY else min(most, held + memory_bytes)
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))


def fill_new_memory(byte: int) -> None:
    """Fill memory that is allocated from now on with this byte, so that what a C library does not write is known."""
    if sys.platform == "linux":
        ctypes.CDLL(None).mallopt(_M_PERTURB, byte)


if __name__ == "__main__":
    _serve()
