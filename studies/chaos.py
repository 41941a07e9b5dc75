"""Kill servers and workers at random while they process jobs: no job may be lost, done twice, or stuck.

    python -m studies.chaos [--jobs 300] [--kills 30] [--px 256] [--seed 1] [--redis-keeps]

The study starts a PostgreSQL server, a Redis server, a service and two workers on free ports, with their files in a
temporary folder. Each kill sends SIGKILL to a whole process group, which resembles a power failure. The killed process
starts again a moment later. The client repeats each request until the service accepts it.
"""

from __future__ import annotations

import argparse
import collections
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import httpx
from sqlalchemy import create_engine, text
from sqlalchemy.exc import OperationalError

from psfcore.whole_files import sha256_of
from tests.conftest import write_image, write_psf
from tests.whole.stack import QUICK, Missing, free_port, wait_for

ENDED = ("COMPLETED", "ERROR", "ABORTED")
LONGEST_S = 1800.0
START_S = 180.0  # on a busy machine
REST_S = (0.2, 3.0)  # time between the kill of a process and its new start
STEPS = 20
DATABASES = ("postgresql", "redis", "s3")  # started before all others


@dataclass
class Process:
    """A server that is started, killed and started again."""

    name: str
    command: Sequence[str]
    environment: dict[str, str]
    log: Path
    user: str | None = None
    running: subprocess.Popen[bytes] | None = None
    resting: bool = False
    kills: int = 0

    def start(self) -> None:
        """Start the server in its own process group."""
        with self.log.open("ab") as log:
            self.running = subprocess.Popen(
                self.command,
                env=self.environment,
                stdout=log,
                stderr=log,
                start_new_session=True,
                user=self.user,
                cwd=self.log.parent,
            )

    def kill(self) -> None:
        """Send SIGKILL to the server and all its children."""
        assert self.running is not None
        with suppress(ProcessLookupError):  # the server may have ended by itself a moment ago
            os.killpg(self.running.pid, signal.SIGKILL)
        self.running.wait()
        self.kills += 1

    @property
    def alive(self) -> bool:
        """Whether the server runs."""
        return self.running is not None and self.running.poll() is None


@dataclass
class Servers:
    """All servers. address: the URL of the service. database_url: for queries after the end of the run."""

    processes: dict[str, Process]
    address: str
    database_url: str
    data: Path
    stopped: threading.Event = field(default_factory=threading.Event)

    def kill_at_random(self, kills: int, rng: random.Random, pause_s: tuple[float, float]) -> None:
        """Kill one random server after another, and start each again after a pause."""
        for _ in range(kills):
            if self.stopped.wait(rng.uniform(*pause_s)):
                return
            process = self.processes[rng.choice(sorted(self.processes))]
            process.resting = True  # otherwise `keep_running` would start it too
            process.kill()
            time.sleep(rng.uniform(*REST_S))
            process.start()
            process.resting = False

    def keep_running(self) -> None:
        """Restart servers that ended by themselves, as a supervisor (docker compose, systemd) does."""
        while not self.stopped.wait(1.0):
            for process in self.processes.values():
                if not process.resting and not process.alive and not self.stopped.is_set():
                    process.start()


@contextmanager
def servers(folder: Path, *, redis_keeps: bool, workers: int = 2) -> Iterator[Servers]:
    """Start all servers and wait until they answer; at the end, kill all of them. Raises Missing."""
    data = folder / "data"
    data.mkdir()
    database, redis, port = free_port(), free_port(), free_port()
    made = {
        "postgresql": postgresql(folder, database),
        "redis": redis_server(folder, redis, keeps=redis_keeps),
    }
    database_url = f"postgresql://heliopsf@127.0.0.1:{database}/postgres"
    environment = (
        os.environ
        | QUICK
        | {
            "HELIOPSF_DATA_DIR": str(data),
            "HELIOPSF_DATABASE_URL": database_url,
            "HELIOPSF_BROKER_URL": f"redis://127.0.0.1:{redis}/0",
            "HELIOPSF_MAX_ATTEMPTS": "20",  # a job must not fail because its worker was killed several times
            "OMP_NUM_THREADS": "1",
        }
    )
    python = [sys.executable, "-m", "service.cli"]
    made["service"] = Process(
        "service", [*python, "serve", "--port", str(port)], environment, folder / "service.log"
    )
    for k in range(workers):
        name = f"worker {k + 1}"
        made[name] = Process(name, [*python, "worker"], environment, folder / "workers.log")
    running = Servers(made, f"http://127.0.0.1:{port}", database_url, data)
    with started(running):
        yield running


