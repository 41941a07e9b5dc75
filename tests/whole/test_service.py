"""The service as processes: embedded, and on Redis and PostgreSQL; with a worker that is killed."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import psutil
import pytest
from astropy.io import fits

from service.client.http import ServiceError
from tests.conftest import write_image
from tests.whole import stack as stacks
from tests.whole.stack import EMBEDDED_FIRST, Missing, Stack, wait_for


def running(mode: str, folder: Path, resources: ExitStack) -> Stack:
    try:
        return resources.enter_context(stacks.MODES[mode](folder))
    except Missing as missing:
        pytest.skip(str(missing))


@pytest.fixture
def stack(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Stack]:
    """One of the test's own, to kill things in."""
    with ExitStack() as resources:
        yield running(request.param, tmp_path, resources)


@pytest.fixture(scope="module")
def living(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stack]:
    """One that is shared, so that its products may be of other tests too."""
    with ExitStack() as resources:
        yield running(request.param, tmp_path_factory.mktemp("stack"), resources)


def big_image(path: Path) -> Path:
    """An image whose deconvolution takes some seconds, so that something can happen meanwhile."""
    write_image(path, shape=(1024, 1024))
    return path


@pytest.mark.parametrize("living", EMBEDDED_FIRST, indirect=True)
def test_an_image_in_and_a_product_out(living: Stack, tmp_path: Path, psf_file: Path) -> None:
    write_image(tmp_path / "image.fits")
    psf_id = living.client.upload_psf(psf_file)["id"]
    output, picture = tmp_path / "out.fits", tmp_path / "out.png"
    product = living.client.deconvolve(tmp_path / "image.fits", output, psf_id=psf_id, preview=picture)
    with fits.open(output, checksum=True) as hdus:
        assert hdus[0].header["PSFID"] == psf_id
    assert picture.read_bytes().startswith(b"\x89PNG")
    again = living.client.deconvolve(tmp_path / "image.fits", psf_id=psf_id)
    assert again == product
    assert [p["id"] for p in living.client.products()].count(product["id"]) == 1


@pytest.mark.parametrize("stack", EMBEDDED_FIRST, indirect=True)
def test_a_killed_worker_loses_nothing_and_nothing_is_done_twice(
    stack: Stack, tmp_path: Path, psf_file: Path
) -> None:
    image_id = stack.client.upload_image(big_image(tmp_path / "image.fits"))["id"]
    psf_id = stack.client.upload_psf(psf_file)["id"]
    method = {"name": "richardson-lucy", "steps": 100}
    job = stack.client.submit("deconvolve", image_id=image_id, psf_id=psf_id, method=method)
    wait_for(lambda: stack.client.job(job["id"])["progress"]["step"] > 5, "the job is at work")
    stack.kill_workers()
    assert stack.client.job(job["id"])["phase"] == "EXECUTING"
    if stack.workers:
        stack.start_worker()  # the embedded one is started again by the service itself
    done = stack.client.wait(job, timeout_s=120)
    assert done["attempt"] == 2
    assert len(list(stack.client.products())) == 1
    blobs = [p for p in (stack.data / "blobs").rglob("*") if p.is_file()]
    assert len(blobs) == 5, "image, PSF, product, picture of the changes, thumbnail"


@pytest.mark.parametrize("living", EMBEDDED_FIRST, indirect=True)
def test_cancel_at_work(living: Stack, tmp_path: Path, psf_file: Path) -> None:
    before = list(living.client.products())
    image_id = living.client.upload_image(big_image(tmp_path / "image.fits"))["id"]
    psf_id = living.client.upload_psf(psf_file)["id"]
    method = {"name": "richardson-lucy", "steps": 200}
    job = living.client.submit("deconvolve", image_id=image_id, psf_id=psf_id, method=method)
    wait_for(lambda: living.client.job(job["id"])["progress"]["step"] > 2, "the job is at work")
    living.client.cancel(job["id"])
    with pytest.raises(ServiceError, match="cancelled"):
        living.client.wait(job, timeout_s=30)
    ended = living.client.job(job["id"])
    assert ended["phase"] == "ABORTED" and ended["progress"]["step"] < 200
    assert list(living.client.products()) == before


