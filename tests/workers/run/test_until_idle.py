"""A worker that ends when it has nothing to do, as a job of a batch system does."""

from __future__ import annotations

import random
import time
from contextlib import ExitStack
from pathlib import Path

import psutil
import pytest
from sqlalchemy import select, update

from tests.whole.stack import Missing, Redis, postgres_database
from tests.workers.databases import BOTH, change, rows
from tests.workers.jobs import claimed
from tests.workers.run.processes import started_worker, worker_of
from workers.broker import app as queue
from workers.broker.reconciler import reconcile
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.tables import DEFAULT_OWNER, JobRow
from workers.contract.jobs import Phase, Queue
from workers.settings import Settings

LEASE_S, IDLE_S = 3.0, 6.0
STILL_S = 180.0  # longest time without the end of a job, on a busy machine
SHORT = """
def task(context, _):
    context.report("at work", 1, 2)
    time.sleep(0.03)
    return "result"
"""
WORKER = worker_of(SHORT, f"idle_s={IDLE_S}")


@BOTH
def test_only_jobs_that_a_worker_could_run_keep_it(catalogue: Catalogue) -> None:
    jobs = catalogue.jobs

    def to_do(*queues: Queue, worker: str = "this worker") -> bool:
        return jobs.any_to_do([Queue.INTERACTIVE, *queues], LEASE_S, worker)

    assert not to_do()
    jobs.submit("psf-build", {}, "elsewhere", DEFAULT_OWNER, queue=Queue.BULK)
    assert not to_do() and to_do(Queue.BULK)
    job, _ = jobs.submit("psf-build", {}, "here", DEFAULT_OWNER)
    assert to_do()
    lease = claimed(catalogue, job.id, worker="another worker")
    assert to_do(worker="another worker") and not to_do(), "another worker runs it"
    change(catalogue, update(JobRow).where(JobRow.id == job.id).values(heartbeat_at=time.time() - 60.0))
    assert to_do(), "its worker is lost"
    assert jobs.complete(lease, "r") and not to_do(worker="another worker")


@pytest.mark.parametrize(
    ("served", "jobs", "workers", "kills"),
    [(False, 20, 2, 1), pytest.param(True, 500, 5, 3, marks=pytest.mark.slow)],
    ids=["folder and SQLite", "Redis and PostgreSQL"],
)
def test_each_job_ends_once_and_the_workers_leave(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, served: bool, jobs: int, workers: int, kills: int
) -> None:
    with ExitStack() as resources:
        try:
            urls = {
                "broker_url": resources.enter_context(Redis(tmp_path)).url if served else "filesystem://",
                "database_url": resources.enter_context(postgres_database()) if served else None,
            }
        except Missing as missing:
            pytest.skip(str(missing))
        quick = {"lease_s": LEASE_S, "heartbeat_s": 0.5, "resubmit_s": 3.0}
        settings = Settings(data_dir=tmp_path / "data", **quick, **urls)  # type: ignore[arg-type]
        settings.data_dir.mkdir()
        catalogue, app = Catalogue(settings.catalogue_url), queue.make_app(settings)
        resources.callback(catalogue.close)
        catalogue.upgrade()
        for number in range(jobs):
            catalogue.jobs.submit("psf-build", {}, f"job {number}", DEFAULT_OWNER)
        named = {name: value for name, value in urls.items() if value and name == "database_url"}
        started = [
            started_worker(WORKER, settings, tmp_path / f"{number}.log", worker_threads=1, **quick, **named)
            for number in range(workers)
        ]
        processes = [psutil.Process(worker.pid) for worker in started]
        try:
            lost, done, chance, deadline = 0, 0, random.Random(0), time.monotonic() + STILL_S
            while any(worker.poll() is None for worker in started):
                assert time.monotonic() < deadline, [p.read_text()[-2000:] for p in tmp_path.glob("*.log")]
                reconcile(catalogue, app, settings)
                before = done
                done = len(rows(catalogue, select(JobRow.id).where(JobRow.phase == Phase.COMPLETED)))
                if done > before:
                    deadline = time.monotonic() + STILL_S
                if lost < kills and done > jobs * (lost + 1) / (kills + 2):
                    lost += 1
                    killed = processes.pop(chance.randrange(len(processes)))
                    for process in (killed, *killed.children(recursive=True)):
                        process.kill()
                time.sleep(0.2)
            ended = rows(catalogue, select(JobRow).where(JobRow.phase == Phase.COMPLETED))
            assert (len(ended), lost) == (jobs, kills)
            again = caplog.text.count("no heartbeat from its worker; queued again")
            assert sum(job.attempt for job in ended) == jobs + again, (
                "only jobs whose worker was silent ran again"
            )
            assert sorted(worker.returncode for worker in started) == [-9] * kills + [0] * (workers - kills)
        finally:
            for worker in started:
                if worker.poll() is None:
                    worker.kill()
                worker.wait()
