"""Run a bulk run over an archive of many small files, and measure the service.

    python -m studies.archive_of_many [--images 50000] [--different 500] [--minutes 4] [--workers 1] [--kill-early] [-o RESULT.json]

The service runs with Redis, PostgreSQL and workers of one thread. The archive has ``--images`` files of 64 px in folders of
500 files. ``--different`` of them have different contents; the others are hard links to them, so their products exist
already when their turn comes. The study submits a bulk run, asks for its status, lists and report, pauses it, kills the
server and all workers, and starts them again. With ``--kill-early``, they are also killed while files are listed. The study
stops after ``--minutes``, even if images are left.

Every request is timed from the client; a streamed answer is timed until its first bytes. Of each time, the study says
how long the server and the database computed for it, and how long they waited for a processor because other programs
used all of them (Linux counts both, ``/proc/PID/schedstat``); a request to ``/healthz``, which reads no data, shows the
same. While the run is paused, the study measures the CPU time that the server needs for a request, which does not depend
on other work on the machine. The exit status is 1 if a request takes longer than 200 ms although the server did not wait
for a processor for the rest of the time, if a request needs more than 200 ms of CPU time, if the memory of the server
grows by more than 40 MiB, if a finished image is processed again after a kill, or if a file is not listed exactly once.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import httpx
import psutil

from psfcore.whole_files import write_whole
from service.client.http import Client
from tests.conftest import write_image, write_psf
from tests.whole import stack as stacks
from tests.whole.stack import Stack, items, wait_for

MIB = 2**20
IN_FOLDER = 500
MOST_REQUEST_S = 0.2
MOST_MORE_MIB = 40.0
CONTROL = "GET /healthz"
ASK_EVERY_S = 0.2
REQUESTS = 20  # requests over which the CPU time is averaged
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Timed:
    """A request. wall_s: its time. cpu_s, waited_s: time in which the server and its connections in the database
    computed, and waited for a processor, meanwhile; both contain what they did for other requests. since_start_s: when it
    began, after the last start of the server."""

    wall_s: float
    cpu_s: float
    waited_s: float
    since_start_s: float

    @property
    def own_s(self) -> float:
        """The time without that in which the server waited for a processor. It is too short if the server waited with
        several threads at once."""
        return max(0.0, self.wall_s - self.waited_s)


class Times:
    """The times of requests, by name."""

    def __init__(self, stack: Stack) -> None:
        self.of: dict[str, list[Timed]] = defaultdict(list)
        self._stack = stack

    def of_request(self, name: str, ask: Callable[[], Answer]) -> Answer:
        """Time a request."""
        cpu_s, waited_s = scheduled(self._stack)
        started = time.perf_counter()
        answer = ask()
        wall_s = time.perf_counter() - started
        cpu_after_s, waited_after_s = scheduled(self._stack)
        # A thread of the server that has ended meanwhile is missing from the second sums.
        spent = max(0.0, cpu_after_s - cpu_s), max(0.0, waited_after_s - waited_s)
        assert self._stack.server is not None
        since_start_s = time.time() - wall_s - psutil.Process(self._stack.server.pid).create_time()
        self.of[name].append(Timed(wall_s, *spent, since_start_s))
        return answer

    def slowest(self, of: Callable[[Timed], float]) -> tuple[str, Timed]:
        """The request with the largest value, without the control."""
        found = {name: max(times, key=of) for name, times in self.of.items() if name != CONTROL}
        return max(found.items(), key=lambda item: of(item[1]))

    def lines(self) -> Iterator[str]:
        """The times as a table."""
        for name, times in sorted(self.of.items()):
            middle = statistics.median(one.wall_s for one in times)
            slowest = max(times, key=lambda one: one.wall_s)
            yield (
                f"{name:<40} {len(times):5}  median {1e3 * middle:6.1f} ms  slowest {1e3 * slowest.wall_s:6.1f} ms, computing "
                f"{1e3 * slowest.cpu_s:6.1f}, waiting for a processor {1e3 * slowest.waited_s:6.1f}; without that wait at most "
                f"{1e3 * max(one.own_s for one in times):6.1f} ms; the slowest began {slowest.since_start_s:.0f} s after the start of "
                "the server"
            )


def scheduled(stack: Stack) -> tuple[float, float]:
    """How long the server and its connections in the database have computed, and have waited for a processor, in seconds."""
    assert stack.server is not None
    cpu_ns = waited_ns = 0
    for process in (stack.server.pid, *backends(psutil.Process(stack.server.pid))):
        for thread in Path(f"/proc/{process}/task").glob("*/schedstat"):
            try:
                cpu, waited, _ = thread.read_text().split()
            except (FileNotFoundError, ProcessLookupError):  # the thread has ended
                continue
            cpu_ns, waited_ns = cpu_ns + int(cpu), waited_ns + int(waited)
    return cpu_ns / 1e9, waited_ns / 1e9


def backends(server: psutil.Process) -> list[int]:
    """The processes of PostgreSQL that work for the server. Their titles name the port of the client."""
    ports = {f"({connection.laddr.port})" for connection in server.net_connections("tcp") if connection.raddr}
    return [
        one.pid
        for one in psutil.process_iter(["name", "cmdline"])
        if one.info["name"] == "postgres" and any(port in " ".join(one.info["cmdline"]) for port in ports)
    ]


def make_archive(folder: Path, images: int, different: int) -> None:
    """Write the different files, and hard links to them until there are ``images`` files."""
    sources = []
    for number in range(images):
        here = folder / f"{number // IN_FOLDER:03}"
        here.mkdir(parents=True, exist_ok=True)
        path = here / f"{number:06}.fits"
        if number < different:
            write_image(path, shape=(64, 64), seed=number)
            sources.append(path)
        else:
            os.link(sources[number % different], path)


def memory_mib(stack: Stack) -> float:
    """Resident memory of the server process."""
    assert stack.server is not None
    return psutil.Process(stack.server.pid).memory_info().rss / MIB


@contextmanager
def asking(client: Client, bulk_id: str, times: Times) -> Iterator[None]:
    """While the block runs, ask what a person who watches a run asks."""
    over = threading.Event()
    failed: list[Exception] = []

    def ask() -> None:
        while not over.wait(ASK_EVERY_S):
            try:
                ask_once(client, bulk_id, times)
            except httpx.HTTPError as error:
                failed.append(error)
                return

    thread = threading.Thread(target=ask)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
    assert not failed, failed


def ask_once(client: Client, bulk_id: str, times: Times) -> None:
    """One request of each sort."""
    for name, address in addresses(bulk_id).items():
        answer = times.of_request(name, lambda address=address: client._http.get(address))  # type: ignore[misc]
        assert answer.status_code == 200, (name, answer.text)


def addresses(bulk_id: str) -> dict[str, str]:
    """The addresses that a person who watches a run asks for, by the name of the request."""
    here = f"/v1/bulk/{bulk_id}"
    return {
        CONTROL: "/healthz",
        "GET /v1/bulk/ID": here,
        "GET /v1/bulk": "/v1/bulk",
        "GET /v1/bulk/ID/failures": f"{here}/failures",
        "GET /v1/bulk/ID/results, worst 20": f"{here}/results?order=worst&limit=20",
        "GET /v1/products": "/v1/products?limit=50",
        "GET /bulk/ID (page)": f"/bulk/{bulk_id}",
        "GET /metrics": "/metrics",
    }


def cpu_s(stack: Stack, bulk_id: str) -> dict[str, float]:
    """The CPU time of the server process for one request, in seconds, by the name of the request."""
    assert stack.server is not None
    server, found = psutil.Process(stack.server.pid), {}
    for name, address in addresses(bulk_id).items():
        before = server.cpu_times()
        for _ in range(REQUESTS):
            assert stack.client._http.get(address).status_code == 200
        after = server.cpu_times()
        found[name] = (after.user + after.system - before.user - before.system) / REQUESTS
    return found


def warm_up(client: Client) -> None:
    """The first requests load modules and templates; they do not count."""
    for address in ("/healthz", "/bulk", "/metrics", "/v1/products") * 3:
        client._http.get(address)


def first_bytes(client: Client, address: str) -> None:
    """Wait for the first bytes of a streamed answer."""
    with client._http.stream("GET", address) as answer:
        assert answer.status_code == 200
        next(answer.iter_bytes())


def ended(stack: Stack) -> dict[int, float]:
    """When the images that are done ended, by their positions."""
    return {row.position: row.ended_at for row in items(stack) if row.state == "done"}


def kill_and_start(stack: Stack, workers: int) -> None:
    """Kill the server and all workers, as a power failure does, and start them again."""
    stack.kill_everything()
    stack.start_server()
    stack.workers.clear()
    for _ in range(workers):
        stack.start_worker()
    warm_up(stack.client)


def study(folder: Path, stack: Stack, archive: Path, asked: argparse.Namespace) -> dict[str, Any]:
    """Run the study; returns its figures."""
    times, client = Times(stack), stack.client
    write_psf(folder / "psf.fits")
    psf_id = client.upload_psf(folder / "psf.fits")["id"]
    warm_up(client)
    before_mib = memory_mib(stack)
    began = time.perf_counter()
    request = {"files": [f"{archive}/**/*.fits"], "psf_id": psf_id}
    method = {"name": "richardson-lucy", "steps": 1}
    bulk_id = times.of_request("POST /v1/bulk", lambda: client.submit_bulk(**request, method=method))["id"]  # type: ignore[arg-type]
    submit_s = time.perf_counter() - began

    def done() -> int:
        found: int = stack.client.bulk(bulk_id)["images"]["done"]
        return found

    with asking(client, bulk_id, times):
        wait_for(lambda: done() > 0, "the first product", 600.0)
        first_s = time.perf_counter() - began
        then_listed = client.bulk(bulk_id)["images"]["total"]
    listed_at_kill, kept = 0, dict[int, float]()
    if asked.kill_early:
        kill_and_start(stack, asked.workers)
        client = stack.client
        now = client.bulk(bulk_id)
        assert not now["listed"], "all files were listed before the kill: use more images"
        listed_at_kill, kept = now["images"]["total"], ended(stack)
    with asking(client, bulk_id, times):
        wait_for(lambda: client.bulk(bulk_id)["listed"], "the files are listed", 1800.0)
        listed_s = time.perf_counter() - began
        half_s = 30.0 * asked.minutes
        running = time.perf_counter()
        start = done()
        wait_for(
            lambda: time.perf_counter() - running > half_s or client.bulk(bulk_id)["phase"] != "RUNNING",
            "half of the time",
            half_s + 60.0,
        )
        rows_a_s = (done() - start) / (time.perf_counter() - running)
        times.of_request("POST /v1/bulk/ID/pause", lambda: client.pause_bulk(bulk_id))
        wait_for(lambda: client.bulk(bulk_id)["images"]["at_work"] == 0, "the images at work are done")
    after_mib = memory_mib(stack)
    cpu = cpu_s(stack, bulk_id)
    kept = ended(stack) | kept
    times.of_request("POST /v1/bulk/ID/resume", lambda: client.resume_bulk(bulk_id))
    wait_for(lambda: done() > len(kept), "the run goes on")
    kept = ended(stack) | kept
    kill_and_start(stack, asked.workers)
    client = stack.client
    restarted = time.perf_counter()
    wait_for(lambda: stack.client.bulk(bulk_id)["images"]["done"] > len(kept) + 10, "it goes on", 300.0)
    goes_on_s = time.perf_counter() - restarted
    with asking(client, bulk_id, times):
        wait_for(
            lambda: (
                time.perf_counter() - restarted > half_s or stack.client.bulk(bulk_id)["phase"] == "COMPLETED"
            ),
            "the second half of the time",
            half_s + 60.0,
        )
        results = f"/v1/bulk/{bulk_id}/results"
        times.of_request("GET /v1/bulk/ID/results, first bytes", lambda: first_bytes(client, results))
        times.of_request(
            "GET /v1/bulk/ID/results as CSV, first bytes",
            lambda: first_bytes(client, f"{results}?format=csv"),
        )
    again_mib = memory_mib(stack)
    started = time.perf_counter()
    lines = sum(1 for _ in client.bulk_results(bulk_id))
    manifest_s = time.perf_counter() - started
    manifest_mib = memory_mib(stack)
    end = client.bulk(bulk_id)
    if end["phase"] == "RUNNING":
        times.of_request("POST /v1/bulk/ID/cancel", lambda: client.cancel_bulk(bulk_id))
    rows = items(stack)
    repeated = [row.position for row in rows if row.position in kept and row.ended_at != kept[row.position]]
    sources = Counter(row.source for row in rows)
    images = end["images"]
    print("\n".join(times.lines()))
    print(
        "\n".join(f"{name:<40} CPU time of the server {1e3 * one_s:6.1f} ms" for name, one_s in cpu.items())
    )
    name, slowest = times.slowest(lambda one: one.wall_s)
    own_name, own = times.slowest(lambda one: one.own_s)
    return {
        "load": " ".join(f"{one:.1f}" for one in os.getloadavg()),
        "images": images["total"],
        "done": images["done"],
        "computed": images["done"] - images["reused"],
        "failed": images["failed"],
        "submit_s": submit_s,
        "listed_s": listed_s,
        "first_product_s": first_s,
        "listed_at_first_product": then_listed,
        "listed_at_kill": listed_at_kill,
        "listed_wrongly": sum(count - 1 for count in sources.values()) + abs(len(sources) - asked.images),
        "slowest_request": name,
        "slowest_request_s": slowest.wall_s,
        "slowest_request_cpu_s": slowest.cpu_s,
        "slowest_request_waited_s": slowest.waited_s,
        "slowest_request_since_start_s": slowest.since_start_s,
        "slowest_without_wait": own_name,
        "slowest_without_wait_s": own.own_s,
        "slowest_control_s": max(one.wall_s for one in times.of[CONTROL]),
        "slower_than_200_ms": sum(one.wall_s > MOST_REQUEST_S for of in times.of.values() for one in of),
        "requests_asked": sum(map(len, times.of.values())),
        "most_cpu_s": max(cpu.values()),
        "rows_per_s": rows_a_s,
        "goes_on_after_kill_s": goes_on_s,
        "processed_again": len(repeated),
        "server_before_mib": before_mib,
        "server_after_mib": after_mib,
        "server_after_restart_mib": again_mib,
        "server_after_manifest_mib": manifest_mib,
        "manifest_rows": lines,
        "manifest_s": manifest_s,
        "requests": {
            name: {
                "number": len(of),
                "slowest_s": max(one.wall_s for one in of),
                "slowest_without_wait_s": max(one.own_s for one in of),
            }
            for name, of in times.of.items()
        },
    }


def misses(found: dict[str, Any]) -> list[str]:
    """The bounds that the figures miss."""
    grown = max(found["server_after_mib"], found["server_after_manifest_mib"]) - found["server_before_mib"]
    missed = []
    if found["slowest_without_wait_s"] > MOST_REQUEST_S:
        missed.append(f"{found['slowest_without_wait']} took {1e3 * found['slowest_without_wait_s']:.0f} ms")
    if found["most_cpu_s"] > MOST_REQUEST_S:
        missed.append(f"a request needs {1e3 * found['most_cpu_s']:.0f} ms of CPU time")
    if grown > MOST_MORE_MIB:
        missed.append(f"the memory of the server grew by {grown:.0f} MiB")
    if found["listed_wrongly"]:
        missed.append(f"{found['listed_wrongly']} files were not listed exactly once")
    if found["processed_again"]:
        missed.append(f"{found['processed_again']} finished images were processed again")
    return missed


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=int, default=50_000)
    parser.add_argument("--different", type=int, default=500)
    parser.add_argument("--minutes", type=float, default=4.0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument(
        "--kill-early", action="store_true", help="kill everything also while files are listed"
    )
    parser.add_argument("-o", "--output", type=Path)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="heliopsf-archive-") as temporary:
        folder = Path(temporary)
        archive = folder / "archive"
        make_archive(archive, asked.images, asked.different)
        print(f"{asked.images} files, {asked.different} of them with different contents", flush=True)
        changes = {"HELIOPSF_BULK_ROOTS": str(archive), "HELIOPSF_READS_PER_MINUTE": "1000000"}
        with stacks.served(folder, workers=asked.workers, changes=changes) as stack:
            found = study(folder, stack, archive, asked)
    for name, value in found.items():
        if name != "requests":
            print(f"{name:<28} {value:.2f}" if isinstance(value, float) else f"{name:<28} {value}")
    if asked.output is not None:
        write_whole(asked.output, json.dumps(found, indent=1))
    missed = misses(found)
    print("\n".join(f"missed: {one}" for one in missed) or "every bound is held")
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    main()
