"""Kill servers and workers at random while they process jobs: no job may be lost, done twice, or stuck.

    python -m studies.chaos [--jobs 300] [--kills 30] [--hang-s 60] [--s3] [--px 256] [--seed 1] [--redis-keeps]

The study starts a PostgreSQL server, a Redis server, a service and two workers on free ports, with their files in a
temporary folder or, with --s3, in an S3 server (moto). Each kill sends SIGKILL to a whole process group, which
resembles a power failure. The killed process starts again a moment later. The client repeats each request until the
service accepts it.

Each of the neighbours PostgreSQL, Redis and S3 is once stopped (SIGSTOP) for HANG seconds: it accepts connections, and
answers nothing. ``/readyz`` must tell each outage, and its end, within 30 s.

Without kills (--kills 0) the last lines show how the memory of a worker process grows with its jobs.
"""

from __future__ import annotations

import argparse
import collections
import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path

import httpx
import psutil
import s3fs
from sqlalchemy import URL, Row, create_engine, text
from sqlalchemy.exc import OperationalError

from psfcore.files import sha256_of
from tests.conftest import write_image, write_psf
from tests.whole.stack import QUICK, Missing, free_port, wait_for

LONGEST_S = 1800.0
START_S = 180.0  # on a busy machine
REST_S = (0.2, 3.0)  # time between the kill of a process and its new start
PAUSE_S = (0.5, 6.0)  # time between two faults
CLI = (sys.executable, "-m", "service.cli")
STEPS = 20
BUCKET = "chaos"
DATABASES = ("postgresql", "redis", "s3")  # started before all others
PARTS = {"postgresql": "database", "redis": "broker", "s3": "object store"}  # as ``/readyz`` names them
TOLD_S = 30.0  # time in which ``/readyz`` must tell an outage, and its end


@dataclass
class Process:
    """A server that is started, killed and started again. user: it runs as this user."""

    name: str
    command: Sequence[str]
    environment: Mapping[str, str]
    log: Path
    user: str | None = None
    running: subprocess.Popen[bytes] | None = None
    resting: bool = False
    kills: int = 0

    def start(self) -> None:
        """Start the server in its own process group."""
        with self.log.open("ab") as log:
            self.running = subprocess.Popen(
                self.command, env=self.environment, stdout=log, stderr=log, start_new_session=True, user=self.user,
                cwd=self.log.parent,
            )  # fmt: skip

    def kill(self) -> None:
        """Send SIGKILL to the server and all its children."""
        assert self.running is not None
        with suppress(ProcessLookupError):  # the server may have ended by itself a moment ago
            os.killpg(self.running.pid, signal.SIGKILL)
        self.running.wait()
        self.kills += 1

    def fail(self, rest_s: float) -> None:
        """Kill the server, and start it again after a rest."""
        self.resting = True  # otherwise `keep_running` would start it too
        self.kill()
        time.sleep(rest_s)
        self.start()
        self.resting = False

    @contextmanager
    def hanging(self) -> Iterator[None]:
        """Stop all processes of the server while the block runs: its connections stay open, and nothing answers."""
        assert self.running is not None
        parent = psutil.Process(self.running.pid)
        stopped = [parent, *parent.children(recursive=True)]
        try:
            for process in stopped:
                process.suspend()
            yield
        finally:
            for process in stopped:
                process.resume()

    @property
    def alive(self) -> bool:
        """Whether the server runs."""
        return self.running is not None and self.running.poll() is None


