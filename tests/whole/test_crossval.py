"""A cross-validation shared by two worker processes, one of which is killed half-way."""

from __future__ import annotations

import json
from pathlib import Path

import psutil
import pytest
from sqlalchemy import create_engine, func, select

from tests.transit_files import write_simulated
from tests.whole.stack import Stack, running, wait_for
from workers.catalogue.tables import PartRow

RUNS, BLOCKS = 12, 3


class Parts:
    """The folds of the only job in a stack's database: how many are done, and how many are being done."""

    def __init__(self, stack: Stack) -> None:
        self._engine = create_engine(stack.catalogue_url)

    def done(self) -> int:
        return self._count(PartRow.result.is_not(None))

    def taken(self) -> int:
        return self._count(PartRow.result.is_(None) & PartRow.token.is_not(None))

    def close(self) -> None:
        self._engine.dispose()

    def _count(self, condition) -> int:  # type: ignore[no-untyped-def]
        with self._engine.connect() as connection:
            return int(connection.scalar(select(func.count()).select_from(PartRow).where(condition)) or 0)


def kill_worker_of(stack: Stack, job_id: str, *, own: bool) -> None:
    """SIGKILL to the worker that runs the job, or to the one that helps it, with all its processes."""
    catalogue = stack.catalogue()
    row = catalogue.jobs.get(job_id)
    catalogue.close()
    assert row is not None and row.worker is not None
    pid = int(row.worker.split(":")[1])  # host:process:random
    for worker in stack.workers:
        root = psutil.Process(worker.pid)
        processes = [root, *root.children(recursive=True)]
        if (pid in {p.pid for p in processes}) == own:
            for process in processes:
                process.kill()
            psutil.wait_procs(processes, timeout=10)


@pytest.mark.slow
@pytest.mark.parametrize("own", [True, False], ids=["the worker of the job", "the one that helps"])
def test_one_of_two_workers_killed_half_way_loses_no_fold(tmp_path: Path, own: bool) -> None:
    with running("redis and postgresql", tmp_path, workers=2) as stack:
        transit_id = stack.client.upload_transit(write_simulated(tmp_path / "transit"))["id"]
        parts = Parts(stack)
        job = stack.client.submit("cross-validate", transit_id=transit_id, scheme="exact", runs=RUNS)
        wait_for(lambda: parts.done() >= 6 and parts.taken() == 2, "two workers share the folds", 120)
        kill_worker_of(stack, job["id"], own=own)
        assert parts.done() < RUNS * BLOCKS
        ended = stack.client.wait(job, timeout_s=180)
        assert ended["phase"] == "COMPLETED" and ended["attempt"] == (2 if own else 1)
        found = stack.client.get(ended["result"])
        report = tmp_path / "report.json"
        stack.client.download(found["file"], report)
        folds = [(fold["run"], fold["fold"]) for fold in json.loads(report.read_text())["folds"]]
        assert folds == [(run, fold) for run in range(RUNS) for fold in range(BLOCKS)]
        assert parts.done() == RUNS * BLOCKS
        parts.close()
