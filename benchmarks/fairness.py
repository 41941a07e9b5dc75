"""Measure how long requests of one owner take while another owner sends a load.

    python -m benchmarks.fairness [LOAD ...] [--rounds N]

The service runs without a worker. The load comes from a process of its own. Beside it the other owner asks for a list
of images, on a new connection each time, and uploads images of 20 kB. Each round first measures the idle service. Other
work on the machine slows all; the processor time that the service uses during a request does not depend on it, and is
how long the request takes on an idle machine with two cores, if the service is busy.
"""

from __future__ import annotations

import argparse
import http.client
import io
import statistics
import subprocess
import sys
import threading
import time
import zipfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar
from urllib.parse import urlsplit

import numpy as np
import psutil
from astropy.io import fits

from tests.transit_files import write_kernel, write_transit
from tests.whole.stack import alone

STREAMS, KEYS, TRANSITS = 32, 10, 60  # streams of each key of the owner
KERNEL_PX = 1050  # of the known PSF of a transit, which then has 9 MB
IMAGE_PX = 70
IDLE_S, STREAMS_S, PAUSE_S = 3.0, 6.0, 0.02
T = TypeVar("T")


@dataclass(frozen=True)
class Api:
    """The service as it is asked with a key, on a new connection each time."""

    server: str
    key: str

    def send(self, method: str, path: str, body: bytes | None = None) -> http.client.HTTPConnection:
        """A connection on which a request was sent."""
        connection = http.client.HTTPConnection(urlsplit(self.server).netloc, timeout=600)
        connection.request(method, path, body, {"Authorization": f"Bearer {self.key}"})
        return connection

    def ask(self, method: str, path: str, body: bytes | None = None) -> int:
        """The status of the answer, which is read to its end."""
        connection = self.send(method, path, body)
        with connection.getresponse() as answer:
            answer.read()
        connection.close()
        return answer.status


# --- the load ---------------------------------------------------------------------------------------------


def at_once(calls: Sequence[Callable[[], T]]) -> list[T]:
    """The results of calls that begin at the same time."""
    with ThreadPoolExecutor(len(calls)) as pool:
        return [one.result() for one in [pool.submit(call) for call in calls]]


def streams(keys: Sequence[Api]) -> Callable[[], None]:
    """Ask for many streams of events at once, and keep the connections open."""

    def load() -> None:
        opened = at_once([partial(api.send, "GET", "/v1/events") for api in keys] * STREAMS)
        time.sleep(STREAMS_S)
        for one in opened:
            one.close()

    return load


def transits(keys: Sequence[Api]) -> Callable[[], None]:
    """Upload many transits of 9 MB at once, with one key."""
    with TemporaryDirectory() as folder:
        transit = write_transit(Path(folder), images=4)
        y, x = np.indices((KERNEL_PX, KERNEL_PX)) - KERNEL_PX // 2
        kernel = (1.0 + x * x + y * y) ** -1.5
        write_kernel(transit / "diffraction.fits", kernel / kernel.sum())
        members = {path.name: path.read_bytes() for path in transit.iterdir()}
    archives = [archive(members, f"{time.time()} {number}") for number in range(TRANSITS)]

    def load() -> None:
        told = at_once([partial(keys[0].ask, "POST", "/v1/transits", one) for one in archives])
        assert set(told) == {201}, told

    return load


def archive(members: dict[str, bytes], comment: str) -> bytes:
    """A transit as .zip; with another comment it is another one."""
    with io.BytesIO() as file:
        with zipfile.ZipFile(file, "w") as content:
            content.comment = comment.encode()
            for name, member in members.items():
                content.writestr(name, member)
        return file.getvalue()


LOADS = {"streams": streams, "transits": transits}


def send_load(name: str, server: str, *keys: str) -> None:
    """The process of the load: it says when it is prepared, waits for a line, and ends with the load."""
    load = LOADS[name]([Api(server, key) for key in keys])
    print("prepared", flush=True)
    sys.stdin.readline()
    load()