@dataclass
class Servers:
    """All servers. address: the URL of the service."""

    processes: dict[str, Process]
    address: str
    database_port: int
    database_host: str = "127.0.0.1"
    stopped: threading.Event = field(default_factory=threading.Event)
    told_s: dict[str, tuple[float, float]] = field(default_factory=dict)
    worker_mib: list[float] = field(default_factory=list)

    def ask(self, query: str) -> Sequence[Row[tuple[object, ...]]]:
        """The rows that the database answers. Raises OperationalError while it does not."""
        url = URL.create(
            "postgresql+psycopg", "heliopsf", None, self.database_host, self.database_port, "postgres"
        )
        engine = create_engine(url)
        try:
            with engine.connect() as connection:
                return connection.execute(text(query)).all()
        finally:
            engine.dispose()

    def answers(self) -> bool:
        """Whether the database answers."""
        with suppress(OperationalError):
            return bool(self.ask("SELECT 1"))
        return False

    def is_healthy(self) -> bool:
        """Whether the service answers."""
        with suppress(httpx.HTTPError):
            return httpx.get(f"{self.address}/healthz", timeout=2).is_success
        return False

    def says(self, part: str) -> str:
        """What ``/readyz`` says about a part; "no answer" if the service gives none."""
        with suppress(httpx.HTTPError, ValueError):
            return str(httpx.get(f"{self.address}/readyz", timeout=10).json()["parts"].get(part, "unknown"))
        return "no answer"

    def hang(self, name: str, hang_s: float) -> None:
        """Let a server hang for a time. ``told_s`` then has the times until ``/readyz`` told it, and told its end."""
        part = PARTS[name]
        wait_for(lambda: self.says(part) == "ok", f"{name} is ready", START_S)
        begun = time.monotonic()
        with self.processes[name].hanging():
            wait_for(lambda: self.says(part) not in ("ok", "no answer"), f"{name} is told", hang_s)
            told_s = time.monotonic() - begun
            self.stopped.wait(begun + hang_s - time.monotonic())
        ended = time.monotonic()
        wait_for(lambda: self.says(part) == "ok", f"the end of {name} is told", hang_s)
        self.told_s[name] = (told_s, time.monotonic() - ended)

    def note_memory(self) -> None:
        """Note the memory of the largest process of a worker, MiB."""
        with suppress(psutil.NoSuchProcess):
            parents = [
                one.running.pid for one in self.processes.values() if one.running and "worker" in one.name
            ]
            children = [child for pid in parents for child in psutil.Process(pid).children()]
            self.worker_mib.append(max((one.memory_info().rss for one in children), default=0) / 2**20)

    def keep_running(self) -> None:
        """Restart servers that ended by themselves, as a supervisor (docker compose, systemd) does."""
        while not self.stopped.wait(1.0):
            for process in self.processes.values():
                if not process.resting and not process.alive and not self.stopped.is_set():
                    process.start()

    @contextmanager
    def started(self) -> Iterator[None]:
        """Start all processes, the databases first, and wait until they answer; at the end, kill all of them."""
        databases = [name for name in self.processes if name in DATABASES]
        try:
            for name in databases:
                self.processes[name].start()
            wait_for(self.answers, "PostgreSQL answers", START_S)
            for name in self.processes.keys() - databases:
                self.processes[name].start()
            wait_for(self.is_healthy, "the service answers", START_S)
            yield
        finally:
            self.stopped.set()
            time.sleep(REST_S[1] + 1)  # the threads that start servers have now seen `stopped`
            for process in self.processes.values():
                if process.alive:
                    process.kill()

    def kill_one(self, rng: random.Random, spared: Sequence[str] = ()) -> None:
        """Kill a random server, and start it again."""
        name = rng.choice(sorted(self.processes.keys() - spared))
        self.processes[name].fail(rng.uniform(*REST_S))

    @contextmanager
    def disturbed(
        self, faults: Sequence[Callable[[], None]], rng: random.Random
    ) -> Iterator[threading.Thread]:
        """Run faults one after the other in a thread of their own, which is returned."""

        def disturb() -> None:
            for fault in faults:
                if self.stopped.wait(rng.uniform(*PAUSE_S)):
                    return
                fault()

        threads = [threading.Thread(target=disturb), threading.Thread(target=self.keep_running)]
        for thread in threads:
            thread.start()
        try:
            yield threads[0]
        finally:
            self.stopped.set()
            for thread in threads:
                thread.join()


