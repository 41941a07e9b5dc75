"""How fast a bulk run deconvolves an archive with one and two workers, and what the service adds to plain processes.

    python -m benchmarks.bulk [--images 200] [--size 2048] [--steps 5]

Each worker has one thread and uses Redis and PostgreSQL. For comparison, one and two plain processes do the same work
without a service. Other work on the machine slows down the service and the plain processes equally.

The kernel time is the time that a worker needs to deconvolve the images and to measure the changes. The overhead is the
time of the worker without the kernel time (waiting for a file to be read, checked or written, hashes, database rows,
messages) divided by the kernel time. A worker reads the next image and writes the last product while it computes, so
this work slows the kernels down where all cores are busy. The first image of each worker is left out, because the
worker then loads its kernels and the PSF.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from astropy.io import fits

from benchmarks.figures import tell
from psfcore.build import build_psf
from psfcore.deconvolve.conditions import PreparedPsfs
from psfcore.deconvolve.run import deconvolve
from psfcore.deconvolve.work import Options
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.observation import read_observation
from psfcore.fits.psfs import read_psf, write_psf
from psfcore.instruments.model import load_instrument
from psfcore.simulate.scene import demo_image
from tests.whole.stack import items, served
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
    psf = build_psf(load_instrument("hri_euv"))
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
    pairs = [pair for of_worker in by_worker(rows) for pair in pairwise(of_worker)]
    span = sum(row.ended_at - before.ended_at for before, row in pairs)
    kernel = sum(row.statistics["kernel_seconds"] for _, row in pairs)
    return float((span - kernel) / kernel)


def worked_through(folder: Path, workers: int, archive: Path, psf: Path, steps: int) -> tuple[float, float]:
    """Images per second that the service deconvolves, and the overhead divided by the kernel time. Raises Missing."""
    folder.mkdir()
    changes = {"HELIOPSF_WORKER_THREADS": "1", "HELIOPSF_WORKER_PROCESSES": "1", "OMP_NUM_THREADS": "1"}
    changes |= {"HELIOPSF_BULK_ROOTS": str(archive)} | USUAL
    with served(folder, workers, changes) as stack:
        psf_id = stack.client.upload_psf(psf)["id"]
        method = {"name": "richardson-lucy", "steps": steps}
        bulk = stack.client.submit_bulk(files=[f"{archive}/*.fits"], psf_id=psf_id, method=method)
        end = stack.client.wait_for_bulk(bulk["id"])
        assert end["images"]["done"] == end["images"]["total"] > 0, end
        rows = items(stack)
    print(
        f"{workers} of the service: {3600 * pace(rows):8.0f} images per hour, {1 / pace(rows):6.2f} s per image; "
        f"overhead {100 * overhead(rows):.1f} % of the kernel time",
        flush=True,
    )
    return pace(rows), overhead(rows)


def plain(archive: Path, psf: Path, steps: int, processes: int, images: int) -> float:
    """Images per second that plain processes deconvolve without a service. Every process takes the same files."""
    words = ["--plain", str(archive), str(psf), str(steps), str(images)]
    command = [sys.executable, "-m", "benchmarks.bulk", *words]
    started = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(processes)]
    found = sum(images / float(process.communicate()[0].split()[-1]) for process in started)
    print(f"{processes} plain: {3600 * found:8.0f} images per hour, {1 / found:6.2f} s per image", flush=True)
    return found


def plain_process(archive: str, psf_file: str, steps: int, images: int) -> None:
    """Do the part of a worker's task that psfcore does: read an image, deconvolve it and measure the changes."""
    psf = read_psf(psf_file, LIMITS, parts=False)
    prepared = PreparedPsfs()
    options = Options(parameters={"steps": steps}, engine_for=prepared.engine_for)
    started = 0.0
    for number, path in enumerate(sorted(Path(archive).iterdir())[: images + 1]):
        if number == 1:  # for image 0, the process loads its kernels and the PSF
            started = time.perf_counter()
        image = read_observation(path, LIMITS)
        fitted = prepared.on_pixels_of(image.header, psf_file, lambda: psf)
        product = deconvolve(image, fitted, options, warnings={})
        assert product.assessed.quality.shape == image.pixels.shape
    print(time.perf_counter() - started)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=int, default=200)
    parser.add_argument("--size", type=int, default=2048)
    parser.add_argument("--steps", type=int, default=5)
    parser.add_argument("--plain", nargs=4, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    if chosen.plain:
        archive, psf_file, steps, images = chosen.plain
        plain_process(archive, psf_file, int(steps), int(images))
        return
    with TemporaryDirectory(prefix="heliopsf-bench-") as temporary:
        folder = Path(temporary)
        psf = make_archive(folder, chosen.images, chosen.size)
        few = max(2, min(chosen.images // 4, 20))
        alone, together = (plain(folder / "archive", psf, chosen.steps, number, few) for number in (1, 2))
        paces = []
        for workers, name in OVERHEAD.items():
            found, share = worked_through(
                folder / str(workers), workers, folder / "archive", psf, chosen.steps
            )
            paces.append(found)
            tell(name, 100 * share)
        gain = (paces[1] / paces[0]) / (together / alone)
        tell("bulk: gain of two workers / of two plain processes", 100 * gain)


if __name__ == "__main__":
    main()