@contextmanager
def started(running: Servers) -> Iterator[None]:
    """Start all processes, the databases first, and wait until they answer; at the end, kill all of them."""
    made = running.processes
    databases = [name for name in made if name in DATABASES]
    try:
        for name in databases:
            made[name].start()
        wait_for(lambda: _answers(running.database_url), "PostgreSQL answers", START_S)
        for name in made.keys() - databases:
            made[name].start()
        wait_for(lambda: _healthy(running.address), "the service answers", START_S)
        yield
    finally:
        running.stopped.set()
        time.sleep(REST_S[1] + 1)  # the threads that start servers have now seen `stopped`
        for process in made.values():
            if process.alive:
                process.kill()


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
    subprocess.run(
        [initdb, "-D", str(cluster), "-U", "heliopsf", "-A", "trust", "--no-sync"],
        check=True,
        stdout=subprocess.DEVNULL,
        user=user,
        cwd=cluster,
    )
    if network is not None:
        with (cluster / "pg_hba.conf").open("a") as rules:
            rules.write(f"host all all {network} trust\n")
    binary = str(Path(initdb).resolve().parent / "postgres")
    options = ["-p", str(port), "-h", address, "-k", str(cluster)]
    log = folder / "postgresql.log"
    return Process("postgresql", [binary, "-D", str(cluster), *options], dict(os.environ), log, user)


def redis_server(folder: Path, port: int, address: str = "127.0.0.1", *, keeps: bool) -> Process:
    """A Redis server. keeps: it writes its append-only file. Raises Missing."""
    binary = shutil.which("redis-server")
    if binary is None:
        raise Missing("no redis-server on this machine")
    kept = ["--appendonly", "yes" if keeps else "no", "--save", ""]
    command = [
        binary,
        "--bind",
        address,
        "--port",
        str(port),
        "--dir",
        str(folder),
        "--protected-mode",
        "no",
        *kept,
    ]
    return Process("redis", command, dict(os.environ), folder / "redis.log")


def _answers(database_url: str) -> bool:
    engine = create_engine(database_url.replace("postgresql://", "postgresql+psycopg://"))
    try:
        with engine.connect() as connection:
            return bool(connection.scalar(text("SELECT 1")))
    except OperationalError:
        return False
    finally:
        engine.dispose()


def _healthy(address: str) -> bool:
    try:
        return httpx.get(f"{address}/healthz", timeout=2).is_success
    except httpx.HTTPError:
        return False


def patiently(client: httpx.Client, method: str, path: str, **options: object) -> httpx.Response:
    """Send a request; repeat it while the service, or a server that it needs, does not answer."""
    deadline = time.monotonic() + 120
    while True:
        try:
            answer = client.request(method, path, **options)  # type: ignore[arg-type]
            if answer.status_code < 500:
                answer.raise_for_status()
                return answer
            said = answer.text
        except httpx.TransportError as error:
            said = repr(error)
        assert time.monotonic() < deadline, f"{method} {path}: {said[:500]}"
        time.sleep(0.3)


def send(running: Servers, folder: Path, jobs: int, px: int) -> dict[str, str]:
    """Upload `jobs` different images and request a deconvolution of each. Returns the id of the job by id of the image."""
    sent: dict[str, str] = {}
    with httpx.Client(base_url=running.address, timeout=30) as client:
        psf = folder / "psf.fits"
        write_psf(psf)
        psf_id = patiently(client, "POST", "/v1/psfs", content=psf.read_bytes()).json()["id"]
        for k in range(jobs):
            path = folder / f"{k}.fits"
            write_image(path, shape=(px, px), seed=k)
            image_id = patiently(client, "POST", "/v1/images", content=path.read_bytes()).json()["id"]
            path.unlink()
            method = {"name": "richardson-lucy", "steps": STEPS}
            parameters = {"image_id": image_id, "psf_id": psf_id, "method": method}
            body = {"kind": "deconvolve", "parameters": parameters}
            sent[image_id] = patiently(client, "POST", "/v1/jobs", json=body).json()["id"]
    return sent