def postgresql(folder: Path, port: int, address: str = "127.0.0.1", network: str | None = None) -> Process:
    """A new PostgreSQL server. network: clients of this network need no password. Raises Missing."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    initdb = shutil.which("initdb") or (str(found[-1]) if found else None)
    if initdb is None:
        raise Missing("no initdb of PostgreSQL on this machine")
    user = "postgres" if os.geteuid() == 0 else None  # PostgreSQL refuses to run as root
    cluster = folder / "postgresql"
    cluster.mkdir()
    if user is not None:
        folder.chmod(0o755)
        shutil.chown(cluster, user)
    command = [initdb, "-D", str(cluster), "-U", "heliopsf", "-A", "trust", "--no-sync"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, user=user, cwd=cluster)
    if network is not None:
        with (cluster / "pg_hba.conf").open("a") as rules:
            rules.write(f"host all all {network} trust\n")
    binary = str(Path(initdb).resolve().parent / "postgres")
    options = ["-p", str(port), "-h", address, "-k", str(cluster)]
    log = folder / "postgresql.log"
    return Process("postgresql", [binary, "-D", str(cluster), *options], os.environ, log, user)


def redis_server(folder: Path, port: int, address: str = "127.0.0.1", *, keeps: bool) -> Process:
    """A Redis server. keeps: it writes its append-only file. Raises Missing."""
    binary = shutil.which("redis-server")
    if binary is None:
        raise Missing("no redis-server on this machine")
    options = {"bind": address, "port": port, "dir": folder, "protected-mode": "no", "save": ""}
    options["appendonly"] = "yes" if keeps else "no"
    words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    return Process("redis", [binary, *words], os.environ, folder / "redis.log")


def environment_of(folder: Path, host: str, database: int, redis: int) -> dict[str, str]:
    """The environment of a service and its workers."""
    own = {
        "HELIOPSF_DATA_DIR": str(folder),
        "HELIOPSF_DATABASE_URL": f"postgresql://heliopsf@{host}:{database}/postgres",
        "HELIOPSF_BROKER_URL": f"redis://{host}:{redis}/0",
        "HELIOPSF_MAX_ATTEMPTS": "40",  # a job must not fail because its worker was lost several times
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": str(Path(__file__).parents[1]),  # the processes start in another folder
    }
    return os.environ | QUICK | own


def patiently(client: httpx.Client, path: str, **options: object) -> str:
    """Post a request; repeat it while the service, or a server that it needs, does not answer. Returns the id."""
    deadline = time.monotonic() + 120
    while True:
        try:
            answer = client.post(path, **options)  # type: ignore[arg-type]
            if answer.status_code < 500:
                answer.raise_for_status()
                return str(answer.json()["id"])
            said = answer.text
        except httpx.TransportError as error:
            said = repr(error)
        assert time.monotonic() < deadline, f"{path}: {said[:500]}"
        time.sleep(0.3)


def send(running: Servers, folder: Path, jobs: int, px: int) -> dict[str, str]:
    """Upload `jobs` different images and request a deconvolution of each. Returns the id of the job by id of the
    image."""
    sent: dict[str, str] = {}
    path, method = folder / "sent.fits", {"name": "richardson-lucy", "steps": STEPS}
    with httpx.Client(base_url=running.address, timeout=30) as client:
        write_psf(path)
        psf_id = patiently(client, "/v1/psfs", content=path.read_bytes())
        for seed in range(jobs):
            path.unlink()
            write_image(path, shape=(px, px), seed=seed)
            image_id = patiently(client, "/v1/images", content=path.read_bytes())
            parameters = {"image_id": image_id, "psf_id": psf_id, "method": method}
            body = {"kind": "deconvolve", "parameters": parameters}
            sent[image_id] = patiently(client, "/v1/jobs", json=body)
            running.note_memory()
    return sent


def worked_off(running: Servers, folder: Path, jobs: int, px: int, disturber: threading.Thread) -> set[str]:
    """Send jobs and wait until all have ended. Each must be completed, and each image have one product.

    Prints counts; returns the SHA-256 of all files of products. Raises AssertionError, also after LONGEST_S.
    """
    sent = send(running, folder, jobs, px)
    disturber.join()

    def ended() -> bool:
        running.note_memory()
        with suppress(OperationalError):
            over = "SELECT count(*) FROM jobs WHERE phase IN ('COMPLETED', 'ERROR', 'ABORTED')"
            return running.ask(over)[0][0] == jobs
        return False

    wait_for(ended, f"all of {jobs} jobs end", LONGEST_S)
    rows = running.ask("SELECT id, phase, attempt, submissions, error FROM jobs")
    products = running.ask("SELECT image_id, file_sha256, preview_sha256 FROM products")
    assert not (failed := [row for row in rows if row.phase != "COMPLETED"]), failed[:3]
    assert {row.id for row in rows} == set(sent.values())
    count = collections.Counter(product.image_id for product in products)
    assert count == dict.fromkeys(sent, 1), "each image has one product"
    print("all jobs completed, each image has one product, no job is stuck:")
    counts = {"jobs": len(rows), "products": len(products), "attempts": sum(row.attempt for row in rows)}
    counts |= {"submissions": sum(row.submissions for row in rows)}
    counts |= {f"kills of {process.name}": process.kills for process in running.processes.values()}
    for name, number in counts.items():
        print(f"  {name:<20} {number}")
    for name, (told_s, ended_s) in running.told_s.items():
        print(f"  {name} hung: told after {told_s:.1f} s, its end after {ended_s:.1f} s")
        assert max(told_s, ended_s) <= TOLD_S, "each outage and its end are told in time"
    tenth = running.worker_mib[len(running.worker_mib) // 10]
    last, largest = running.worker_mib[-1], max(running.worker_mib)
    print(
        f"  a worker process: {tenth:.0f} MiB after a tenth, {last:.0f} MiB at the end, {largest:.0f} MiB at most"
    )
    return {digest for product in products for digest in (product.file_sha256, product.preview_sha256)}


@dataclass(frozen=True)
class ObjectStore:
    """An S3 server (moto) and its bucket. It keeps objects in memory, so it must not be killed."""

    host: str
    port: int

    def process(self, folder: Path) -> Process:
        """The server, not started yet."""
        command = [sys.executable, "-m", "moto.server", "-H", self.host, "-p", str(self.port)]
        return Process("s3", command, os.environ, folder / "s3.log")

    @property
    def environment(self) -> dict[str, str]:
        """The settings of a service and its workers."""
        return {
            "AWS_ENDPOINT_URL": f"http://{self.host}:{self.port}",
            "AWS_ACCESS_KEY_ID": "test",
            "AWS_SECRET_ACCESS_KEY": "test",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_EC2_METADATA_DISABLED": "true",
            "HELIOPSF_STORE_URL": f"s3://{BUCKET}/files",
        }

    def make_bucket(self) -> None:
        """Make the bucket, once the server answers."""

        def done() -> bool:
            try:
                self._client().mkdir(BUCKET)
            except OSError:
                return False
            return True

        wait_for(done, "the S3 server answers", START_S)

    def sha256_of(self, digest: str) -> str:
        """The SHA-256 of the content of a stored file."""
        return hashlib.sha256(
            self._reader.cat_file(f"{BUCKET}/files/blobs/{digest[:2]}/{digest}")
        ).hexdigest()

    @cached_property
    def _reader(self) -> s3fs.S3FileSystem:
        return self._client()  # for all files, because a client takes a second to make

    def _client(self) -> s3fs.S3FileSystem:
        return s3fs.S3FileSystem(
            key="test",
            secret="test",
            endpoint_url=f"http://{self.host}:{self.port}",
            skip_instance_cache=True,
            use_listings_cache=False,
        )


def run(jobs: int, kills: int, px: int, seed: int, *, hang_s: float, s3: bool, redis_keeps: bool) -> None:
    """Run the study. Raises AssertionError, Missing."""
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory(prefix="heliopsf-chaos-") as temporary:
        folder = Path(temporary)
        database, redis, port = free_port(), free_port(), free_port()
        files = ObjectStore("127.0.0.1", free_port()) if s3 else None
        own = environment_of(folder / "data", "127.0.0.1", database, redis)
        own |= {} if files is None else files.environment
        serve = Process("service", [*CLI, "serve", "--port", str(port)], own, folder / "service.log")
        workers = [Process(f"worker {k}", [*CLI, "worker"], own, folder / "workers.log") for k in (1, 2)]
        stores = [postgresql(folder, database), redis_server(folder, redis, keeps=redis_keeps)]
        stores += [] if files is None else [files.process(folder)]
        (folder / "data").mkdir()
        processes = {process.name: process for process in [*stores, serve, *workers]}
        running = Servers(processes, f"http://127.0.0.1:{port}", database)
        faults = [partial(running.kill_one, rng, ("s3",))] * kills
        if hang_s:
            faults += [partial(running.hang, process.name, hang_s) for process in stores]
        rng.shuffle(faults)
        if files is not None:
            threading.Thread(target=files.make_bucket, daemon=True).start()
        with running.started(), running.disturbed(faults, rng) as disturber:
            for digest in worked_off(running, folder, jobs, px, disturber):
                path = folder / "data" / "blobs" / digest[:2] / digest
                found = sha256_of(path) if files is None else files.sha256_of(digest)
                assert found == digest, f"{digest} is whole"
            assert not hang_s or running.told_s.keys() == {process.name for process in stores}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--jobs", type=int, default=300)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument(
        "--hang-s", type=float, default=60.0, help="time for which each neighbour hangs, s; 0: none hangs"
    )
    parser.add_argument("--s3", action="store_true", help="keep the files in an S3 server, which hangs too")
    parser.add_argument("--px", type=int, default=256)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--redis-keeps", action="store_true", help="let Redis write its append-only file")
    chosen = parser.parse_args()
    run(
        chosen.jobs,
        chosen.kills,
        chosen.px,
        chosen.seed,
        hang_s=chosen.hang_s,
        s3=chosen.s3,
        redis_keeps=chosen.redis_keeps,
    )


if __name__ == "__main__":
    main()
