"""Processes killed at work, each as when the power goes: nothing is lost, and nothing is done twice.
An archive worked through by real processes: on the command line, and by two workers beside a person's job.
A little of `make chaos`: jobs while what they need is killed, and while the network of a worker is cut.
The service with its files in S3: in, out, by a worker of its own, and from a server that has no copy yet.
SIGTERM to a server: it takes no more, and is gone within the time that it states, whatever a client does."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import psutil
import pytest
from astropy.io import fits
from click.testing import CliRunner

from service.cli.main import main
from studies import chaos
from tests.conftest import SMALL_INSTRUMENT, write_image
from tests.s3 import s3_bucket
from tests.whole import stack as stacks
from tests.whole.stack import EMBEDDED_FIRST, Missing, Stack, items, running, wait_for
from workers.contract.jobs import Phase

IMAGES = 8
AT_WORK = 3  # images of a bulk run that one process reads, computes and writes at the same time
SERVED = "redis and postgresql"


@pytest.fixture(scope="module", params=EMBEDDED_FIRST)
def stack(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """A service that the first two tests share, and an archive that it may read."""
    folder = tmp_path_factory.mktemp("shared")
    (folder / "archive").mkdir()
    changes = {
        "HELIOPSF_BULK_ROOTS": str(folder / "archive"),
        "HELIOPSF_BULK_OUTPUT_ROOTS": str(folder / "out"),
    }
    with running(request.param, folder, changes) as stack:
        yield stack


def archive_run(stack: Stack, psf_file: Path, *, steps: int = 30, **more: Any) -> dict[str, Any]:
    """A bulk run of the images of an archive."""
    archive = stack.data.parent / "archive"
    for number in range(IMAGES):
        write_image(archive / f"{number:02}.fits", shape=(256, 256), seed=number)
    psf_id = stack.client.upload_psf(psf_file)["id"]
    method = {"name": "richardson-lucy", "steps": steps}
    return stack.client.submit_bulk(files=[f"{archive}/*.fits"], psf_id=psf_id, method=method, **more)


def done(stack: Stack, bulk: dict[str, Any]) -> int:
    return int(stack.client.bulk(bulk["id"])["images"]["done"])


@pytest.mark.slow  # tests/workers/run/test_worker.py has the fast case
def test_a_job_of_a_killed_worker_is_done_once_by_another(
    stack: Stack, tmp_path: Path, psf_file: Path
) -> None:
    write_image(tmp_path / "large.fits", shape=(1024, 1024))
    image_id = stack.client.upload_image(tmp_path / "large.fits")["id"]
    psf_id = stack.client.upload_psf(psf_file)["id"]
    method = {"name": "richardson-lucy", "steps": 40}
    job = stack.client.submit("deconvolve", image_id=image_id, psf_id=psf_id, method=method)
    wait_for(lambda: stack.client.job(job["id"])["progress"]["step"] > 2, "the job is at work", 120)
    stack.kill_workers()  # a service that has started its worker starts another one
    assert stack.client.job(job["id"])["phase"] == "EXECUTING"
    if stack.redis is not None:
        stack.start_worker()
    ended = stack.client.wait(job, timeout_s=120)
    assert ended["attempt"] == 2
    assert [one["id"] for one in stack.client.products()] == [ended["result"].rpartition("/")[2]]
    stored = [path for path in (stack.data / "blobs").rglob("*") if path.is_file()]
    assert len(stored) == 5, "image, PSF, product, picture of the changes, thumbnail"


def test_a_bulk_run_goes_on_and_a_server_that_dies_takes_its_worker_along(
    stack: Stack, psf_file: Path
) -> None:
    earlier = {one["id"] for one in stack.client.products()}
    bulk = archive_run(stack, psf_file, output=str(stack.data.parent / "out"))
    wait_for(lambda: done(stack, bulk) >= 2, "some are done", timeout_s=120)
    before = {row.position: row.ended_at for row in items(stack) if row.state == "done"}
    if stack.redis is None:
        stack.kill_workers()
    else:
        stack.kill_everything()
        stack.start_server()
        stack.start_worker()
    end = stack.client.wait_for_bulk(bulk["id"])
    rows = items(stack)
    assert end["phase"] == "COMPLETED" and [row.error for row in rows if row.error] == []
    assert end["images"]["done"] == IMAGES
    assert {row.position: row.ended_at for row in rows if row.position in before} == before, "done stays done"
    assert sum(row.attempts for row in rows) <= IMAGES + AT_WORK, "the kill costs an attempt of those at work"
    products = {one["id"] for one in stack.client.products()} - earlier
    assert products == {row.product_id for row in rows} and len(products) == IMAGES
    written = {path.name for path in (stack.data.parent / "out").iterdir()}
    assert written == {Path(str(row.output)).name for row in rows}, "and nothing half-written"
    manifest = list(stack.client.bulk_results(bulk["id"]))
    assert [line["position"] for line in manifest] == list(range(IMAGES))

    if stack.redis is None:
        workers = stack.worker_processes()
        assert workers and stack.server is not None
        stack.server.kill()
        stack.server.wait()
        _, left = psutil.wait_procs(workers, timeout=30)
        assert left == []


# A worker on a busy machine, whose processes need long to load their libraries. Python imports this module when it
# starts. Celery waits 4 s for a process that replaces another one, unless it is told to wait longer.
SLOW_START = """
import time
from celery.signals import worker_process_init

