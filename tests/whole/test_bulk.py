"""An archive worked through by real processes: killed and gone on with, beside a person's jobs, on the command line."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any

import psutil
import pytest
from click.testing import CliRunner
from sqlalchemy import create_engine, select

from service.cli.main import main
from tests.conftest import write_image
from tests.whole import stack as stacks
from tests.whole.stack import EMBEDDED_FIRST, SERVED_FIRST, Missing, Stack, wait_for
from workers.catalogue.bulk_tables import BulkItemRow
from workers.settings import Settings

IMAGES = 12


@pytest.fixture
def stack(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Stack]:
    """Two worker processes of one thread each, and an archive that they may read."""
    archive = tmp_path / "archive"
    archive.mkdir()
    for number in range(IMAGES):
        write_image(archive / f"{number:02}.fits", shape=(256, 256), seed=number, WAVELNTH=174)
    monkeypatch.setenv("HELIOPSF_BULK_ROOTS", str(archive))
    monkeypatch.setenv("HELIOPSF_BULK_OUTPUT_ROOTS", str(tmp_path / "out"))
    monkeypatch.setenv("HELIOPSF_WORKER_THREADS", "1")
    embedded = request.param == "embedded"
    monkeypatch.setenv("HELIOPSF_WORKER_PROCESSES", "2" if embedded else "1")
    mode: AbstractContextManager[Stack] = (
        stacks.embedded(tmp_path) if embedded else stacks.served(tmp_path, workers=2)
    )
    with ExitStack() as resources:
        try:
            yield resources.enter_context(mode)
        except Missing as missing:
            pytest.skip(str(missing))


def items(stack: Stack) -> list[Any]:
    """The images of the only bulk, as rows."""
    settings = Settings(data_dir=stack.data, database_url=stack.environment.get("HELIOPSF_DATABASE_URL"))
    engine = create_engine(settings.catalogue_url)
    with engine.connect() as connection:
        found = connection.execute(select(BulkItemRow.__table__).order_by("position")).all()
    engine.dispose()
    return list(found)


def done(stack: Stack, bulk: dict[str, Any]) -> int:
    return int(stack.client.bulk(bulk["id"])["images"]["done"])


def submitted(stack: Stack, psf_file: Path, steps: int = 40, **more: Any) -> dict[str, Any]:
    psf_id = stack.client.upload_psf(psf_file)["id"]
    pattern = f"{stack.data.parent}/archive/*.fits"
    method = {"name": "richardson-lucy", "steps": steps}
    return stack.client.submit_bulk(files=[pattern], psf_id=psf_id, method=method, **more)


def kill_everything(stack: Stack) -> None:
    """SIGKILL to workers and server at once."""
    assert stack.server is not None
    processes = [
        *stack.worker_processes(),
        psutil.Process(stack.server.pid),
        *psutil.Process(stack.server.pid).children(recursive=True),
    ]
    for process in processes:
        if process.is_running():
            process.kill()
    psutil.wait_procs(processes, timeout=10)
    stack.server.wait()


@pytest.mark.parametrize("stack", EMBEDDED_FIRST, indirect=True)
def test_killed_and_gone_on_with_nothing_is_done_twice(stack: Stack, psf_file: Path) -> None:
    bulk = submitted(stack, psf_file, output=str(stack.data.parent / "out"))
    own_workers = len(stack.workers)
    for part in (1, 2):
        wait_for(lambda part=part: done(stack, bulk) >= part * IMAGES // 4, "some are done", timeout_s=120)
        before = {row.position: row for row in items(stack) if row.state == "done"}
        kill_everything(stack)
        stack.start_server()
        stack.workers.clear()
        for _ in range(own_workers):
            stack.start_worker()
    end = stack.client.wait_for_bulk(bulk["id"])
    rows = items(stack)
    assert end["phase"] == "COMPLETED" and [row.error for row in rows if row.error] == []
    assert end["images"]["done"] == IMAGES
    for row in rows:
        if row.position in before:
            assert row.ended_at == before[row.position].ended_at, "done stays done"
    # Each of the two worker processes reads, computes and writes three images at the same time.
    at_work = 2 * 3
    assert sum(row.attempts for row in rows) <= IMAGES + 2 * at_work, (
        "each kill costs an attempt of those at work"
    )
    assert len({row.product_id for row in rows}) == len(list(stack.client.products())) == IMAGES
    written = {path.name for path in (stack.data.parent / "out").iterdir()}
    assert written == {Path(row.output).name for row in rows}, "and nothing half-written"
    manifest = list(stack.client.bulk_results(bulk["id"]))
    assert [line["position"] for line in manifest] == list(range(IMAGES))


@pytest.mark.slow
@pytest.mark.parametrize("stack", SERVED_FIRST, indirect=True)
def test_two_workers_share_a_bulk_and_a_persons_job_goes_first(
    stack: Stack, tmp_path: Path, psf_file: Path
) -> None:
    bulk = submitted(stack, psf_file, steps=100)
    wait_for(lambda: done(stack, bulk) >= 2, "it is under way", timeout_s=120)
    write_image(tmp_path / "mine.fits")
    image_id = stack.client.upload_image(tmp_path / "mine.fits")["id"]
    psf_id = stack.client.upload_psf(psf_file)["id"]
    asked_at = time.time()
    job = stack.client.wait(stack.client.submit("deconvolve", image_id=image_id, psf_id=psf_id))
    between = [row for row in items(stack) if row.taken_at and asked_at < row.taken_at < job["started_at"]]
    assert len(between) <= 1, (
        "the first worker to end an image takes the job; the other may begin one meanwhile"
    )
    assert stack.client.bulk(bulk["id"])["phase"] == "RUNNING"
    end = stack.client.wait_for_bulk(bulk["id"])
    assert end["images"]["done"] == IMAGES
    workers = {row.job_id for row in items(stack)}
    assert len(workers) == 2, "both had a turn"


@pytest.mark.parametrize("stack", EMBEDDED_FIRST, indirect=True)
def test_the_command_line_from_submission_to_report(stack: Stack, psf_file: Path, tmp_path: Path) -> None:
    (tmp_path / "archive" / "zz.fits").write_text("no FITS\n" * 500)

    def bulk(*arguments: str, status: int = 0) -> str:
        answer = CliRunner().invoke(main, ["bulk", *arguments, "--server", stack.client.server])
        assert answer.exit_code == status, answer.output
        return answer.output

    where = ["--where", "WAVELNTH=174", "--where", "XPOSURE>=1", "--where", "XPOSURE<3"]
    pattern = f"{tmp_path}/archive/*.fits"
    asked = ("submit", pattern, "--psf", str(psf_file), *where, "--steps", "2", "--name", "all", "--wait")
    said = bulk(*asked, status=1)  # an image failed
    bulk_id = said.split()[1]
    assert f"COMPLETED: {IMAGES} of {IMAGES + 1} done, 1 failed" in said
    assert f"{bulk_id[:12]}  COMPLETED" in bulk("list")
    manifest, failures = tmp_path / "m.csv", tmp_path / "f.ndjson"
    said = bulk("report", bulk_id, "-o", str(manifest), "--failures", str(failures), "--most", "3")
    assert said.count("/archive/") == 4, "three images and one failure"
    assert "failed: " in said and "zz.fits: expected a FITS file" in said
    assert len(manifest.read_text().splitlines()) == IMAGES + 1
    assert json.loads(failures.read_text())["error"]["code"] == "not-fits"
    (tmp_path / "archive" / "zz.fits").unlink()
    write_image(tmp_path / "archive" / "zz.fits", shape=(256, 256), seed=99)
    bulk("retry", bulk_id)
    assert f"COMPLETED: {IMAGES + 1} of {IMAGES + 1} done, 0 failed" in bulk("status", bulk_id, "--wait")
