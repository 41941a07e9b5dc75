"""Run a bulk run over an archive of many small files, and measure the service.

    python -m studies.archive_of_many [--images 50000] [--different 500] [--minutes 4] [--workers 1] [-o RESULT.json]

The service runs with Redis, PostgreSQL and workers of one thread. The archive has ``--images`` files of 64 px in folders of
500 files. ``--different`` of them have different contents; the others are hard links to them, so their products exist
already when their turn comes. The study submits a bulk run, asks for its status, lists and report, pauses it, kills the
server and all workers, and starts them again. It stops after ``--minutes``, even if images are left.

Every request is timed from the client; a streamed answer is timed until its first bytes. The study also times requests
to ``/healthz``, which reads no data: their time is what the machine itself adds. While the run is paused, it measures
the CPU time that the server needs for a request, which does not depend on other work on the machine. The exit status is
1 if a request takes longer than 200 ms plus the slowest one to ``/healthz``, if a request needs more than 200 ms of CPU
time, if the memory of the server grows by more than 40 MiB, or if a finished image is processed again after the kill.
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
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import httpx
import psutil

from psfcore.whole_files import write_whole
from service.client.http import Client
from tests.conftest import write_image, write_psf
from tests.whole import stack as stacks
from tests.whole.stack import Stack, wait_for
from tests.whole.test_bulk import items, kill_everything

MIB = 2**20
IN_FOLDER = 500
MOST_REQUEST_S = 0.2
MOST_MORE_MIB = 40.0
CONTROL = "GET /healthz"
ASK_EVERY_S = 0.2
REQUESTS = 20  # requests over which the CPU time is averaged
Answer = TypeVar("Answer")


class Times:
    """The times of requests in seconds, by name."""

    def __init__(self) -> None:
        self.of: dict[str, list[float]] = defaultdict(list)

    def of_request(self, name: str, ask: Callable[[], Answer]) -> Answer:
        """Time a request."""
        started = time.perf_counter()
        answer = ask()
        self.of[name].append(time.perf_counter() - started)
        return answer

    def slowest(self) -> tuple[str, float]:
        """The slowest request, without the control."""
        name = max((name for name in self.of if name != CONTROL), key=lambda name: max(self.of[name]))
        return name, max(self.of[name])

    def lines(self) -> Iterator[str]:
        """The times as a table."""
        for name, times in sorted(self.of.items()):
            middle = statistics.median(times)
            yield f"{name:<40} {len(times):5}  median {1e3 * middle:6.1f} ms  slowest {1e3 * max(times):6.1f} ms"


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


def study(folder: Path, stack: Stack, archive: Path, asked: argparse.Namespace) -> dict[str, Any]:
    """Run the study; returns its figures."""
    times, client = Times(), stack.client
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
        found: int = client.bulk(bulk_id)["images"]["done"]
        return found

    with asking(client, bulk_id, times):
        wait_for(lambda: client.bulk(bulk_id)["phase"] != "LISTING", "the files are listed", 1800.0)
        listed_s = time.perf_counter() - began
        wait_for(lambda: done() > 0, "the first product", 600.0)
        first_s = time.perf_counter() - began
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
    kept = {row.position: row.ended_at for row in items(stack) if row.state == "done"}
    times.of_request("POST /v1/bulk/ID/resume", lambda: client.resume_bulk(bulk_id))
    wait_for(lambda: done() > len(kept), "the run goes on")
    kept |= {row.position: row.ended_at for row in items(stack) if row.state == "done"}
    kill_everything(stack)
    stack.start_server()
    stack.workers.clear()
    for _ in range(asked.workers):
        stack.start_worker()
    client = stack.client
    restarted = time.perf_counter()
    warm_up(client)
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
    images = end["images"]
    print("\n".join(times.lines()))
    print(
        "\n".join(f"{name:<40} CPU time of the server {1e3 * one_s:6.1f} ms" for name, one_s in cpu.items())
    )
    name, slowest_s = times.slowest()
    return {
        "images": images["total"],
        "done": images["done"],
        "computed": images["done"] - images["reused"],
        "failed": images["failed"],
        "submit_s": submit_s,
        "listed_s": listed_s,
        "first_product_s": first_s,
        "slowest_request": name,
        "slowest_request_s": slowest_s,
        "slowest_control_s": max(times.of[CONTROL]),
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
        "requests": {name: {"number": len(of), "slowest_s": max(of)} for name, of in times.of.items()},
    }


def misses(found: dict[str, Any]) -> list[str]:
    """The bounds that the figures miss."""
    most_s = MOST_REQUEST_S + found["slowest_control_s"]
    grown = max(found["server_after_mib"], found["server_after_manifest_mib"]) - found["server_before_mib"]
    missed = []
    if found["slowest_request_s"] > most_s:
        missed.append(f"{found['slowest_request']} took {1e3 * found['slowest_request_s']:.0f} ms")
    if found["most_cpu_s"] > MOST_REQUEST_S:
        missed.append(f"a request needs {1e3 * found['most_cpu_s']:.0f} ms of CPU time")
    if grown > MOST_MORE_MIB:
        missed.append(f"the memory of the server grew by {grown:.0f} MiB")
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