@worker_process_init.connect(weak=False)
def load(**_):
    time.sleep(6.0)
"""


@pytest.mark.slow
def test_a_process_that_replaces_a_lost_one_and_starts_slowly_is_not_ended(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(SLOW_START)
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    with running(SERVED, tmp_path, {"PYTHONPATH": path}) as stack:
        catalogue = stack.catalogue()
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
    assert "Timed out waiting" not in (tmp_path / "workers.log").read_text("utf-8")


# --- an archive worked through ---------------------------------------------------------------------------


def test_the_command_line_from_submission_to_report(
    open_stack: Stack, psf_file: Path, tmp_path: Path
) -> None:
    name = f"run-{uuid.uuid4().hex[:8]}"
    archive = open_stack.data.parent / "archive" / name
    archive.mkdir()
    for number in range(2):
        write_image(archive / f"{number}.fits", shape=(96, 96), seed=number, WAVELNTH=174)
    (archive / "zz.fits").write_text("no FITS\n" * 500)

    def bulk(*arguments: str, status: int = 0) -> str:
        answer = CliRunner().invoke(main, ["bulk", *arguments, "--server", open_stack.client.server])
        assert answer.exit_code == status, answer.output
        return answer.output

    where = ["--where", "WAVELNTH=174", "--where", "XPOSURE>=1", "--where", "XPOSURE<3"]
    how = ("--psf", str(psf_file), *where, "--steps", "2", "--name", name, "--wait")
    said = bulk("submit", f"{archive}/*.fits", *how, status=1)  # an image failed
    bulk_id = said.split()[1]
    assert "COMPLETED: 2 of 3 done, 1 failed" in said
    assert f"{bulk_id[:12]}  COMPLETED" in bulk("list")
    manifest, failures = tmp_path / "m.csv", tmp_path / "f.ndjson"
    said = bulk("report", bulk_id, "-o", str(manifest), "--failures", str(failures), "--most", "1")
    assert said.count(f"/{name}/") == 2, "one image and one failure"
    assert "failed: " in said and "zz.fits: expected a FITS file" in said
    assert len(manifest.read_text().splitlines()) == 2 + 1
    assert json.loads(failures.read_text())["error"]["code"] == "not-fits"
    (archive / "zz.fits").unlink()
    write_image(archive / "zz.fits", shape=(96, 96), seed=99)
    bulk("retry", bulk_id)
    assert "COMPLETED: 3 of 3 done, 0 failed" in bulk("status", bulk_id, "--wait")


@pytest.mark.slow
def test_two_workers_share_a_bulk_run_and_a_persons_job_goes_first(tmp_path: Path, psf_file: Path) -> None:
    (tmp_path / "archive").mkdir()
    changes = {"HELIOPSF_BULK_ROOTS": str(tmp_path / "archive")}
    with running(SERVED, tmp_path, changes, workers=2) as stack:
        bulk = archive_run(stack, psf_file, steps=100)
        wait_for(lambda: done(stack, bulk) >= 2, "it is under way", timeout_s=120)
        write_image(tmp_path / "mine.fits")
        image_id = stack.client.upload_image(tmp_path / "mine.fits")["id"]
        psf_id = stack.client.upload_psf(psf_file)["id"]
        submitted_at = time.time()
        job = stack.client.wait(stack.client.submit("deconvolve", image_id=image_id, psf_id=psf_id))
        between = [
            row for row in items(stack) if row.taken_at and submitted_at < row.taken_at < job["started_at"]
        ]
        assert len(between) <= 1, (
            "the first worker to end an image takes the job; the other may begin one meanwhile"
        )
        assert stack.client.bulk(bulk["id"])["phase"] == "RUNNING"
        end = stack.client.wait_for_bulk(bulk["id"])
        assert end["images"]["done"] == IMAGES
        workers = {row.job_id for row in items(stack)}
        assert len(workers) == 2, "both had a turn"


# --- a little of `make chaos` ----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("redis_keeps", [False, True])
def test_nothing_is_lost_or_made_twice(redis_keeps: bool, capsys: pytest.CaptureFixture[str]) -> None:
    try:
        chaos.run(20, 5, 128, seed=3, redis_keeps=redis_keeps)
    except Missing as missing:
        pytest.skip(str(missing))
    found = dict(line.rsplit(maxsplit=1) for line in capsys.readouterr().out.splitlines()[1:])
    assert found["  jobs"] == found["  products"] == "20"
    assert sum(int(count) for name, count in found.items() if name.startswith("  kills of ")) == 5


@pytest.mark.slow
def test_a_cut_network_and_clocks_apart_lose_nothing_and_repeat_nothing() -> None:
    """In a process of its own, which moves to another network namespace."""
    needed = [name for name in ("ip", "unshare", "cc", "redis-server") if shutil.which(name) is None]
    if sys.platform != "linux" or os.geteuid() != 0 or needed:
        pytest.skip(f"needs Linux, root, and the commands {needed or 'ip, unshare, cc, redis-server'}")
    if subprocess.run(["unshare", "--net", "true"], capture_output=True).returncode:
        pytest.skip("this machine allows no network namespaces")
    options = ["--jobs", "15", "--faults", "4", "--cuts", "1", "--cut-s", "20"]
    done = subprocess.run(
        [sys.executable, "-m", "studies.chaos_network", *options],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
    )
    if "Missing" in done.stderr:
        pytest.skip(done.stderr.splitlines()[-1])
    assert done.returncode == 0, done.stderr[-3000:]
    assert "products             15" in done.stdout


# --- files in S3 -----------------------------------------------------------------------------------------


@pytest.mark.slow  # tests/workers/files runs store and collection on S3
def test_files_are_kept_in_s3_and_found_there_again(
    tmp_path: Path, psf_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_image(tmp_path / "image.fits")
    with s3_bucket(monkeypatch) as (url, server):
        monkeypatch.setenv("HELIOPSF_STORE_URL", url)
        with stacks.embedded(tmp_path) as stack:
            assert httpx.get(f"{stack.client.server}/readyz").json()["parts"]["object store"] == "ok"
            psf_id = stack.client.upload_psf(psf_file)["id"]
            product = stack.client.deconvolve(tmp_path / "image.fits", tmp_path / "out.fits", psf_id=psf_id)
            with fits.open(tmp_path / "out.fits", checksum=True) as hdus:
                assert hdus[0].header["PSFID"] == psf_id
            assert not (stack.data / "blobs").exists()
            shutil.rmtree(stack.data / "copies")  # as on another machine
            (stack.data / "copies").mkdir()
            stack.client.download(product["file"], tmp_path / "again.fits")
            assert (tmp_path / "again.fits").read_bytes() == (tmp_path / "out.fits").read_bytes()
            server.stop()
            shutil.rmtree(stack.data / "copies")
            (stack.data / "copies").mkdir()
            away = httpx.get(f"{stack.client.server}{product['file']}", timeout=60)
            assert (away.status_code, away.json()["type"]) == (503, "urn:heliopsf:storage-away")
            assert httpx.get(f"{stack.client.server}/readyz", timeout=60).status_code == 503


# --- SIGTERM to a server ---------------------------------------------------------------------------------


@pytest.mark.parametrize("stop_s", [0.5, 60.0])
def test_a_server_lets_requests_end_and_does_not_wait_for_those_that_do_not(
    tmp_path: Path, stop_s: float
) -> None:
    """With half an upload on the line: gone after stop_s; or, where the rest comes in time, after the answer. A request
    that waits for a job without end is answered at once."""
    with stacks.alone(tmp_path, {"HELIOPSF_STOP_S": str(stop_s)}) as stack:
        assert stack.server is not None
        url = stack.client.server
        build = {"KIND": "psf-build", "instrument_file": SMALL_INSTRUMENT, "size": "128"}
        job = httpx.post(f"{url}/uws/jobs", data=build, follow_redirects=True, timeout=60).url
        answers: list[httpx.Response] = []
        waiting = threading.Thread(
            target=lambda: answers.append(httpx.get(job, params={"WAIT": "-1"}, timeout=60))
        )
        port = int(url.rsplit(":", 1)[1])
        with socket.create_connection(("127.0.0.1", port)) as line:
            line.sendall(
                b"POST /v1/images HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 2880\r\n\r\nSIMPLE  ="
            )
            waiting.start()
            wait_for(lambda: any((stack.data / "tmp").iterdir()), "the upload is at work")
            time.sleep(1.0)  # until the request that waits is surely there
            stack.server.send_signal(signal.SIGTERM)
            wait_for(lambda: not listens(port), "it takes no more")
            if stop_s > 1:
                assert stack.server.poll() is None
                line.sendall(b" " * (2880 - len(b"SIMPLE  =")))
                assert line.recv(65536).startswith(b"HTTP/1.1 422"), "no good file, but a whole answer"
            assert stack.server.wait(30) == 0
        waiting.join()
        assert answers[0].status_code == 200 and b"PENDING" in answers[0].content
        assert list((stack.data / "tmp").iterdir()) == [], "half an upload is not left behind"


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0
