"""Measure how a hostile owner affects a service: delay of another owner, memory of the server, access to others' data.

    python -m studies.hostile_owner [--minutes 10] [--alone-jobs 20] [--seed 1] [-o RESULT.json]

The service runs in keys mode with Redis, PostgreSQL and one worker. The peaceful owner repeats one task: upload a new
image, deconvolve it, download the product. The owner works first alone, and then while the hostile owner attacks in
many threads. The key of the hostile owner has every scope except admin. The attacking process has a low priority,
because it represents another machine, which takes no processor time from the service. The exit status is 1 if a figure
misses its goal.
"""

from __future__ import annotations

import argparse
import collections
import io
import json
import multiprocessing
import os
import random
import socket
import statistics
import sys
import tarfile
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.queues import SimpleQueue
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import numpy as np
import psutil
from astropy.io import fits

from psfcore.whole_files import write_whole
from service.client.errors import ServiceError
from service.client.http import Client
from tests.conftest import SMALL_INSTRUMENT, write_image, write_psf
from tests.service.http.attacks import ARCHIVES, FILES, REQUESTS, Attack
from tests.whole import stack as stacks
from tests.whole.stack import Stack
from workers.catalogue.access import Scope
from workers.catalogue.catalogue import Catalogue
from workers.settings import Settings

MIB = 2**20
MOST_SLOWER = 2.0
MOST_SERVER_MIB = 400.0
EVERYTHING = frozenset(Scope) - {Scope.ADMIN}
IDLE_CONNECTIONS = 300
THREADS = 12
LOW_PRIORITY = 15  # niceness
IDS = "peaceful-ids.json"
BYTES_OF_JSON = 16 * MIB
GREEDY_INSTRUMENT = SMALL_INSTRUMENT + "[[mount]]\n" + 'basis = "assumed"\n' + "windows = 100000\n"
DEEP_INSTRUMENT = SMALL_INSTRUMENT + "x = " + "[" * 20_000 + "\n"


@dataclass
class Peaceful:
    """The peaceful owner. seconds: time of each job, from the upload to the product. ids: the ids of this owner's data."""

    client: Client
    folder: Path
    psf_id: str
    seconds: list[float] = field(default_factory=list)
    refused: list[str] = field(default_factory=list)
    ids: dict[str, str] = field(default_factory=dict)
    made: int = 0

    def work(self, stop: Callable[[], bool]) -> None:
        """Run one job after another until ``stop`` returns True."""
        while not stop():
            self.made += 1
            image, product = self.folder / f"{self.made}.fits", self.folder / f"{self.made}.product.fits"
            write_image(image, shape=(256, 256), seed=self.made)
            started = time.monotonic()
            try:
                made = self.client.deconvolve(image, product, psf_id=self.psf_id, steps=20)
            except (ServiceError, httpx.HTTPError) as error:
                self.refused.append(str(error))
                time.sleep(1.0)
                continue
            self.seconds.append(time.monotonic() - started)
            assert product.stat().st_size > 0
            self.ids |= {"products": made["id"], "images": made["image_id"]}
            write_whole(self.folder / IDS, json.dumps(self.ids))
            product.unlink()
            image.unlink()


