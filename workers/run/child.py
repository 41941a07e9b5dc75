"""The process in which jobs run: the operating system limits its memory, and it is ended if a job does not stop.

``Stopping`` is the flag with which the parent tells the process that the worker has to stop.

The limit is RLIMIT_DATA. Linux counts private writable memory against it: the heap, arrays, and the stacks of threads.
It does not count memory that is only reserved, or files that are mapped for reading; RLIMIT_AS would count both, and
numba, LLVM and the memory allocator reserve much more than they use. An allocation beyond the limit raises MemoryError.
On systems other than Linux, memory is not limited.

When a worker process has ended, its parent starts a new one (Celery's prefork pool). Other processes of the worker
continue.
"""

from __future__ import annotations

import errno
import faulthandler
import logging
import os
import socket
import sys
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from multiprocessing.sharedctypes import RawValue
from pathlib import Path

log = logging.getLogger(__name__)

MIB = 2**20
MARGIN = 1.5  # estimates of memory are correct within this factor
# Each thread of a library has a stack, and the limit counts the whole stack. OpenBLAS, numba, the Fourier transforms
# and the tasks each have the number of threads that the settings give.
_POOLS = 4
_EXIT_STATUS = 1


class Child:
    """This process, which runs jobs for a worker and may be ended."""

    def __init__(self, threads: int) -> None:
        self._threads = threads

    @contextmanager
    def limited(self, estimate_mib: int) -> Iterator[None]:
        """Limit the memory that the block may use to MARGIN times the estimate, in addition to the memory in use
        already.
        """
        if sys.platform != "linux":
            yield
            return
        import resource

        stack, _ = resource.getrlimit(resource.RLIMIT_STACK)
        stacks = _POOLS * self._threads * (stack if stack != resource.RLIM_INFINITY else 8 * MIB)
        soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
        limit = data_bytes() + allowed_mib(estimate_mib) * MIB + stacks
        limits = [known for known in (limit, soft, hard, sys.maxsize) if known != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_DATA, (min(limits), hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))

    def expect_news_within(self, seconds: float) -> None:
        """End the process after this time. A further call of this method starts the time again; ``expect_no_news``
        stops it.

        The timer needs no Python code. Therefore it also ends a process that hangs in C code.
        """
        faulthandler.dump_traceback_later(seconds, exit=True, file=2)

    def expect_no_news(self) -> None:
        """Stop the clock of ``expect_news_within``."""
        faulthandler.cancel_dump_traceback_later()

    def end(self) -> None:
        """End the process now, without clean-up: its main thread does not respond."""
        for handler in logging.getLogger().handlers:
            handler.flush()
        os._exit(_EXIT_STATUS)


class Stopping:
    """The stop flag, shared with child processes that are forked later: the parent gets the signal, and a child runs
    the job.

    The flag is one number in shared memory. The flag has no lock, because a signal handler writes it.
    """

    def __init__(self) -> None:
        self._let_go_at = RawValue(
            "d", 0.0
        )  # the deadline, as a time of time.monotonic(), a clock that all processes share; 0: the worker need not stop

    def ask(self, within_s: float) -> None:
        """Tell the worker to take no more jobs, and to hand back the running job after ``within_s`` seconds.

        If the worker was already told, the call changes nothing.
        """
        if not self.asked:
            self._let_go_at.value = time.monotonic() + within_s

    @property
    def asked(self) -> bool:
        """True after the worker was told to stop."""
        return bool(self._let_go_at.value)

    @property
    def due(self) -> bool:
        """True when the running job must be handed back."""
        return self.asked and time.monotonic() >= self._let_go_at.value


class Idle:
    """For how long a worker has had nothing to do. Child processes that are forked later share this object.

    A child reads the table of jobs, because the parent must hold no connection to the database when it forks.
    """

    def __init__(self) -> None:
        # The time of time.monotonic() since which there is nothing to do; 0: there is work, or no child has looked yet.
        self._since = RawValue("d", 0.0)

    def tell(self, *, work: bool) -> None:
        """Record whether there is work now."""
        if work:
            self._since.value = 0.0
        elif not self._since.value:
            self._since.value = time.monotonic()

    @property
    def seconds(self) -> float:
        """The time since which there is nothing to do, s; 0 if there is work, or if it is not known."""
        since = self._since.value
        return time.monotonic() - since if since else 0.0


def worker_name() -> str:
    """The name of this process, as jobs and the list of workers show it."""
    return _name(os.getpid())


@cache
def _name(process: int) -> str:
    """A name that no other process has: workers in different containers may have the same host name and process id."""
    return f"{socket.gethostname()}:{process}:{uuid.uuid4().hex[:8]}"


def allowed_mib(estimate_mib: int) -> int:
    """The memory that a job with this estimate may use, MiB."""
    return round(MARGIN * estimate_mib)


def data_bytes() -> int:
    """Private writable memory of this process, as RLIMIT_DATA counts it (proc(5), statm, sixth field)."""
    pages = int(Path("/proc/self/statm").read_text().split()[5])
    return pages * os.sysconf("SC_PAGE_SIZE")


def is_out_of_memory(error: BaseException) -> bool:
    """Whether an exception says that no memory was left: for an array, a mapping, or the stack of a thread."""
    if isinstance(error, OSError):
        return error.errno == errno.ENOMEM
    no_thread = isinstance(error, RuntimeError) and "can't start new thread" in str(error)
    return no_thread or isinstance(error, MemoryError)
