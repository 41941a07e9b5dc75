"""What a person asks for while an archive is worked through: it starts once the job at work ends, before a thousand others."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import create_engine, func, select

from tests.conftest import write_image
from tests.whole.stack import MODES, Stack, running, wait_for
from workers.catalogue.tables import JobRow
from workers.contract.jobs import Phase, Queue

WAITING = 1000

# A thousand jobs and their timing: a machine that does other work too is late without being wrong.
pytestmark = pytest.mark.slow


@pytest.fixture(params=MODES)
def stack(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Stack]:
    # Of a thousand jobs one is at work in the end.
    with running(request.param, tmp_path, {"HELIOPSF_STOP_S": "0.5"}) as stack:
        yield stack


class Rows:
    """The jobs of a stack, as its database has them."""

    def __init__(self, stack: Stack) -> None:
        self.catalogue = stack.catalogue()
        self._engine = create_engine(stack.catalogue_url)

    def close(self) -> None:
        self.catalogue.close()
        self._engine.dispose()

    def count(self, *conditions: object) -> int:
        query = select(func.count()).select_from(JobRow).where(*conditions)  # type: ignore[arg-type]
        with self._engine.connect() as connection:
            return int(connection.scalar(query) or 0)

    def row(self, job_id: str) -> JobRow:
        row = self.catalogue.jobs.get(job_id)
        assert row is not None
        return row


def many_for_an_archive(stack: Stack, rows: Rows, image_id: str, psf_id: str) -> None:
    """A job that takes some seconds, in the queue for bulk, and a thousand more like it."""
    method = {"name": "richardson-lucy", "steps": 120}
    first = stack.client.submit("deconvolve", queue="bulk", image_id=image_id, psf_id=psf_id, method=method)
    parameters = rows.row(first["id"]).parameters
    for number in range(WAITING):
        different = {**parameters, "saturation_dn": 1e9 + number}
        rows.catalogue.jobs.submit("deconvolve", different, f"{number:064x}", "local", queue=Queue.BULK)
    wait_for(lambda: not rows.catalogue.jobs.unsubmitted(3600.0), "the broker has them all", timeout_s=120)


def test_a_persons_job_starts_before_a_thousand_that_wait(
    stack: Stack, tmp_path: Path, psf_file: Path
) -> None:
    write_image(tmp_path / "large.fits", shape=(512, 512))
    write_image(tmp_path / "small.fits")
    psf_id = stack.client.upload_psf(psf_file)["id"]
    large, small = (stack.client.upload_image(tmp_path / f"{name}.fits")["id"] for name in ("large", "small"))
    rows = Rows(stack)
    many_for_an_archive(stack, rows, large, psf_id)
    bulk, done = JobRow.queue == Queue.BULK, JobRow.phase == Phase.COMPLETED
    ended = rows.count(bulk, done)
    wait_for(lambda: rows.count(bulk, done) > ended, "one more is done, so another one has just begun")
    job = stack.client.wait(stack.client.submit("deconvolve", image_id=small, psf_id=psf_id), timeout_s=60)
    mine = rows.row(job["id"])
    assert mine.started_at is not None and mine.queue == Queue.INTERACTIVE
    # From when the broker had it: a bulk's job that began while the request was on its way had no other before it.
    assert mine.submitted_at is not None
    between = rows.count(bulk, JobRow.started_at > mine.submitted_at, JobRow.started_at < mine.started_at)
    still = rows.count(bulk, JobRow.phase == Phase.QUEUED)
    rows.close()
    assert between == 0, "of those that waited none was started before it"
    assert still > WAITING / 2
