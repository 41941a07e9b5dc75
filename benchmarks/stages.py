"""Where the time of `heliopsf deconvolve` goes for an image of the whole Sun: the table of docs/speed.md.

    python -m benchmarks.stages [--page FILE]

The image and the PSF are those of `benchmarks.race.peers --whole`. A process runs the stages of the command one after
the other, as the command does, each once. The floor of a stage is the time to move its bytes through memory, or to
transform its planes with the kernels of `psfcore.convolution.engine`:

| stage | floor |
|---|---|
| read PSF, read image | the file is read, and float64 is written |
| transfer function | one transform of the plane |
| steps | four transforms of the plane for each step |
| compare | image and result are read |
| write | the result is read, and the file is written |
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from astropy.io import fits

from benchmarks.figures import kind_of_machine, write_part
from benchmarks.race.files import CARDS
from benchmarks.race.peers import RACES, STEPS
from benchmarks.timing import THREADS, reference, seconds

ROUNDS = 3
STARTED = "HELIOPSF_BENCH_STARTED"  # environment variable: when the process was started, s
HEAD = "| stage | time (s) | time (F) | floor (s) | floor |\n|---|---|---|---|---|"


def one_command(folder: Path) -> dict[str, list[Any]]:
    """The time, the floor, s, and the name of the floor of each stage, in this process."""
    import service.cli.local  # noqa: F401  # what the command imports
    from psfcore.convolution.engine import Engine
    from psfcore.deconvolve import run
    from psfcore.deconvolve.conditions import Conditions, PreparedPsfs
    from psfcore.deconvolve.doubts import input_warnings
    from psfcore.deconvolve.methods.registry import method_named
    from psfcore.deconvolve.work import Options, Work
    from psfcore.fits.blocks import LIMITS
    from psfcore.fits.observation import read_observation
    from psfcore.fits.psfs import read_psf

    method, found = "richardson-lucy", {"start": [time.time() - float(os.environ[STARTED]), None, None]}

    def timed(stage: str, work: Callable[[], Any]) -> Any:
        start = time.perf_counter()
        result = work()
        found[stage] = [time.perf_counter() - start, None, None]
        return result

    psf = timed("read PSF", lambda: read_psf(folder / "psf.fits", LIMITS, parts=False))
    image = timed("read image", lambda: read_observation(folder / "image.fits", LIMITS))
    warnings = timed("look for warnings", lambda: input_warnings(psf, image, method, channel=None))
    prepared = PreparedPsfs()
    shape = (image.pixels.shape[0], image.pixels.shape[1])
    engine: Engine = timed("transfer function", lambda: prepared.engine_for(psf, shape, shape, THREADS))
    conditions = Conditions(edges="zero", threads=THREADS, engine_for=prepared.engine_for)
    work = Work(image, psf, Options(method=method, edges="zero", threads=THREADS))
    result = timed("steps", lambda: method_named(method)(image, psf, conditions, steps=STEPS))
    product = run.Product(**vars(result), image=image, psf=psf, errors=None, warnings=warnings, work=work)
    timed("compare", product.details)
    used, ids = run.UsedPsf("", psf.name, psf.version, psf.status), run.Identities(None, None, 1, "out.fits")
    timed("write", lambda: run.write(product, folder / "out.fits", used, ids))
    return found | floors(found, engine, [image.pixels.nbytes, psf.kernel.nbytes])


def floors(found: dict[str, list[Any]], engine: Any, sizes: list[int]) -> dict[str, list[Any]]:
    """The stages that have a floor, with it. sizes: of image and PSF in float64, bytes."""
    plane = np.ones(2**25)
    copied = np.empty_like(plane)
    rate = 2 * plane.nbytes / seconds(lambda: np.copyto(copied, plane), 3)  # bytes/s, read and written
    lanes = engine.to_lanes(np.ones(engine.field_shape, np.float32))

    def convolve() -> None:
        engine.rows_forward(lanes)
        engine.columns(adjoint=False)
        engine.rows_inverse(lanes)

    transform_s = seconds(convolve, 3) / 2
    image, psf = sizes
    of = {
        "read PSF": (1.5 * psf / rate, f"{1.5 * psf / 2**20:.0f} MiB"),
        "read image": (1.5 * image / rate, f"{1.5 * image / 2**20:.0f} MiB"),
        "transfer function": (transform_s, "1 transform"),
        "steps": (4 * STEPS * transform_s, f"{4 * STEPS} transforms"),
        "compare": (1.5 * image / rate, f"{1.5 * image / 2**20:.0f} MiB"),
        "write": (image / rate, f"{image / 2**20:.0f} MiB"),
    }
    return {stage: [found[stage][0], *floor] for stage, floor in of.items()}


def section(rounds: list[dict[str, list[Any]]], f_s: float) -> str:
    """The table: of each stage the shortest time of all rounds."""
    rows, total = [], 0.0
    for stage in rounds[0]:
        took, floor = (
            min((one[stage][n] for one in rounds if one[stage][n] is not None), default=None) for n in (0, 1)
        )
        assert took is not None
        total += took
        told = ("", "") if floor is None else (f"{floor:.2f}", rounds[0][stage][2])
        rows.append(f"| {stage} | {took:.2f} | {took / f_s:.1f} | {told[0]} | {told[1]} |")
    rows.append(f"| together | {total:.2f} | {total / f_s:.1f} | | |")
    date = time.strftime("%Y-%m-%d")
    return "\n".join(
        [f"{kind_of_machine()}, {date}; {len(rounds)} rounds; 1 F = {f_s:.2f} s.\n", HEAD, *rows]
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--page", type=Path, help="page whose section of this table is replaced")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.one:
        print(json.dumps(one_command(chosen.one)))
        return
    f_s, rounds = reference(), []
    with TemporaryDirectory(prefix="heliopsf-stages-") as folder:
        image, psf = RACES[True].data()
        fits.writeto(Path(folder) / "image.fits", image, fits.Header(CARDS))
        fits.writeto(Path(folder) / "psf.fits", psf)
        command = [sys.executable, "-m", "benchmarks.stages", "--one", folder]
        for _ in range(ROUNDS + 1):
            environment = os.environ | {STARTED: str(time.time())}
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True, env=environment)
            rounds.append(json.loads(done.stdout.splitlines()[-1]))
    table = section(rounds[1:], f_s)
    print(table)
    if chosen.page:
        write_part(chosen.page, "benchmarks.stages", table)


if __name__ == "__main__":
    main()