# --- the other owner --------------------------------------------------------------------------------------


def image(number: int) -> bytes:
    """An image of 20 kB, another one for each number."""
    with io.BytesIO() as file:
        header = fits.Header({"TELESCOP": "SDO/AIA", "WAVELNTH": 193, "EXPTIME": 2.0, "NUMBER": number})
        fits.PrimaryHDU(np.full((IMAGE_PX, IMAGE_PX), 9.0, "f4"), header).writeto(file)
        return file.getvalue()


class Asking(threading.Thread):
    """Makes one request after the other until it is told to stop.

    times_s: how long each took, and the processor time of the service meanwhile.
    """

    def __init__(self, service: psutil.Process, request: Callable[[int], object]) -> None:
        super().__init__()
        self._service, self._request, self._stop_now = service, request, threading.Event()
        self.times_s: list[tuple[float, float]] = []

    def run(self) -> None:
        while not self._stop_now.wait(PAUSE_S):
            start, used = time.perf_counter(), self._service.cpu_times()
            self._request(len(self.times_s))
            took, now = time.perf_counter() - start, self._service.cpu_times()
            self.times_s.append((took, now.user + now.system - used.user - used.system))

    def ended(self) -> list[tuple[float, float]]:
        """The times of all requests, of which the last one has ended."""
        self._stop_now.set()
        self.join()
        return self.times_s


def beside(service: psutil.Process, api: Api, load: Callable[[], object]) -> dict[str, str]:
    """How long the requests of an owner take while a load lasts."""
    first = time.time_ns()
    asking = {
        "list": Asking(service, lambda _: api.ask("GET", "/v1/images?limit=20")),
        "upload": Asking(service, lambda number: api.ask("POST", "/v1/images", image(first + number))),
    }
    for one in asking.values():
        one.start()
    load()
    return {name: summary(one.ended()) for name, one in asking.items()}


def summary(times_s: Sequence[tuple[float, float]]) -> str:
    """The times of requests in a line."""
    columns = {"s": [took for took, _ in times_s], "s of the processor": [used for _, used in times_s]}
    return f"{len(times_s)} requests: " + "; ".join(
        f"median {statistics.median(one):.3f}, worst {max(one):.3f} {unit}" for unit, one in columns.items()
    )


def measure(name: str, rounds: int) -> None:
    """Print the times beside a load, and on the idle service."""
    changes = {"HELIOPSF_ACCESS": "keys"}
    with TemporaryDirectory(prefix="heliopsf-fairness-") as folder, alone(Path(folder), changes) as stack:
        other, own = Api(stack.client.server, stack.key("bob")), [stack.key("ann") for _ in range(KEYS)]
        assert stack.server is not None
        service = psutil.Process(stack.server.pid)
        other.ask("POST", "/v1/images", image(0))  # the first upload starts the process that reads files
        for number in range(rounds):
            idle = beside(service, other, lambda: time.sleep(IDLE_S))
            command = [sys.executable, "-m", "benchmarks.fairness", "--send", name, other.server, *own]
            with subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            ) as sender:
                assert sender.stdin is not None and sender.stdout is not None
                sender.stdout.readline()
                sender.stdin.write("\n")
                sender.stdin.flush()
                loaded = beside(service, other, sender.wait)
            assert sender.returncode == 0, f"the load {name} failed"
            for what in loaded:
                print(f"{name} {number + 1}: {what}: {loaded[what]}", flush=True)
                print(f"{'idle':>{len(name)}} {number + 1}: {what}: {idle[what]}", flush=True)


def main() -> None:
    if sys.argv[1:2] == ["--send"]:
        send_load(*sys.argv[2:])
        return
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("loads", nargs="*", choices=[*LOADS, []], metavar="LOAD")
    parser.add_argument("--rounds", type=int, default=3)
    chosen = parser.parse_args()
    for name in chosen.loads or LOADS:
        measure(name, chosen.rounds)


if __name__ == "__main__":
    main()
