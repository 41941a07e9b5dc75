"""A worker on a busy machine, whose processes need long to load their libraries."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.whole.stack import Missing, served, wait_for
from workers.catalogue.catalogue import Catalogue
from workers.contract.phases import Phase
from workers.settings import Settings

# Python imports this module when it starts. Celery waits 4 s for a process that replaces another one, unless it is told
# to wait longer.
SLOW = """
import time
from celery.signals import worker_process_init

@worker_process_init.connect(weak=False)
def load(**_):
    time.sleep(6.0)
"""


@pytest.mark.slow
def test_a_process_that_replaces_a_lost_one_and_starts_slowly_is_not_ended(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(SLOW)
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    try:
        with served(tmp_path, changes={"PYTHONPATH": path}) as stack:
            url = Settings(database_url=stack.environment["HELIOPSF_DATABASE_URL"]).catalogue_url
            catalogue = Catalogue(url)
            wait_for(lambda: len(catalogue.census.workers(3600.0)) == 1, "the first process works", 90.0)
            parent, child = stack.worker_processes()
            child.kill()
            # This job ends at once, because its PSF does not exist.
            job, _ = catalogue.jobs.submit("psf-tables", {"psf_id": "0" * 64}, "k", "local")

            def ended() -> bool:
                row = catalogue.jobs.get(job.id)
                return row is not None and Phase(row.phase).ended

            wait_for(ended, "the job ends", 60.0)
            assert len(catalogue.census.workers(3600.0)) == 2, "the first process and the one in its place"
            assert parent.is_running()
            catalogue.close()
            log = (tmp_path / "workers.log").read_text("utf-8")
    except Missing as missing:
        pytest.skip(str(missing))
    assert "Timed out waiting" not in log
