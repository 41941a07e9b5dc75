"""The times for which a person waits, beside their goals: imports, first result, PSF, deconvolution, fit and diagnosis.

    python -m benchmarks.times [NAME ...]

NAME: of `TIMES`; default: all. Each time is the shortest of several runs. Calls within a process run once before, so
that the kernels are compiled.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory, gettempdir
from typing import Any

import numpy as np

from benchmarks.figures import tell
from benchmarks.timing import THREADS, answer_of, measured_process, peak_gib, reference, seconds
from psfcore.blind.case_set import make_set
from psfcore.blind.cases import SetPlan
from psfcore.build import build_psf
from psfcore.deconvolve.conditions import Conditions, PreparedPsfs
from psfcore.deconvolve.methods.registry import method_named
from psfcore.diffraction.design_study import design_study
from psfcore.diffraction.mesh_series import order_spacing_px, rotated_mesh_kernel
from psfcore.drawing.plots import preview_png
from psfcore.fits.blocks import FitsLimits
from psfcore.fits.observation import read_observation
from psfcore.instruments.model import Instrument, load_instrument
from psfcore.scatter.fit import fit_sentence, fit_transit
from psfcore.simulate.plan import default_plan
from psfcore.simulate.scene import demo_image
from psfcore.simulate.transit import simulate, write
from psfcore.transit.folder import read_transit
from tests.transit_files import drawn_truth, hri_diffraction

LIMITS = FitsLimits(max_pixels=2**24)
SIZE_PX, REPEATS, STARTS, ROUNDS = 2048, 3, 7, 3
CLI = (sys.executable, "-m", "service.cli")
CODE = {
    "import heliopsf": "import heliopsf",
    "import service.app": "import service.app",
    "heliopsf --version": "from service.cli.main import main; main(['--version'])",
}
TOTAL, ASYMMETRIC = "PSF of HRI_EUV, 2048 px", "PSF with a mount without symmetry, 2048 px"
PITCH_UM = 1270.0  # of the entrance mesh of HRI_EUV
DIAGNOSED = SetPlan(cases=1, seed=7, size_px=512, images=30, only=("ghost",), left_pct=(10.0,))


def processor_s(code: str, compiled: str) -> float:
    """The processor time, s, of a new interpreter that runs `code`. compiled: folder of the compiled modules."""
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": compiled, "PYTHONDONTWRITEBYTECODE": ""}
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.DEVNULL, env=environment)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"expected {code!r} to end well; it ended with {process.returncode}")
    return usage.ru_utime + usage.ru_stime


def start(folder: Path, f_s: float) -> None:
    """Processor times of imports and of the start of the command, in turn. The first run compiles and is not
    counted."""
    compiled = str(folder / "compiled")
    runs = [{what: processor_s(code, compiled) for what, code in CODE.items()} for _ in range(STARTS + 1)]
    for what in CODE:
        tell(what, min(run[what] for run in runs[1:]), f_s)


def first(folder: Path, f_s: float) -> None:
    """The first and the second `heliopsf deconvolve --local` of a new user. For the first one all caches are empty."""
    image, rounds = folder / "image.fits", []
    demo_image(image, build_psf(load_instrument("hri_euv"), threads=THREADS), size=SIZE_PX)
    for number in range(ROUNDS):
        own = folder / f"user {number}"
        own.mkdir()
        caches = {
            "HELIOPSF_CACHE_DIR": own / "psfs",
            "NUMBA_CACHE_DIR": own / "kernels",
            "XDG_CACHE_HOME": own,
        }
        environment = os.environ | {name: str(path) for name, path in caches.items()}
        command = [*CLI, "deconvolve", str(image), "--local", "-o"]
        rounds.append([measured_process([*command, str(own / f"{k}.fits")], environment)[0] for k in (1, 2)])
    for what, times in zip(
        ("first result, 2048 px, empty caches", "second result, 2048 px"),
        zip(*rounds, strict=True),
        strict=True,
    ):
        tell(what, min(times), f_s)


def turned_mount(instrument: Instrument) -> Instrument:
    """The instrument with a mount that has no symmetry: five bars, turned by an angle that no mirror maps to itself."""
    mount = instrument.mount
    assert mount is not None
    rays = tuple(replace(rays, count=5, first_angle_deg=7.0) for rays in mount.rays)
    return replace(instrument, mount=replace(mount, rays=rays))


def psf(_: Path, f_s: float) -> None:
    """Builds of PSFs, each in a process of its own."""
    for what in (TOTAL, ASYMMETRIC):
        tell(what, answer_of("benchmarks.times", "--one", what)["seconds"], f_s)


def one_psf(what: str) -> dict[str, float]:
    """The time of a build of the total PSF."""
    instrument = load_instrument("hri_euv")
    if what == ASYMMETRIC:
        instrument = turned_mount(instrument)
    build_psf(instrument, size=256, parts=False, threads=THREADS)  # compiles
    return {"seconds": seconds(lambda: build_psf(instrument, size=SIZE_PX, parts=False, threads=THREADS))}


def steps(folder: Path, f_s: float) -> None:
    """Twenty steps of Richardson-Lucy with a prepared PSF."""
    hri = build_psf(load_instrument("hri_euv"), threads=THREADS)
    demo_image(folder / "steps.fits", hri, size=SIZE_PX)
    image = read_observation(folder / "steps.fits", LIMITS)
    conditions = Conditions(threads=THREADS, engine_for=PreparedPsfs().engine_for)
    method = method_named("richardson-lucy")
    method(image, hri, conditions, steps=1)
    tell("20 steps, 2048 px", seconds(lambda: method(image, hri, conditions, steps=20), REPEATS), f_s)


def quick(folder: Path, f_s: float) -> None:
    """A preview, a mesh and a design study, as ratios to 1 F. Each goal was set to about twice the ratio measured."""
    hri = load_instrument("hri_euv")
    plane = np.random.default_rng(0).random((SIZE_PX, SIZE_PX)) * 1000
    pitches_um = [300.0 + 300 * step for step in range(8)]
    picture = folder / "preview.png"
    spacing_px = order_spacing_px(
        wavelength_angstrom=174.0, distance_mm=4187.0, pitch_um=PITCH_UM, pixel_pitch_um=10.0
    )
    calls: dict[str, Callable[[], object]] = {
        "preview, 2048 px": lambda: preview_png(plane, plane * 1.1, picture, title="timed", unit="DN/s"),
        "orders of a rotated mesh, 2048 px": lambda: rotated_mesh_kernel(
            spacing_px, pitch_um=PITCH_UM, wire_um=40.0, windows=37, angle_deg=45.0, size=SIZE_PX
        ),
        "design study of 32 meshes": lambda: design_study(hri, pitches_um, [20, 30, 40, 50]),
    }
    for what, call in calls.items():
        call()
        tell(what, seconds(call, REPEATS) / f_s)


def fit(_: Path, f_s: float) -> None:
    """A fit of 126 images of 2048 px, in a process of its own. The images (4 GB) stay there for the next run."""
    kept = Path(gettempdir()) / "heliopsf-bench-126x2048"
    if not (kept / "transit.json").is_file():
        plan = default_plan(126, SIZE_PX)
        write(simulate(plan, drawn_truth(3), hri_diffraction(SIZE_PX), 3, threads=THREADS), kept)
    found = answer_of("benchmarks.times", "--one", str(kept))
    tell("fit of 126 images of 2048 px", found["seconds"], f_s)
    print(f"  {found['gib']:.2f} GiB; {found['said']}", flush=True)


def one_fit(folder: Path) -> dict[str, Any]:
    """The time, peak memory and sentence of the fit to the transit in a folder."""
    found: list[str] = []

    def work() -> None:
        found.append(fit_sentence(fit_transit(read_transit(folder, LIMITS), threads=THREADS)))

    return {"seconds": seconds(work), "gib": peak_gib(), "said": found[0]}


def gap(folder: Path, f_s: float) -> None:
    """`heliopsf gap --local` of a transit whose effect, a ghost, leaves about ten percent."""
    case, failed = make_set(folder / "set", DIAGNOSED)
    if failed:
        raise SystemExit(f"gap: the case could not be made: {failed}")
    report = folder / "report.json"
    command = [*CLI, "gap", str(case.transit(0)), "--local", "--overwrite", "--json", str(report)]
    took_s, gib = measured_process(command, os.environ)
    print(f"verdict: {json.loads(report.read_text('utf-8'))['verdict']}; the effect in the images is a ghost")
    tell("diagnosis of 30 images of 512 px", took_s, f_s)
    tell("diagnosis of 30 images of 512 px: memory", gib)


TIMES: dict[str, Callable[[Path, float], None]] = {
    one.__name__: one for one in (start, first, psf, steps, quick, gap, fit)
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", choices=[*TIMES, []], metavar="NAME")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one:
        one = one_psf(chosen.one) if chosen.one in (TOTAL, ASYMMETRIC) else one_fit(Path(chosen.one))
        print(json.dumps(one))
        return
    f_s = reference()
    print(f"1 F = {f_s:.3f} s, {THREADS} threads", flush=True)
    with TemporaryDirectory(prefix="heliopsf-times-") as folder:
        for name in chosen.names or TIMES:
            TIMES[name](Path(folder), f_s)


if __name__ == "__main__":
    main()
