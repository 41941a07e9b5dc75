"""How time and memory grow with the size of the work; `docs/speed.md` shows the figures.

    python -m benchmarks.growth [NAME ...] [--most N] [--quick] [--write]
    python -m benchmarks.growth memory
    python -m benchmarks.growth figures

NAME: image, psf, steps, transit, catalogue or workers; default: all, about ten minutes on two cores. --quick measures
fewer and smaller points. --most leaves out the points above N. --write replaces the measured numbers in
docs/growth/measured.json and their figures; without it, the numbers are only printed. Exponents are fitted to the three
largest points. memory: the peak of every method at 2048 and 4096 px beside its estimate. figures: draw the figures
again from the table.

Times are the shortest of several runs. They are also printed as ratios to 1 F (see benchmarks/timing.py), which is
measured before every axis: other work on the machine slows both. Each point is measured in a process of its own.
"""

from __future__ import annotations

import argparse
import gc
import io
import json
import math
import os
import random
import re
import statistics
import time
import warnings
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

import heliopsf
from benchmarks.bulk import make_archive, worked_through
from benchmarks.figures import kind_of_machine, tell
from benchmarks.timing import THREADS, answer_of, memory_bytes, reference, seconds
from psfcore.deconvolve.memory import Demand, deconvolution_bytes
from psfcore.deconvolve.methods.registry import method_names
from psfcore.psf import central_part
from psfcore.scatter.fit import fit_transit
from psfcore.simulate.plan import default_plan
from psfcore.simulate.transit import simulate
from tests.transit_files import drawn_truth, hri_diffraction
from tests.whole.many_rows import QUESTIONS, Size, fill
from workers.catalogue.catalogue import Catalogue
from workers.machine import free_bytes

MIB = 2**20
FOLDER = Path(__file__).parents[1] / "docs" / "growth"
TABLE = FOLDER / "measured.json"
FITTED_POINTS = 3  # the exponent is that of the largest points: constant terms hide the growth of small ones
QUESTION_ROUNDS = 40
BULK_IMAGES, BULK_PX, BULK_STEPS = 12, 1024, 20
TIME, MEMORY = "#123a7a", "#d5642f"


@dataclass(frozen=True)
class Point:
    """A measurement: the quantity, the time (s), and the memory (MiB) if it was measured. more: further numbers."""

    n: float
    seconds: float
    mib: float | None
    more: dict[str, float] = field(default_factory=dict)