@pytest.mark.slow
@pytest.mark.parametrize("stack", EMBEDDED_FIRST, indirect=True)
def test_what_was_queued_while_everything_was_down_is_done(
    stack: Stack, tmp_path: Path, psf_file: Path
) -> None:
    psf_id = stack.client.upload_psf(psf_file)["id"]
    ids = []
    for seed in range(3):
        write_image(tmp_path / f"{seed}.fits", seed=seed)
        ids.append(stack.client.upload_image(tmp_path / f"{seed}.fits")["id"])
    jobs = [stack.client.submit("deconvolve", image_id=i, psf_id=psf_id) for i in ids]
    own_workers = bool(stack.workers)
    stack.kill_workers()
    assert stack.server is not None
    for process in psutil.Process(stack.server.pid).children(recursive=True):
        process.kill()
    stack.server.kill()
    stack.server.wait()
    stack.start_server()
    if own_workers:
        stack.workers.clear()
        stack.start_worker()
    for job in jobs:
        assert stack.client.wait(stack.client.job(job["id"]), timeout_s=120)["phase"] == "COMPLETED"
    assert len(list(stack.client.products())) == 3


@pytest.mark.slow  # tests/workers/catalogue has the fast cases of lost messages
def test_a_broker_killed_at_work_costs_nothing(tmp_path: Path, psf_file: Path) -> None:
    """The running job ends, the worker lives on, and what was queued meanwhile is done once Redis is back."""
    with ExitStack() as resources:
        try:
            stack = resources.enter_context(stacks.served(tmp_path))
        except Missing as missing:
            pytest.skip(str(missing))
        assert stack.redis is not None
        image_id = stack.client.upload_image(big_image(tmp_path / "image.fits"))["id"]
        psf_id = stack.client.upload_psf(psf_file)["id"]
        many, few = ({"name": "richardson-lucy", "steps": n} for n in (100, 3))
        running = stack.client.submit("deconvolve", image_id=image_id, psf_id=psf_id, method=many)
        wait_for(lambda: stack.client.job(running["id"])["progress"]["step"] > 2, "the job is at work")
        stack.redis.kill()
        meanwhile = stack.client.submit("deconvolve", image_id=image_id, psf_id=psf_id, method=few)
        assert stack.client.wait(running, timeout_s=90)["attempt"] == 1
        stack.redis.start()
        assert stack.client.wait(meanwhile, timeout_s=120)["attempt"] == 1
        assert stack.workers[0].poll() is None


def test_a_server_that_dies_takes_its_worker_along(tmp_path: Path) -> None:
    with stacks.embedded(tmp_path) as stack:
        wait_for(lambda: len(stack.worker_processes()) > 1, "the worker is up")
        workers = stack.worker_processes()
        assert stack.server is not None
        stack.server.kill()
        stack.server.wait()
        _, left = psutil.wait_procs(workers, timeout=30)
        assert left == []


@pytest.mark.slow
@pytest.mark.parametrize("living", ["embedded"], indirect=True)
def test_the_command_line_over_http_and_local_agree(living: Stack, tmp_path: Path, psf_file: Path) -> None:
    write_image(tmp_path / "image.fits", seed=7)
    files = {"over-http": tmp_path / "h.fits", "local": tmp_path / "l.fits"}
    base = [
        sys.executable,
        "-m",
        "service.cli",
        "deconvolve",
        str(tmp_path / "image.fits"),
        "--psf",
        str(psf_file),
    ]
    over_http = [*base, "-o", str(files["over-http"]), "--server", living.client.server]
    subprocess.run(over_http, check=True)
    subprocess.run([*base, "-o", str(files["local"]), "--local"], check=True)
    assert files["over-http"].read_bytes() == files["local"].read_bytes()


def test_the_command_line_says_what_is_wrong_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "letter.fits").write_text("Dear editor,\n" * 300)
    command = [
        sys.executable,
        "-m",
        "service.cli",
        "deconvolve",
        str(tmp_path / "letter.fits"),
        "--local",
        "-o",
    ]
    answer = subprocess.run([*command, str(tmp_path / "o.fits")], capture_output=True, text=True)
    assert answer.returncode == 1
    assert "expected" in answer.stderr and "Traceback" not in answer.stderr
    assert not (tmp_path / "o.fits").exists()
    nobody = [
        *command[:-2],
        "--server",
        f"http://127.0.0.1:{stacks.free_port()}",
        "-o",
        str(tmp_path / "o.fits"),
    ]
    answer = subprocess.run(nobody, capture_output=True, text=True)
    assert answer.returncode == 1 and "heliopsf serve" in answer.stderr
