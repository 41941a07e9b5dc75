"""Cut the network of workers whose clocks differ, and kill processes: no job may be lost, done twice, or stuck.

    python -m studies.chaos_network [--jobs 300] [--faults 30] [--cuts 2] [--cut-s 60] [--apart-s 90] [--px 64] [--seed
    1]

The study simulates three hosts with Linux network namespaces. On the first run PostgreSQL, Redis, an S3 server (moto)
and the service; on each of the others runs a worker. The workers reach the first host through a bridge, have their own
host names and data folders, and keep files only in S3. The clocks of the workers are APART seconds apart, around the
clock of the first host. A fault is one of two kinds: a cut takes a worker out of the bridge for CUT seconds, so that
its packets vanish without an answer; a kill sends SIGKILL to a process group, which starts again a moment later.

The study needs Linux, root, the commands `ip` and `unshare` (Debian: iproute2, util-linux), a C compiler, PostgreSQL,
Redis, and the packages of the extra `dev`. All its traffic stays in its namespaces, which it removes at the end.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from studies.chaos import (
    CLI,
    ObjectStore,
    Process,
    Servers,
    environment_of,
    postgresql,
    redis_server,
    worked_off,
)
from tests.whole.stack import Missing

NETWORK, FIRST = "10.77.0.0/24", "10.77.0.1"
WORKERS = {"worker 1": "10.77.0.11", "worker 2": "10.77.0.12"}
PORTS = {"postgresql": 5432, "redis": 6379, "s3": 9000, "service": 8765}
CLONE_NEWNET = 0x40000000
FILES = ObjectStore(FIRST, PORTS["s3"])


class Hosts:
    """The namespaces. Each worker has a cable to the bridge of the first host, which can be pulled."""

    def __init__(self) -> None:
        self._tag = f"heliopsf-{os.getpid()}"
        self.names = {name: f"{self._tag}-{k}" for k, name in enumerate(["first", *WORKERS])}
        self._cables = {name: f"cable{k + 1}" for k, name in enumerate(WORKERS)}

    def make(self) -> None:
        """Make the namespaces, the bridge and the cables."""
        first = self.names["first"]
        for name in self.names.values():
            _ip("netns", "add", name)
            _ip("-n", name, "link", "set", "lo", "up")
        _ip("-n", first, "link", "add", "bridge0", "type", "bridge")
        _ip("-n", first, "address", "add", f"{FIRST}/24", "dev", "bridge0")
        _ip("-n", first, "link", "set", "bridge0", "up")
        for worker, address in WORKERS.items():
            cable, host = self._cables[worker], self.names[worker]
            _ip("-n", first, "link", "add", cable, "type", "veth", "peer", "name", "net0", "netns", host)
            _ip("-n", first, "link", "set", cable, "master", "bridge0", "up")
            _ip("-n", host, "address", "add", f"{address}/24", "dev", "net0")
            _ip("-n", host, "link", "set", "net0", "up")

    def remove(self) -> None:
        """Remove the namespaces that exist."""
        for name in self.names.values():
            subprocess.run(["ip", "netns", "delete", name], check=False, stderr=subprocess.DEVNULL)

    def cut(self, worker: str) -> None:
        """Let all packets from and to a worker vanish."""
        _ip("-n", self.names["first"], "link", "set", self._cables[worker], "nomaster")

    def join(self, worker: str) -> None:
        """End the cut."""
        _ip("-n", self.names["first"], "link", "set", self._cables[worker], "master", "bridge0")

    def enter_first(self) -> None:
        """Move this thread, and all processes and threads that it starts, to the first host."""
        libc = ctypes.CDLL(None, use_errno=True)
        with open(f"/run/netns/{self.names['first']}") as namespace:
            if libc.setns(namespace.fileno(), CLONE_NEWNET):
                raise OSError(ctypes.get_errno(), "cannot enter the network namespace")


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)


@contextmanager
def hosts() -> Iterator[Hosts]:
    """The hosts; this process is moved to the first. Raises Missing."""
    if sys.platform != "linux" or os.geteuid() != 0:
        raise Missing("network namespaces need Linux and root")
    for command in ("ip", "unshare"):
        if shutil.which(command) is None:
            raise Missing(f"no command {command} on this machine")
    made = Hosts()
    try:
        try:
            made.make()
        except subprocess.CalledProcessError as error:
            raise Missing(f"this machine cannot make network namespaces: {error}") from error
        made.enter_first()
        yield made
    finally:
        made.remove()


# libfaketime 0.9.10 breaks the sleep of Python 3.11 (clock_nanosleep until a time of the monotonic clock: EINVAL). This
# library shifts the clock of the day alone, and the deadlines that glibc compares with it.
CLOCK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <semaphore.h>
#include <stdlib.h>
#include <sys/time.h>
#include <time.h>
static long offset(void) { const char *s = getenv("CLOCK_OFFSET_S"); return s ? atol(s) : 0; }
#define REAL(f) ((__typeof__(&f)) dlsym(RTLD_NEXT, #f))
int clock_gettime(clockid_t clock, struct timespec *now) {
    int rc = REAL(clock_gettime)(clock, now);
    if (!rc && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) now->tv_sec += offset();
    return rc;
}
int gettimeofday(struct timeval *now, void *zone) {
    struct timespec t;
    clock_gettime(CLOCK_REALTIME, &t);
    now->tv_sec = t.tv_sec; now->tv_usec = t.tv_nsec / 1000;
    return 0;
}
time_t time(time_t *out) {
    struct timespec t;
    clock_gettime(CLOCK_REALTIME, &t);
    if (out) *out = t.tv_sec;
    return t.tv_sec;
}
int sem_timedwait(sem_t *sem, const struct timespec *until) {
    struct timespec t = *until;
    t.tv_sec -= offset();
    return REAL(sem_timedwait)(sem, &t);
}
"""