class Hostile:
    """The hostile owner. answers: status codes by attack. read_across: responses that contain data of another owner."""

    def __init__(self, server: str, key: str, seed: int, folder: Path) -> None:
        self.answers: collections.Counter[str] = collections.Counter()
        self.read_across: list[str] = []
        self._server, self._headers = server, {"Authorization": f"Bearer {key}"}
        self._seed, self._folder = seed, folder
        self._client = Client(server, key=key)
        self._image_id, self._psf_id = self._own_files()
        self._lock = threading.Lock()
        self._attacks = (
            self.from_the_table,
            self.many_jobs,
            self.deep_json,
            self.greedy_instrument,
            self.many_members,
            self.wrong_ids,
            self.look_across,
            self.cutouts,
            self.long_names,
            self.idle,
            self.slow_body,
            self.events,
        )

    def _own_files(self) -> tuple[str, str]:
        image, psf = self._folder / "hostile.fits", self._folder / "hostile-psf.fits"
        write_image(image, shape=(2048, 2048), seed=self._seed)
        write_psf(psf, size=2048)
        return self._client.upload_image(image)["id"], self._client.upload_psf(psf)["id"]

    def attack(self, number: int, stop: Callable[[], bool]) -> None:
        """Make random attacks until ``stop`` returns True."""
        rng = random.Random(1000 * self._seed + number)
        with httpx.Client(base_url=self._server, headers=self._headers, timeout=60) as http:
            while not stop():
                attack = rng.choice(self._attacks)
                try:
                    attack(http, rng)
                except httpx.HTTPError as error:
                    self._count(attack.__name__, type(error).__name__)

    def _count(self, attack: str, answer: object) -> None:
        with self._lock:
            self.answers[f"{attack}: {answer}"] += 1

    def _note(self, attack: str, answer: httpx.Response) -> httpx.Response:
        self._count(attack, answer.status_code)
        return answer

    def from_the_table(self, http: httpx.Client, rng: random.Random) -> None:
        """Send a file or a request from the table of attacks in the tests."""
        one: Attack = rng.choice((*FILES, *ARCHIVES, *REQUESTS))
        content = None if one.content is None else one.content()
        sent = http.request(one.method, one.address, headers=one.headers, content=content, json=one.json)
        self._note("from_the_table", sent)

    def many_jobs(self, http: httpx.Client, rng: random.Random) -> None:
        """Submit ten long jobs."""
        for _ in range(10):
            method = {"name": "richardson-lucy", "steps": rng.randrange(20, 200)}
            parameters = {"image_id": self._image_id, "psf_id": self._psf_id, "method": method}
            self._note(
                "many_jobs", http.post("/v1/jobs", json={"kind": "deconvolve", "parameters": parameters})
            )

    def deep_json(self, http: httpx.Client, rng: random.Random) -> None:
        """Send a large body that is slow to parse, with and without the key."""
        body = (b"[[],[]," * (BYTES_OF_JSON // 7))[:BYTES_OF_JSON]
        headers = {"Content-Type": "application/json"} | ({"Authorization": ""} if rng.random() < 0.5 else {})
        self._note("deep_json", http.post("/v1/jobs", content=body, headers=headers))

    def greedy_instrument(self, http: httpx.Client, rng: random.Random) -> None:
        """Send instrument files that require much memory."""
        text = rng.choice([GREEDY_INSTRUMENT, DEEP_INSTRUMENT, SMALL_INSTRUMENT.replace("512", "500000")])
        parameters = {"instrument_file": text, "size": 4096}
        self._note(
            "greedy_instrument", http.post("/v1/jobs", json={"kind": "psf-build", "parameters": parameters})
        )

    def many_members(self, http: httpx.Client, rng: random.Random) -> None:
        """Send a transit with a very long list of images."""
        text = b'{"schema":"transit/1","instrument":"hri_euv","images":[' + b"{}," * 1_400_000 + b"{}]}"
        file = io.BytesIO()
        with tarfile.open(fileobj=file, mode="w:gz") as archive:
            member = tarfile.TarInfo("transit.json")
            member.size = len(text)
            archive.addfile(member, io.BytesIO(text))
        self._note("many_members", http.post("/v1/transits", content=file.getvalue()))

    def wrong_ids(self, http: httpx.Client, rng: random.Random) -> None:
        """Request a bulk run of many ids that do not exist."""
        ids = [f"{rng.getrandbits(256):064x}" for _ in range(3000)]
        answer = http.post("/v1/bulk", json={"images": ids, "psf_id": self._psf_id})
        self._note("wrong_ids", answer)
        if len(answer.content) > 64 * 1024:
            self._count("wrong_ids", "a long answer")

    def look_across(self, http: httpx.Client, rng: random.Random) -> None:
        """Request data of the peaceful owner."""
        ids: dict[str, str] = json.loads((self._folder / IDS).read_text("utf-8"))
        for what, identity in ids.items():
            for end in ("", "/file", "/preview", "/lineage", "/psf"):
                answer = self._note("look_across", http.get(f"/v1/{what}/{identity}{end}"))
                if answer.is_success:
                    self.read_across.append(f"/v1/{what}/{identity}{end}")

    def cutouts(self, http: httpx.Client, rng: random.Random) -> None:
        """Request large cut-outs of a PSF."""
        size = rng.choice([2048, 2046, 2044])
        self._note("cutouts", http.get(f"/v1/psfs/{self._psf_id}/cutout", params={"size": size}))

    def long_names(self, http: httpx.Client, rng: random.Random) -> None:
        """Upload a PSF with a very long random name."""
        y, x = np.indices((64, 64)) - 32
        hdu = fits.PrimaryHDU((np.exp(-0.5 * (x**2 + y**2) / 1.5**2) / 14.0).astype("f4"))
        hdu.header["PSFNAME"] = "".join(rng.choice("abcdefghij{}$\\") for _ in range(9000))
        file = io.BytesIO()
        fits.HDUList([hdu]).writeto(file, output_verify="silentfix")
        self._note("long_names", http.post("/v1/psfs", content=file.getvalue()))

    def idle(self, http: httpx.Client, rng: random.Random) -> None:
        """Open connections, send nothing, and hold them for a while."""
        address = urlsplit(self._server)
        held: list[socket.socket] = []
        try:
            for _ in range(IDLE_CONNECTIONS // THREADS):
                with suppress(OSError):
                    held.append(socket.create_connection((address.hostname, address.port or 80), timeout=5))
            time.sleep(rng.uniform(1, 10))
        finally:
            for one in held:
                one.close()
        self._count("idle", f"{len(held)} connections")

    def slow_body(self, http: httpx.Client, rng: random.Random) -> None:
        """Send a request body one byte at a time."""
        address = urlsplit(self._server)
        head = f"POST /v1/jobs HTTP/1.1\r\nHost: {address.netloc}\r\nAuthorization: {self._headers['Authorization']}\r\n"
        with (
            suppress(OSError),
            socket.create_connection((address.hostname, address.port or 80), timeout=5) as one,
        ):
            one.sendall((head + "Content-Type: application/json\r\nContent-Length: 200000\r\n\r\n").encode())
            for _ in range(rng.randrange(5, 20)):
                one.sendall(b"[")
                time.sleep(0.5)
        self._count("slow_body", "sent")

    def events(self, http: httpx.Client, rng: random.Random) -> None:
        """Open a stream of events and hold it for a while."""
        jobs = http.get("/v1/jobs", params={"limit": 1}).json().get("items", [])
        for job in jobs:
            ends = time.monotonic() + rng.uniform(1, 10)
            with http.stream("GET", f"/v1/jobs/{job['id']}/events") as answer:
                self._count("events", answer.status_code)
                for _ in answer.iter_raw():
                    if time.monotonic() > ends:
                        break


class PeakMemory(threading.Thread):
    """The largest resident memory of a process, MiB, sampled five times a second."""

    def __init__(self, pid: int) -> None:
        super().__init__(daemon=True)
        self._process, self.mib, self.ended = psutil.Process(pid), 0.0, threading.Event()

    def run(self) -> None:
        """Sample until ``ended``."""
        while not self.ended.wait(0.2):
            self.mib = max(self.mib, self._process.memory_info().rss / MIB)


def attack(server: str, key: str, seed: int, folder: Path, seconds: float, told: SimpleQueue[Any]) -> None:
    """Attack in many threads for `seconds`. Puts None into `told` at the start, and at the end the answers and `read_across`."""
    os.nice(LOW_PRIORITY)
    hostile = Hostile(server, key, seed, folder)
    told.put(None)
    ends = time.monotonic() + seconds

    def over() -> bool:
        return time.monotonic() > ends

    threads = [threading.Thread(target=hostile.attack, args=(n, over)) for n in range(THREADS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    told.put((hostile.answers, hostile.read_across))


def run(folder: Path, minutes: float, alone_jobs: int, seed: int) -> dict[str, object]:
    """Run the study and return its figures."""
    with stacks.served(folder, changes={"HELIOPSF_ACCESS": "keys"}) as stack:
        peaceful = Peaceful(Client(stack.client.server, key=_key(stack, "peaceful")), folder, "")
        write_psf(folder / "psf.fits", size=256)
        peaceful.psf_id = peaceful.client.upload_psf(folder / "psf.fits")["id"]
        peaceful.work(lambda: len(peaceful.seconds) >= 2)  # the kernels are compiled
        peaceful.seconds.clear()
        peaceful.work(lambda: len(peaceful.seconds) >= alone_jobs)
        alone, peaceful.seconds = peaceful.seconds, []
        assert stack.server is not None
        memory = PeakMemory(stack.server.pid)
        memory.start()
        context = multiprocessing.get_context("spawn")
        told = context.SimpleQueue()
        asked = (stack.client.server, _key(stack, "hostile"), seed, folder, 60 * minutes, told)
        attacker = context.Process(target=attack, args=asked)
        attacker.start()
        told.get()  # the attack begins
        ends = time.monotonic() + 60 * minutes
        peaceful.work(lambda: time.monotonic() > ends)
        answers, read_across = told.get()
        attacker.join()
        memory.ended.set()
        attacked = peaceful.seconds
        return {
            "alone": _figures(alone),
            "attacked": _figures(attacked),
            "slower": statistics.median(attacked) / statistics.median(alone) if attacked else float("inf"),
            "peaceful_refused": collections.Counter(peaceful.refused),
            "server_peak_mib": round(memory.mib),
            "server_lives": stack.server.poll() is None,
            "read_across": read_across,
            "answers": dict(sorted(answers.items())),
        }


def _figures(seconds: Sequence[float]) -> dict[str, float]:
    if not seconds:
        return {"jobs": 0}
    ordered = sorted(seconds)
    return {
        "jobs": len(ordered),
        "median_s": round(statistics.median(ordered), 2),
        "p95_s": round(ordered[int(0.95 * (len(ordered) - 1))], 2),
        "longest_s": round(ordered[-1], 2),
    }


def _key(stack: Stack, owner: str) -> str:
    settings = Settings(data_dir=stack.data, database_url=stack.environment["HELIOPSF_DATABASE_URL"])
    catalogue = Catalogue(settings.catalogue_url)
    try:
        return catalogue.keys.make(owner, set(EVERYTHING))
    finally:
        catalogue.close()


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--alone-jobs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("-o", "--output", type=Path)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        found = run(Path(folder), asked.minutes, asked.alone_jobs, asked.seed)
    text = json.dumps(found, indent=1)
    print(text)
    if asked.output is not None:
        asked.output.write_text(text + "\n", "utf-8")
    slower, peak = found["slower"], found["server_peak_mib"]
    assert isinstance(slower, float) and isinstance(peak, int)
    good = (
        slower <= MOST_SLOWER
        and peak <= MOST_SERVER_MIB
        and not found["read_across"]
        and found["server_lives"]
    )
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
