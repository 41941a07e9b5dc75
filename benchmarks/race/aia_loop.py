"""Time twenty Richardson-Lucy steps of a 4096 x 4096 px image of AIA; part of `make bench-peers`.

    python -m benchmarks.race.aia_loop [--rounds N] [--page FILE]

Three loops run in turn, each in a process and an environment of its own (`benchmarks.race.environments`):

- heliopsf, with the edges "zero": the convolution is linear, on a plane that is larger than the image;
- aiapy's function `aiapy.psf.deconvolve`, which uses NumPy without a GPU;
- aiapy's loop in JAX, compiled for the processor, in single and in double precision. aiapy has no such loop.

aiapy continues the image periodically, so that light scattered beyond an edge comes back at the opposite edge; heliopsf does not.
The results are therefore compared in the inner 1600 x 1600 px of the Sun, where this light hardly matters, before a time is printed. A time contains everything from the image in memory to the result
in memory, also the transform of the PSF; the compilation of the loops, which happens once, is left out: each loop first runs for
one step. The peak memory is that of the whole process.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.race.environments import REPOSITORY, python_of
from benchmarks.race.peers import aia_map, heliopsf
from benchmarks.timing import peak_gib, reference

SIZE_PX, STEPS = 4096, 20
RADIUS_PX = 1600  # of the Sun
INNER = np.s_[1248:-1248, 1248:-1248]  # compared pixels
LARGEST_DEVIATION = 2e-3  # single precision, and light across the edges
HELIOPSF, AIAPY, JAX_32, JAX_64 = "heliopsf", "aiapy", "JAX, single", "JAX, double"
SHOWN = {
    HELIOPSF: "heliopsf, linear convolution",
    AIAPY: "aiapy (NumPy, double precision)",
    JAX_32: "the loop of aiapy in JAX, single precision",
    JAX_64: "the loop of aiapy in JAX, double precision",
}
HEADING = "## Time and memory of a whole image"
SECTION = """{heading}

`python -m benchmarks.race.aia_loop`: a simulated image of the whole Sun, {size} x {size} px, and a PSF of the same size, {steps} Richardson-Lucy
steps on {cores} cores. The loops run in turn; rounds: {rounds}. A time is the minimum, and a ratio is the median of the rounds. 1 F
is the time of one Fourier transform of this size and its inverse (`rfft2` and `irfft2` of SciPy, float32, two workers), measured before each run: here {f}.
The times contain the transform of the PSF, but not the compilation of the loops. The deviation is the largest one of a pixel within the
inner 1600 x 1600 px, from the result of heliopsf.

| loop | time (s) | time (F) | time / time of heliopsf | peak memory (GiB) | deviation |
|---|---|---|---|---|---|
{rows}

