"""The quantities against which time and memory are measured."""

from __future__ import annotations

import json
import os
import random
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.figures import tell
from psfcore.deconvolve.memory import Demand, deconvolution_bytes
from workers.machine import free_bytes

QUESTION_ROUNDS = 40
BULK_IMAGES, BULK_PX, BULK_STEPS = 12, 1024, 20


@dataclass(frozen=True)
class Point:
    """A measurement: the quantity, the time (s), and the memory (MiB) if it was measured. more: further numbers."""

    n: float
    seconds: float
    mib: float | None
    more: dict[str, float]


@dataclass(frozen=True)
class Axis:
    """A quantity. label: its name with its unit. what: what is measured. points(quick, most): measures the points up to
    `most`; quick: fewer and smaller ones."""

    label: str
    what: str
    points: Callable[[bool, float], Iterator[Point]]


def _one(**case: Any) -> dict[str, Any]:
    command = [sys.executable, "-m", "benchmarks.growth.one", json.dumps(case)]
    # Freed arrays return to the system at once; otherwise the process would use them again, and the peak would be too low.
    environment = os.environ | {"MALLOC_MMAP_THRESHOLD_": "65536"}
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=environment)
    return dict(json.loads(done.stdout))


def _deconvolved(n: float, **case: Any) -> Point:
    found = _one(**case)
    besides = (found["peak_bytes"] - found["output_bytes"]) / found["padded_px"]
    more = {
        "bytes_a_padded_px": besides,
        "estimate_mib": found["estimate_bytes"] / 2**20,
        "process_gib": found["process_bytes"] / 2**30,
    }
    return Point(n, found["seconds"], found["peak_bytes"] / 2**20, more)


def _upto(most: float, values: tuple[int, ...]) -> list[int]:
    return [value for value in values if value <= most]


def image_size(quick: bool, most: float) -> Iterator[Point]:
    """Images of 256 to 8192 px. The largest one is left out if it does not fit into the free memory."""
    for size in _upto(most, (256, 512, 1024, 2048) if quick else (256, 512, 1024, 2048, 4096, 8192)):
        needed = deconvolution_bytes(Demand("richardson-lucy", (size, size), (2048, 2048)))
        if needed > free_bytes():
            print(f"left out: {size} px need {needed / 2**20:.0f} MiB, more than the free memory")
            continue
        point = _deconvolved(size, size=size, repeats=3 if size < 4096 else 1)
        if size == 2048:
            tell("memory for a pixel of the padded plane, 2048 px", point.more["bytes_a_padded_px"])
            tell("20 steps, 2048 px: memory of the process", point.more["process_gib"])
        yield point


def psf_size(quick: bool, most: float) -> Iterator[Point]:
    """PSFs of 64 to 2048 px, for an image of 1024 px."""
    for size in _upto(most, (64, 512, 2048) if quick else (64, 128, 256, 512, 1024, 2048)):
        yield _deconvolved(size, size=1024, psf=size, repeats=3)


def steps(quick: bool, most: float) -> Iterator[Point]:
    """5 to 160 steps, for an image of 1024 px."""
    for number in _upto(most, (5, 20) if quick else (5, 10, 20, 40, 80, 160)):
        yield _deconvolved(number, size=1024, steps=number, repeats=3 if number < 80 else 1)


def transit_images(quick: bool, most: float) -> Iterator[Point]:
    """Transits of 10 to 500 images of 128 px."""
    for number in _upto(most, (10, 30) if quick else (10, 30, 100, 200, 500)):
        found = _one(images=number, size=128)
        yield Point(number, found["seconds"], found["peak_bytes"] / 2**20, {})


def catalogue_rows(quick: bool, most: float) -> Iterator[Point]:
    """A catalogue of 1e3 to 1e6 products in SQLite: the median time of a list or look-up, and the size of its file."""
    from tests.whole.many_rows import QUESTIONS, Size, fill
    from workers.catalogue.catalogue import Catalogue

    for rows in _upto(most, (1_000, 10_000) if quick else (1_000, 10_000, 100_000, 1_000_000)):
        with TemporaryDirectory(prefix="heliopsf-growth-") as folder:
            file = Path(folder) / "catalogue.sqlite"
            url = f"sqlite:///{file}"
            catalogue = Catalogue(url)
            catalogue.upgrade()
            archive = fill(catalogue, url, Size(psfs=max(100, rows // 10), products=rows))
            took = []
            for number in range(-3, QUESTION_ROUNDS):  # the first ones fill caches
                for ask in QUESTIONS.values():
                    started = time.perf_counter()
                    ask(archive, random.Random(number))
                    if number >= 0:
                        took.append(time.perf_counter() - started)
            catalogue.close()
            slow = statistics.quantiles(took, n=100)[98]
            yield Point(rows, statistics.median(took), file.stat().st_size / 2**20, {"p99_seconds": slow})


def workers(quick: bool, most: float) -> Iterator[Point]:
    """One and two workers of one thread each: the time for an image of a bulk run."""
    from benchmarks.bulk import make_archive, worked_through

    images = 4 if quick else BULK_IMAGES
    with TemporaryDirectory(prefix="heliopsf-growth-") as temporary:
        folder = Path(temporary)
        psf = make_archive(folder, images, BULK_PX)
        for number in _upto(most, (1, 2)):
            pace, _ = worked_through(folder / f"by-{number}", number, folder / "archive", psf, BULK_STEPS)
            yield Point(number, 1 / pace, None, {"images_an_hour": 3600 * pace})


AXES = {
    "image": Axis("size of the image (px)", "20 steps of Richardson-Lucy, PSF of 2048 px", image_size),
    "psf": Axis("size of the PSF (px)", "20 steps of Richardson-Lucy, image of 1024 px", psf_size),
    "steps": Axis("steps", "Richardson-Lucy, image of 1024 px, PSF of 2048 px", steps),
    "transit": Axis("images in a transit", "fit of the scatter, images of 128 px", transit_images),
    "catalogue": Axis("products in the catalogue", "a list or look-up in SQLite (median)", catalogue_rows),
    "workers": Axis("workers of one thread", f"an image of {BULK_PX} px in a bulk run", workers),
}