def wait_for_all(running: Servers, jobs: int) -> None:
    """Wait until all jobs have ended. Raises AssertionError after LONGEST_S."""
    engine = create_engine(running.database_url.replace("postgresql://", "postgresql+psycopg://"))

    def ended() -> bool:
        try:
            with engine.connect() as connection:
                phases = dict(
                    connection.execute(text("SELECT phase, count(*) FROM jobs GROUP BY phase")).all()
                )  # type: ignore[arg-type]
        except OperationalError:
            return False
        return sum(phases.get(phase, 0) for phase in ENDED) == jobs

    wait_for(ended, f"all of {jobs} jobs end", LONGEST_S)
    engine.dispose()


def check(running: Servers, sent: dict[str, str]) -> dict[str, int]:
    """Check that every job is completed, that every image has one product, and that every file is undamaged.

    Returns counts for the output. Raises AssertionError.
    """
    found, digests = check_rows(running, sent)
    for digest in digests:
        path = running.data / "blobs" / digest[:2] / digest
        assert path.is_file() and sha256_of(path) == digest, f"{digest} is whole"
    return found


def check_rows(running: Servers, sent: dict[str, str]) -> tuple[dict[str, int], set[str]]:
    """Check that every job is completed and that every image has one product.

    Returns counts for the output, and the SHA-256 of all files of products. Raises AssertionError.
    """
    engine = create_engine(running.database_url.replace("postgresql://", "postgresql+psycopg://"))
    with engine.connect() as connection:
        jobs = connection.execute(text("SELECT id, phase, attempt, submissions, error FROM jobs")).all()
        products = connection.execute(
            text("SELECT id, image_id, file_sha256, preview_sha256 FROM products")
        ).all()
    engine.dispose()
    phases = collections.Counter(job.phase for job in jobs)
    assert phases == {"COMPLETED": len(sent)}, (phases, [job for job in jobs if job.phase != "COMPLETED"][:3])
    assert {job.id for job in jobs} == set(sent.values())
    made = collections.Counter(product.image_id for product in products)
    assert made == dict.fromkeys(sent, 1), "each image has one product"
    digests = {d for product in products for d in (product.file_sha256, product.preview_sha256)}
    found = {
        "jobs": len(jobs),
        "products": len(products),
        "attempts": sum(job.attempt for job in jobs),
        "submissions": sum(job.submissions for job in jobs),
    }
    return found, digests


def run(jobs: int, kills: int, px: int, seed: int, *, redis_keeps: bool) -> dict[str, int]:
    """Run the study. Returns the counts. Raises AssertionError, Missing."""
    rng = random.Random(seed)
    with tempfile.TemporaryDirectory(prefix="heliopsf-chaos-") as temporary:
        folder = Path(temporary)
        with servers(folder, redis_keeps=redis_keeps) as running:
            killer = threading.Thread(target=running.kill_at_random, args=(kills, rng, (0.5, 6.0)))
            keeper = threading.Thread(target=running.keep_running)
            killer.start()
            keeper.start()
            try:
                sent = send(running, folder, jobs, px)
                killer.join()
                wait_for_all(running, jobs)
            finally:
                running.stopped.set()
                killer.join()
                keeper.join()
            found = check(running, sent)
            return found | {f"kills of {p.name}": p.kills for p in running.processes.values()}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--jobs", type=int, default=300)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--px", type=int, default=256)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--redis-keeps", action="store_true", help="let Redis write its append-only file")
    asked = parser.parse_args()
    started = time.perf_counter()
    found = run(asked.jobs, asked.kills, asked.px, asked.seed, redis_keeps=asked.redis_keeps)
    print(f"Redis {'keeps' if asked.redis_keeps else 'forgets'}; {time.perf_counter() - started:.0f} s")
    print("all jobs completed, each image has one product, no job is stuck:")
    for name, count in found.items():
        print(f"  {name:<20} {count}")


if __name__ == "__main__":
    main()