def peak_of(work: Callable[[], object]) -> tuple[float, int, int]:
    """The time of a call, s; the peak memory of this process meanwhile, and how much it had before, bytes."""
    gc.collect()
    before = memory_bytes("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    took = seconds(work)
    return took, memory_bytes("VmHWM"), before


def deconvolution(case: dict[str, Any]) -> Point:
    """The time of a deconvolution (shortest of `repeats`), and its peak memory besides the image and the PSF.

    More: bytes for each pixel of the transforms, without the result; the estimate of the peak; the peak of the whole
    process, with Python, its libraries, the image and the PSF.
    """
    method, steps, size = case.get("method", "richardson-lucy"), case.get("steps", 20), case["size"]
    psf = heliopsf.build_psf("hri_euv")
    if "psf" in case:
        psf = heliopsf.Psf.of(central_part(psf, case["psf"]))
    work = Demand(method, (size, size), (psf.kernel.shape[0], psf.kernel.shape[1]))
    pixels = np.random.default_rng(0).gamma(2.0, 400.0, (size, size))

    def deconvolve(part: Any, iterations: int) -> Any:
        return heliopsf.deconvolve(part, psf, iterations=iterations, method=method, threads=THREADS)

    deconvolve(pixels[:256, :256].copy(), 2)  # compiles
    took, highest, before = peak_of(lambda: deconvolve(pixels, steps))
    again = [seconds(lambda: deconvolve(pixels, steps)) for _ in range(case.get("repeats", 1) - 1)]
    inputs = 8 * (pixels.size + psf.kernel.size)
    more = {
        "bytes_a_padded_px": (highest - before - 8 * pixels.size) / math.prod(work.transform),
        "estimate_mib": (deconvolution_bytes(work) - inputs) / MIB,
        "process_gib": highest / 2**30,
    }
    return Point(case["n"], min([took, *again]), (highest - before) / MIB, more)


def fit(case: dict[str, Any]) -> Point:
    """The time of a fit to a simulated transit, and its peak memory besides the images."""
    size, truth = case["size"], drawn_truth(1)
    fit_transit(simulate(default_plan(9, 128), truth, hri_diffraction(256), 1).transit)  # compiles
    plan = default_plan(case["n"], size)
    transit = simulate(plan, truth, hri_diffraction(2 * size), 1, threads=THREADS).transit
    took, highest, before = peak_of(lambda: fit_transit(transit, threads=THREADS))
    return Point(case["n"], took, (highest - before) / MIB)


def measured(kind: str, n: float, **case: Any) -> Point:
    """The point of a case, measured in a process of its own."""
    # Freed arrays return to the system at once; otherwise the process would use them again, and the peak would be too
    # low.
    words = ("--one", kind, json.dumps({"n": n} | case))
    return Point(**answer_of("benchmarks.growth", *words, MALLOC_MMAP_THRESHOLD_="65536"))


def image_size(values: list[int]) -> Iterator[Point]:
    """Images, with the PSF of 2048 px. One that does not fit into the free memory is left out."""
    for size in values:
        needed = deconvolution_bytes(Demand("richardson-lucy", (size, size), (2048, 2048)))
        if needed > free_bytes():
            print(f"left out: {size} px need {needed / MIB:.0f} MiB, more than the free memory")
            continue
        point = measured("deconvolution", size, size=size, repeats=3 if size < 4096 else 1)
        if size == 2048:
            tell("memory for a pixel of the padded plane, 2048 px", point.more["bytes_a_padded_px"])
            tell("20 steps, 2048 px: memory of the process", point.more["process_gib"])
        yield point


def psf_size(values: list[int]) -> Iterator[Point]:
    """PSFs, for an image of 1024 px."""
    for size in values:
        yield measured("deconvolution", size, size=1024, psf=size, repeats=3)


def steps(values: list[int]) -> Iterator[Point]:
    """Steps, for an image of 1024 px."""
    for number in values:
        yield measured("deconvolution", number, size=1024, steps=number, repeats=3 if number < 80 else 1)


def transit_images(values: list[int]) -> Iterator[Point]:
    """Transits of images of 128 px."""
    for number in values:
        yield measured("fit", number, size=128)


def catalogue_rows(values: list[int]) -> Iterator[Point]:
    """A catalogue of products in SQLite: the median time of a list or look-up, and the size of its file."""
    for rows in values:
        with TemporaryDirectory(prefix="heliopsf-growth-") as folder:
            file = Path(folder) / "catalogue.sqlite"
            catalogue = Catalogue(f"sqlite:///{file}")
            catalogue.upgrade()
            archive = fill(catalogue, f"sqlite:///{file}", Size(psfs=max(100, rows // 10), products=rows))
            took = []
            for number in range(-3, QUESTION_ROUNDS):  # the first ones fill caches
                for ask in QUESTIONS.values():
                    took_s = seconds(partial(ask, archive, random.Random(number)))
                    took += [took_s] if number >= 0 else []
            catalogue.close()
            slow = statistics.quantiles(took, n=100)[98]
            yield Point(rows, statistics.median(took), file.stat().st_size / MIB, {"p99_seconds": slow})


def workers(values: list[int]) -> Iterator[Point]:
    """Workers of one thread each: the time for an image of a bulk run."""
    with TemporaryDirectory(prefix="heliopsf-growth-") as temporary:
        folder = Path(temporary)
        psf = make_archive(folder, BULK_IMAGES, BULK_PX)
        for number in values:
            pace, _ = worked_through(folder / f"by-{number}", number, folder / "archive", psf, BULK_STEPS)
            yield Point(number, 1 / pace, None, {"images_an_hour": 3600 * pace})


@dataclass(frozen=True)
class Axis:
    """A quantity. label: its name with its unit. what: what is measured. values, quick: the points, and fewer and
    smaller ones."""

    label: str
    what: str
    points: Callable[[list[int]], Iterator[Point]]
    values: tuple[int, ...]
    quick: tuple[int, ...]
    memory: str = "peak memory (MiB)"


SIZES = (256, 512, 1024, 2048, 4096, 8192)
AXES = {
    "image": Axis(
        "size of the image (px)", "20 steps of Richardson-Lucy, PSF of 2048 px", image_size, SIZES, SIZES[:4]
    ),
    "psf": Axis(
        "size of the PSF (px)",
        "20 steps of Richardson-Lucy, image of 1024 px",
        psf_size,
        (64, 128, 256, 512, 1024, 2048),
        (64, 512, 2048),
    ),
    "steps": Axis(
        "steps", "Richardson-Lucy, image of 1024 px, PSF of 2048 px", steps, (5, 10, 20, 40, 80, 160), (5, 20)
    ),
    "transit": Axis(
        "images in a transit",
        "fit of the scatter, images of 128 px",
        transit_images,
        (10, 30, 100, 200, 500),
        (10, 30),
    ),
    "catalogue": Axis(
        "products in the catalogue",
        "a list or look-up in SQLite (median)",
        catalogue_rows,
        (1_000, 10_000, 100_000, 1_000_000),
        (1_000, 10_000),
        "size of the file (MiB)",
    ),
    "workers": Axis(
        "workers of one thread", f"an image of {BULK_PX} px in a bulk run", workers, (1, 2), (1, 2)
    ),
}


def exponent(n: list[float], values: list[float]) -> float | None:
    """p of values ~ n ** p, by least squares in logarithms through the last points; None for fewer than two points."""
    if len(n) < 2:
        return None
    last = slice(-FITTED_POINTS, None)
    return float(np.polyfit(np.log(n[last]), np.log(values[last]), 1)[0])


def figure_of(axis: dict[str, Any], machine: str) -> Figure:
    """The figure of an axis: time and memory in logarithmic axes, with the exponents."""
    points = axis["points"]
    n = [point["n"] for point in points]
    figure = Figure(figsize=(6.4, 3.4), layout="constrained")
    left = figure.subplots()
    series = [("seconds", "time (s)", TIME, left)]
    if all(point["mib"] is not None for point in points):
        series.append(("mib", axis.get("memory", "peak memory (MiB)"), MEMORY, left.twinx()))
    for key, label, colour, axes in series:
        values = [point[key] for point in points]
        power = exponent(n, values)
        axes.loglog(n, values, "o-", color=colour)
        # At least a decade, so that a quantity that hardly grows is shown as such.
        spread = max(10**0.5 / (max(values) / min(values)) ** 0.5, 1.3)
        axes.set_ylim(min(values) / spread, max(values) * spread)
        axes.set_ylabel(f"{label} ~ n^{power:.2f}", color=colour)
        axes.tick_params(axis="y", which="both", labelcolor=colour)
    left.set_xticks(n, [f"{value:g}" for value in n])
    left.minorticks_off()
    left.set_xlabel(f"n: {axis['label']}")
    left.set_title(f"{axis['what']}\n{machine}", fontsize="small")
    left.grid(alpha=0.3)
    return figure


def draw(path: Path, axis: dict[str, Any], machine: str) -> None:
    """Write the figure of an axis as SVG. Equal numbers give equal bytes."""
    figure, text = figure_of(axis, machine), io.StringIO()
    with rc_context({"svg.hashsalt": path.stem, "svg.fonttype": "path"}):
        FigureCanvasSVG(figure).print_svg(text, metadata={"Date": None})
    path.write_text(re.sub(r"[ \t]+$", "", text.getvalue(), flags=re.MULTILINE), "utf-8")


def of_axis(axis: Axis, quick: bool, most: float) -> dict[str, Any]:
    """Measure an axis, and print its points and exponents."""
    f_s, points = reference(), []
    print(f"{axis.label}: {axis.what}; 1 F = {f_s:.3f} s", flush=True)
    for point in axis.points([value for value in (axis.quick if quick else axis.values) if value <= most]):
        points.append(asdict(point))
        memory = "" if point.mib is None else f"{point.mib:8.0f} MiB"
        more = "".join(f"  {key} {value:.4g}" for key, value in point.more.items())
        in_f = f"{point.seconds / f_s:9.2f} F"
        print(f"{point.n:>10g} {point.seconds:10.4f} s {in_f} {memory}{more}", flush=True)
    columns = {key: [point[key] for point in points] for key in ("n", "seconds", "mib")}
    keys = ["seconds"] if None in columns["mib"] else ["seconds", "mib"]
    found = {key: exponent(columns["n"], columns[key]) for key in keys}
    print("exponents:", ", ".join(f"{key} {value:.2f}" for key, value in found.items() if value is not None))
    load = f"load {os.getloadavg()[2]:.0f} in the last 15 minutes"
    return {
        "label": axis.label,
        "what": axis.what,
        "memory": axis.memory,
        "f_s": f_s,
        "exponents": found,
        "points": points,
        "machine": f"{kind_of_machine()}, {time.strftime('%Y-%m-%d')}, {load}",
    }


def memory_of_methods() -> None:
    """Print the peak memory of every method beside its estimate."""
    print(
        "peak besides the image and the PSF; bytes for each pixel of the padded plane besides the result, too"
    )
    for size in (2048, 4096):
        for method in method_names():
            point = measured("deconvolution", size, size=size, method=method, steps=2)
            estimate, bytes_px = point.more["estimate_mib"], point.more["bytes_a_padded_px"]
            assert point.mib is not None
            ratio = estimate / point.mib
            told = f"{point.mib:6.0f} MiB, estimate {estimate:6.0f} MiB = {ratio:.2f}; {bytes_px:5.1f} bytes"
            print(f"{size} px {method:<32} {told}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", choices=[*AXES, "memory", "figures", []], metavar="NAME")
    parser.add_argument("--most", type=float, default=math.inf, metavar="N")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    table = json.loads(TABLE.read_text("utf-8")) if TABLE.exists() else {}
    if chosen.one:
        warnings.simplefilter("ignore")  # these images have no header
        kind, case = chosen.one
        print(json.dumps(asdict((fit if kind == "fit" else deconvolution)(json.loads(case)))))
    elif chosen.names == ["memory"]:
        memory_of_methods()
    elif chosen.names == ["figures"]:
        for name, axis in table.items():
            draw(FOLDER / f"{name}.svg", axis, axis["machine"])
    else:
        for name in chosen.names or AXES:
            table[name] = of_axis(AXES[name], chosen.quick, chosen.most)
            if chosen.write:
                TABLE.write_text(json.dumps(table, indent=1) + "\n", "utf-8")
                draw(FOLDER / f"{name}.svg", table[name], table[name]["machine"])


if __name__ == "__main__":
    main()