def _clock_library(folder: Path) -> Path:
    """Compile the library. Raises Missing."""
    compiler = shutil.which("cc")
    if compiler is None:
        raise Missing("no C compiler cc on this machine")
    source, library = folder / "clock.c", folder / "clock.so"
    source.write_text(CLOCK)
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(source), "-ldl"], check=True)
    return library


def _at(namespace: str, name: str, command: Sequence[str]) -> list[str]:
    """The command, run on a host with a host name of its own."""
    named = ["unshare", "--uts", "sh", "-c", 'hostname "$0"; exec "$@"', name.replace(" ", "-")]
    return ["ip", "netns", "exec", namespace, *named, *command]


def servers(folder: Path, made: Hosts, apart_s: float) -> Servers:
    """All servers, not started yet. Raises Missing."""
    shared = environment_of(folder, FIRST, PORTS["postgresql"], PORTS["redis"]) | FILES.environment
    processes = [
        postgresql(folder, PORTS["postgresql"], FIRST, NETWORK),
        redis_server(folder, PORTS["redis"], FIRST, keeps=False),
        FILES.process(folder),
    ]
    serve = [*CLI, "serve", "--host", "127.0.0.1", "--port", str(PORTS["service"])]
    commands = {"service": serve} | {name: _at(made.names[name], name, [*CLI, "worker"]) for name in WORKERS}
    offsets_s = {"service": 0.0} | dict(zip(WORKERS, (-apart_s / 2, apart_s / 2), strict=True))
    library = _clock_library(folder)
    for name, command in commands.items():
        data = folder / name.replace(" ", "-")
        data.mkdir()
        own = {"HELIOPSF_DATA_DIR": str(data)}
        if name in WORKERS:
            own |= {"LD_PRELOAD": str(library), "CLOCK_OFFSET_S": f"{offsets_s[name]:.0f}"}
        processes.append(Process(name, command, shared | own, data.with_suffix(".log")))
    address = f"http://127.0.0.1:{PORTS['service']}"
    return Servers({one.name: one for one in processes}, address, PORTS["postgresql"], FIRST)


def run(jobs: int, faults: int, px: int, seed: int, *, cuts: int, cut_s: float, apart_s: float) -> None:
    """Run the study. Raises AssertionError, Missing."""
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory(prefix="heliopsf-chaos-") as temporary, hosts() as made:
        folder = Path(temporary)
        running = servers(folder, made, apart_s)

        def cut(worker: str) -> None:
            made.cut(worker)
            running.stopped.wait(cut_s)
            made.join(worker)

        disturbances = [partial(cut, rng.choice(list(WORKERS))) for _ in range(cuts)]
        # moto keeps objects in memory, so it is not killed.
        disturbances += [partial(running.kill_one, rng, ("s3",))] * (faults - cuts)
        rng.shuffle(disturbances)
        bucket = threading.Thread(target=FILES.make_bucket, daemon=True)
        bucket.start()
        with running.started():
            bucket.join()
            with running.disturbed(disturbances, rng) as disturber:
                digests = worked_off(running, folder, jobs, px, disturber)
                for digest in digests:
                    assert FILES.sha256_of(digest) == digest, f"{digest} is whole"
        print(f"every file in S3 is whole; clocks {apart_s:g} s apart, {cuts} cuts of {cut_s:g} s")


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--jobs", type=int, default=300)
    parser.add_argument("--faults", type=int, default=30, help="number of kills and cuts together")
    parser.add_argument("--cuts", type=int, default=2, help="number of cuts among the faults")
    parser.add_argument("--cut-s", type=float, default=60.0, help="duration of a cut, s")
    parser.add_argument("--apart-s", type=float, default=90.0, help="difference of the workers' clocks, s")
    parser.add_argument("--px", type=int, default=64, help="side of an image, pixels")
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # so that servers and namespaces are removed
    run(
        chosen.jobs,
        chosen.faults,
        chosen.px,
        chosen.seed,
        cuts=chosen.cuts,
        cut_s=chosen.cut_s,
        apart_s=chosen.apart_s,
    )


if __name__ == "__main__":
    main()