aiapy continues the image periodically. heliopsf convolves linearly, so that light does not come back at the opposite edge, and needs a
larger plane for this. On a padded image the loops of both agree better (the table above).
"""


def data() -> tuple[np.ndarray, np.ndarray]:
    """An image of a textured disc, and a PSF with a sharp core and a softened power law. Both are float32."""
    rng = np.random.default_rng(0)
    y, x = np.indices((SIZE_PX, SIZE_PX), dtype=np.float32) - SIZE_PX // 2
    radius = np.hypot(x, y)
    psf = 0.1525 / (6.15 + radius) ** 2.53
    centre = (SIZE_PX // 2, SIZE_PX // 2)
    psf[centre] = 1 - (psf.sum(dtype=float) - psf[centre])
    image = rng.gamma(2.0, 200.0, radius.shape).astype(np.float32)
    image *= 1 / (1 + np.exp((radius - RADIUS_PX) / 40))
    image += 1
    return image, (psf / psf.sum(dtype=float)).astype(np.float32)


def aiapy(image: np.ndarray, psf: np.ndarray, steps: int) -> np.ndarray:
    from aiapy.psf import deconvolve

    return np.asarray(deconvolve(aia_map(image), psf=psf, iterations=steps).data)


def jax_loop(image: np.ndarray, psf: np.ndarray, steps: int) -> np.ndarray:
    """The loop of aiapy, compiled as a whole. JAX uses double precision if this is set before its start."""
    import jax
    import jax.numpy as jnp
    from jax.numpy.fft import irfft2, rfft2

    global _COMPILED
    if _COMPILED is None:

        def loop(image: Any, psf: Any, steps: Any) -> Any:
            transfer = rfft2(jnp.roll(psf, (psf.shape[0] // 2, psf.shape[1] // 2), axis=(0, 1)))

            def step(_: Any, estimate: Any) -> Any:
                ratio = image / irfft2(rfft2(estimate) * transfer)
                return estimate * irfft2(rfft2(ratio) * transfer.conj())

            return jax.lax.fori_loop(0, steps, step, image)

        _COMPILED = jax.jit(loop)
    single = not jax.config.jax_enable_x64
    kind = np.float32 if single else np.float64
    return np.asarray(_COMPILED(image.astype(kind), psf.astype(kind), steps).block_until_ready())


_COMPILED: Any = None
LOOPS = {HELIOPSF: heliopsf, AIAPY: aiapy, JAX_32: jax_loop, JAX_64: jax_loop}
ENVIRONMENTS = {HELIOPSF: "", AIAPY: "aiapy", JAX_32: "jax", JAX_64: "jax"}


def run_one(name: str, folder: Path) -> None:
    """Time one loop in this process, and save its result."""
    image, psf = np.load(folder / "image.npy"), np.load(folder / "psf.npy")
    loop = LOOPS[name]
    if name != AIAPY:
        loop(image, psf, 1)  # compiles the loop, or loads its kernels
    start = time.perf_counter()
    result = loop(image, psf, STEPS)
    seconds = time.perf_counter() - start
    np.save(folder / f"{name}.npy", result)
    print(json.dumps({"seconds": seconds, "peak_gib": peak_gib()}))


def deviation(result: np.ndarray, reference: np.ndarray) -> float:
    """Largest deviation of a pixel in the inner part of the disc, relative to the pixel or to the mean, whichever is larger."""
    own = reference[INNER]
    return float((np.abs(result[INNER] - own) / np.maximum(own, own.mean())).max())


def measured_once(name: str, folder: Path) -> dict[str, float]:
    """One run: its time in s and in F, its peak memory, and its deviation from heliopsf. 1 F is measured just before."""
    f_s = reference()
    done = subprocess.run(
        [python_of(ENVIRONMENTS[name]), "-m", "benchmarks.race.aia_loop", "--one", name, str(folder)],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        env=os.environ | {"PYTHONPATH": str(REPOSITORY), "JAX_ENABLE_X64": str(int(name == JAX_64))},
    )
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    apart = deviation(np.load(folder / f"{name}.npy"), np.load(folder / f"{HELIOPSF}.npy"))
    if apart > LARGEST_DEVIATION:
        raise SystemExit(
            f"aia_loop: expected deviations below {LARGEST_DEVIATION:g}; {name} deviates by {apart:.1e}: the loops do not "
            "solve the same problem"
        )
    return {**found, "f": found["seconds"] / f_s, "f_s": f_s, "apart": apart}


def section(runs: dict[str, list[dict[str, float]]], rounds: int) -> str:
    """The section of the page, from all runs of each loop."""
    own = [run["seconds"] for run in runs[HELIOPSF]]
    lines = []
    for name, each in runs.items():
        ratio = median([run["seconds"] / ours for run, ours in zip(each, own, strict=True)])
        seconds, f = (min(run[key] for run in each) for key in ("seconds", "f"))
        peak, apart = (max(run[key] for run in each) for key in ("peak_gib", "apart"))
        lines.append(
            f"| {SHOWN[name]} | {seconds:.1f} | {f:.0f} | {ratio:.2f} | {peak:.2f} | {100 * apart:.2f} % |"
        )
    all_f = [run["f_s"] for each in runs.values() for run in each]
    return SECTION.format(
        heading=HEADING,
        size=SIZE_PX,
        steps=STEPS,
        rounds=rounds,
        cores=os.cpu_count(),
        f=f"{min(all_f):.2f} s to {max(all_f):.2f} s",
        rows="\n".join(lines),
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=1, help="runs of each loop, in turn")
    parser.add_argument("--page", type=Path, help="page whose last section is replaced by the result")
    arguments = parser.parse_args()
    runs: dict[str, list[dict[str, float]]] = {name: [] for name in LOOPS}
    with TemporaryDirectory(prefix="heliopsf-aia-loop-") as place:
        folder = Path(place)
        for label, array in zip(("image", "psf"), data(), strict=True):
            np.save(folder / f"{label}.npy", array)
        for _ in range(arguments.rounds):
            for name in LOOPS:
                runs[name].append(measured_once(name, folder))
                print(name, runs[name][-1], flush=True)
    text = section(runs, arguments.rounds)
    print(text)
    if arguments.page:
        before = arguments.page.read_text("utf-8").partition(HEADING)[0].rstrip()
        arguments.page.write_text(f"{before}\n\n{text}", "utf-8")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        run_one(sys.argv[2], Path(sys.argv[3]))
    else:
        main()
