"""Measure how fast a bulk run deconvolves an archive with one and two workers, its overhead, and the cost of a kill.

    python -m benchmarks.bulk [--images 200] [--size 2048] [--steps 5]

Each worker has one thread and uses Redis and PostgreSQL. If this machine lacks them, the worker processes of a local
service are used. For comparison, one and two plain processes do the same work without a service. Other work on the
machine slows down the service and the plain processes equally.

The kernel time is the time that a worker needs to deconvolve the images and to measure the changes. The overhead is the
time of the worker without the kernel time (waiting for a file to be read, checked or written, hashes, database rows,
messages) divided by the kernel time. A worker reads the next image and writes the last product while it computes, so
this work slows the kernels down where all cores are busy: the CPU time per image shows it. The first image of each worker is left out, because the worker then loads its kernels and the PSF.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from astropy.io import fits

from benchmarks.figures import tell
from psfcore.build import build_psf
from psfcore.deconvolve.conditions import PreparedPsfs
from psfcore.deconvolve.run import deconvolve
from psfcore.deconvolve.whole import Options
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.observation import read_observation
from psfcore.fits.psfs import read_psf, write_psf
from psfcore.instruments.model import load_instrument
from psfcore.simulate.observe import demo_image
from tests.whole import stack as stacks
from tests.whole.stack import Missing, Stack, items, wait_for
from workers.settings import Settings

LIMITS = FitsLimits(max_pixels=2**24)
OVERHEAD = {1: "bulk, one worker: overhead", 2: "bulk, two workers: overhead"}
# The settings that an installation has. The tests shorten these intervals, which takes processor time from the images.
USUAL = {
    f"HELIOPSF_{name.upper()}": str(Settings.model_fields[name].default)
    for name in ("resubmit_s", "lease_s", "heartbeat_s", "reconcile_s")
}
MARK = b"BENCH   =              1000000"


def make_archive(folder: Path, images: int, size: int) -> Path:
    """Write images of one scene. Each image has its own value of one header card, so that no two files are equal.
    Returns the file of the PSF."""
    instrument = load_instrument("hri_euv")
    psf = build_psf(instrument, threads=os.cpu_count() or 1)
    write_psf(folder / "psf.fits", psf, instrument_file=b"")
    demo_image(folder / "one.fits", psf, size=size)
    fits.setval(folder / "one.fits", "BENCH", value=1_000_000)
    content = (folder / "one.fits").read_bytes()
    at = content.index(MARK) + len(MARK)
    (folder / "archive").mkdir()
    for number in range(images):
        changed = content[: at - 7] + str(1_000_001 + number).encode() + content[at:]
        (folder / "archive" / f"{number:04}.fits").write_bytes(changed)
    return folder / "psf.fits"


@contextmanager
def running(folder: Path, workers: int, archive: Path) -> Iterator[Stack]:
    """Run a service with `workers` workers of one thread each."""
    folder.mkdir()
    os.environ |= {
        "HELIOPSF_WORKER_THREADS": "1",
        "HELIOPSF_BULK_ROOTS": str(archive),
        "OMP_NUM_THREADS": "1",
    }
    with ExitStack() as resources:
        try:
            os.environ["HELIOPSF_WORKER_PROCESSES"] = "1"
            stack = resources.enter_context(stacks.served(folder, workers, USUAL))
        except Missing as missing:
            print(f"{missing}: using a local service with {workers} worker processes instead", flush=True)
            os.environ["HELIOPSF_WORKER_PROCESSES"] = str(workers)
            stack = resources.enter_context(stacks.embedded(folder))
        yield stack
    shutil.rmtree(folder)


def submit(stack: Stack, archive: Path, psf: Path, steps: int) -> dict[str, Any]:
    method = {"name": "richardson-lucy", "steps": steps}
    psf_id = stack.client.upload_psf(psf)["id"]
    return stack.client.submit_bulk(files=[f"{archive}/*.fits"], psf_id=psf_id, method=method)


def by_worker(rows: Sequence[Any]) -> list[list[Any]]:
    """The images of each turn, in the order in which the turn took them."""
    found: dict[str, list[Any]] = {}
    for row in sorted(rows, key=lambda row: row.taken_at):
        found.setdefault(row.job_id, []).append(row)
    return list(found.values())


def pace(rows: Sequence[Any]) -> float:
    """Images per second, counted from the time when every worker had finished its first image."""
    warm = max(of_worker[0].ended_at for of_worker in by_worker(rows))
    done = [row.ended_at for row in rows if row.ended_at > warm]
    return len(done) / (max(done) - warm)


def overhead(rows: Sequence[Any]) -> float:
    """The overhead of the workers, divided by the kernel time."""
    span = kernel = 0.0
    for of_worker in by_worker(rows):
        for before, row in pairwise(of_worker):
            span += row.ended_at - before.ended_at
            kernel += row.statistics["kernel_seconds"]
    return (span - kernel) / kernel


def cpu_s(stack: Stack) -> float:
    """The CPU time that all worker processes have used, in seconds."""
    times = [process.cpu_times() for process in stack.worker_processes()]
    return sum(one.user + one.system for one in times)


def worked_through(folder: Path, workers: int, archive: Path, psf: Path, steps: int) -> tuple[float, float]:
    """Images per second that the service deconvolves, and the overhead divided by the kernel time."""
    with running(folder, workers, archive) as stack:
        bulk = submit(stack, archive, psf, steps)
        wait_for(lambda: stack.client.bulk(bulk["id"])["images"]["done"] >= workers, "some are done", 3600.0)
        warm, warm_s = stack.client.bulk(bulk["id"])["images"]["done"], cpu_s(stack)
        end = stack.client.wait_for_bulk(bulk["id"])
        of_one_s = (cpu_s(stack) - warm_s) / max(1, end["images"]["done"] - warm)
        assert end["images"]["done"] == end["images"]["total"] > 0, end
        rows = items(stack)
    found = pace(rows)
    print(
        f"{workers} worker{'s' if workers > 1 else ' '}: {3600 * found:8.0f} images per hour, {1 / found:6.2f} s per image; "
        f"overhead {100 * overhead(rows):.1f} % of the kernel time; CPU time {of_one_s:.2f} s per image",
        flush=True,
    )
    return found, overhead(rows)


def bare(archive: Path, psf: Path, steps: int, processes: int, images: int) -> float:
    """Images per second that `processes` plain processes deconvolve without a service.

    Every process takes the same files.
    """
    command = [
        sys.executable,
        "-m",
        "benchmarks.bulk",
        "--bare",
        str(archive),
        str(psf),
        str(steps),
        str(images),
    ]
    started = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(processes)]
    times = [float(process.communicate()[0].split()[-1]) for process in started]
    return sum(images / took for took in times)


def bare_process(archive: str, psf_file: str, steps: int, images: int) -> None:
    """Do the part of a worker's task that psfcore does: read an image, deconvolve it and measure the changes."""
    psf = read_psf(psf_file, LIMITS, parts=False)
    prepared = PreparedPsfs()
    options = Options(parameters={"steps": steps}, engine_for=prepared.engine_for)
    paths = sorted(Path(archive).iterdir())[: images + 1]
    started = 0.0
    for number, path in enumerate(paths):
        if number == 1:  # for image 0, the process loads its kernels and the PSF
            started = time.perf_counter()
        image = read_observation(path, LIMITS)
        fitted = prepared.on_pixels_of(image.header, psf_file, lambda: psf)
        product = deconvolve(image, fitted, options, warnings={})
        assert product.assessed.quality.shape == image.pixels.shape
    print(time.perf_counter() - started)


