"""A worker: the database that it serves, its end when it has nothing to do, and the stages that it reports."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from threading import Thread
from typing import Any

import psutil
import pytest
from sqlalchemy import select, text, update
from sqlalchemy.exc import OperationalError

from psfcore.kernel_files import Kept, KernelFiles, listening
from tests.workers.databases import BOTH, change, rows
from tests.workers.jobs import Bench, claimed
from tests.workers.run.processes import new_catalogue, started_worker, worker_of
from workers.broker import app as queue
from workers.broker.reconciler import reconcile
from workers.catalogue.catalogue import Catalogue
from workers.catalogue.schema import Schema
from workers.catalogue.tables import DEFAULT_OWNER, JobRow
from workers.contract.jobs import Phase, Queue
from workers.run import worker
from workers.run.attempt import COMPILING
from workers.settings import Settings
from workers.tasks.catalogue_workspace import CatalogueWorkspace

LEASE_S, IDLE_S = 3.0, 6.0
JOBS = 20
STILL_S = 180.0  # longest time of all jobs, on a busy machine
SHORT = """
def task(context, _):
    context.report("at work", 1, 2)
    time.sleep(0.03)
    return "result"
"""
WORKER = worker_of(SHORT, f"idle_s={IDLE_S}")


def test_workers_of_one_host_name_and_process_id_have_different_names() -> None:
    """As in containers: each has its own process ids, and may have the host name of another."""
    code = (
        "import os, socket\n"
        "os.getpid = lambda: 1\n"
        "socket.gethostname = lambda: 'worker'\n"
        "from workers.run.child import worker_name\n"
        "print(worker_name() == worker_name(), worker_name())"
    )
    command = [sys.executable, "-c", code]
    names = {subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(2)}
    assert len(names) == 2 and all(name.startswith("True worker:1:") for name in names)


def test_a_database_that_is_away_is_waited_for(
    settings: Settings, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    asked: list[int] = []

    def away_twice(_: Schema) -> None:
        asked.append(1)
        if len(asked) < 3:
            raise OperationalError("SELECT", None, Exception("connection refused by s3cret"))

    monkeypatch.setattr(Schema, "check", away_twice)
    monkeypatch.setattr(worker, "settings", settings)
    monkeypatch.setattr(worker, "WAIT_S", 0.01)
    settings.data_dir.mkdir()
    with caplog.at_level(logging.WARNING, "workers.run.worker"):
        worker.check_tables()
    assert len(asked) == 3 and caplog.text.count("waiting for the database: the connection is refused") == 2
    assert "s3cret" not in caplog.text


def test_a_worker_on_a_later_database_ends_with_a_line_and_status_1(settings: Settings) -> None:
    with new_catalogue(settings) as catalogue:
        change(catalogue, text("UPDATE alembic_version SET version_num = '9999'"))
    kept = {name: value for name, value in os.environ.items() if not name.startswith("HELIOPSF_")}
    ended = subprocess.run(
        [sys.executable, "-m", "service.cli", "worker"],
        env=kept | {"HELIOPSF_DATA_DIR": str(settings.data_dir), "HELIOPSF_BROKER_URL": "filesystem://"},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert ended.returncode == 1, ended.stderr
    last = ended.stderr.strip().splitlines()[-1]
    assert last.startswith("Error: the database is at revision 9999"), ended.stderr
    assert "Traceback" not in ended.stderr


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


def test_each_job_ends_once_although_a_worker_is_killed_and_the_others_leave(
    tmp_path: Path, catalogue: Catalogue, settings: Settings, caplog: pytest.LogCaptureFixture
) -> None:
    quick = {"lease_s": LEASE_S, "heartbeat_s": 0.5, "resubmit_s": 3.0}
    settings = settings.model_copy(update=quick | {"database_url": f"sqlite:///{tmp_path / 'c.sqlite'}"})
    settings.data_dir.mkdir()
    app = queue.make_app(settings)
    for number in range(JOBS):
        catalogue.jobs.submit("psf-build", {}, f"job {number}", DEFAULT_OWNER)
    killed, completed = False, select(JobRow).where(JobRow.phase == Phase.COMPLETED)
    changes = quick | {"worker_threads": 1, "database_url": str(settings.database_url)}
    with ExitStack() as stack:
        logs = [tmp_path / f"{number}.log" for number in range(2)]
        started = [stack.enter_context(started_worker(WORKER, settings, log, **changes)) for log in logs]
        deadline = time.monotonic() + STILL_S
        while any(worker.poll() is None for worker in started):
            assert time.monotonic() < deadline, [log.read_text()[-2000:] for log in logs]
            reconcile(catalogue, app, settings)
            if not killed and len(rows(catalogue, completed)) > JOBS / 3:
                killed, first = True, psutil.Process(started[0].pid)
                for process in (first, *first.children(recursive=True)):
                    process.kill()
            time.sleep(0.2)
        ended = rows(catalogue, completed)
        assert (len(ended), killed) == (JOBS, True)
        again = caplog.text.count("no heartbeat from its worker; queued again")
        assert sum(job.attempt for job in ended) == JOBS + again, (
            "only a job whose worker was silent ran again"
        )
        assert [worker.returncode for worker in started] == [-9, 0]


def test_a_job_that_compiles_says_so(tmp_path: Path, bench: Bench) -> None:
    """A kernel is compiled after its file was looked for in vain, and before its file is written."""
    files = KernelFiles((tmp_path,), "f", "source")
    stages: list[str] = []

    def task(context: CatalogueWorkspace, _: Mapping[str, Any]) -> str:
        context.report("reading", 0, 20)
        for _time in range(2):
            if files.load("float32") is None:
                row = context.catalogue.jobs.get(context.job_id)
                stages.append("" if row is None else row.stage)
                files.save("float32", Kept(None, b"code"))
            context.report("deconvolving", 1, 20)
        stages.extend(sorted(context.times.spent))
        return "0" * 64

    bench.run(task)
    assert stages == [COMPILING, COMPILING, "deconvolving", "reading", "starting"]


def test_only_the_thread_that_listens_is_told(tmp_path: Path) -> None:
    files, told = KernelFiles((tmp_path,), "f", "source"), []
    with listening(told.append):
        other = Thread(target=lambda: files.load("float64"))
        other.start()
        other.join()
        assert told == []
        files.load("float32")
        files.save("float32", Kept(None, b"code"))
        assert files.load("float32") is not None and told == [False, True]
    files.load("float64")
    assert told == [False, True]