def killed(folder: Path, archive: Path, psf: Path, steps: int) -> None:
    """Kill the server and all workers twice during a run. No finished image may be deconvolved again."""
    with running(folder, 2, archive) as stack:
        bulk = submit(stack, archive, psf, steps)
        images, own_workers = len(list(archive.iterdir())), len(stack.workers)
        kept: dict[int, float] = {}
        for part in (1, 2):
            wait_for(
                lambda part=part: stack.client.bulk(bulk["id"])["images"]["done"] >= part * images // 3,  # type: ignore[misc]
                "some are done",
                timeout_s=3600.0,
            )
            kept |= {row.position: row.ended_at for row in items(stack) if row.state == "done"}
            stack.kill_everything()
            stack.start_server()
            stack.workers.clear()
            for _ in range(own_workers):
                stack.start_worker()
        stack.client.wait_for_bulk(bulk["id"])
        rows = items(stack)
        begun = sum(row.attempts for row in rows)
        again = [row for row in rows if row.position in kept and row.ended_at != kept[row.position]]
        products = len(list(stack.client.products()))
    assert not again and products == len(rows) == images
    print(
        f"workers and server killed twice: {images} images, {products} products; no finished image was deconvolved again, "
        f"{begun - images} unfinished images were started again",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--images", type=int, default=200)
    parser.add_argument("--size", type=int, default=2048)
    parser.add_argument("--steps", type=int, default=5)
    parser.add_argument("--bare", nargs=4, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.bare:
        archive, psf, steps, images = asked.bare
        bare_process(archive, psf, int(steps), int(images))
        return
    with TemporaryDirectory(prefix="heliopsf-bench-") as temporary:
        folder = Path(temporary)
        psf = make_archive(folder, asked.images, asked.size)
        archive = folder / "archive"
        print(f"{asked.images} images of {asked.size} px, {asked.steps} steps", flush=True)
        few = max(2, min(asked.images // 4, 20))
        alone, together = (bare(archive, psf, asked.steps, processes, few) for processes in (1, 2))
        print(
            f"plain processes: {1 / alone:.2f} s per image; two processes are {together / alone:.2f} times as fast as one",
            flush=True,
        )
        found = {
            workers: worked_through(folder / f"by-{workers}", workers, archive, psf, asked.steps)
            for workers in (1, 2)
        }
        (one, _), (two, _) = found.values()
        for workers, (_, share) in found.items():
            tell(OVERHEAD[workers], 100 * share)
        print(
            f"two workers are {two / one:.2f} times as fast as one, and process {100 * two / together:.0f} % as many images "
            "as two plain processes, which neither hash files nor write products",
            flush=True,
        )
        tell("bulk: gain of two workers / of two plain processes", 100 * (two / one) / (together / alone))
        for path in sorted(archive.iterdir())[max(12, asked.images // 4) :]:
            path.unlink()
        killed(folder / "killed", archive, psf, asked.steps)


if __name__ == "__main__":
    main()
