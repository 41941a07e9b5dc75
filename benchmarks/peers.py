"""`make bench-peers`: time twenty Richardson-Lucy steps of heliopsf and of other packages, in turn on the same data.

The image has 2048 x 2048 px, the PSF 4096 x 4096 px. Each package runs in a process of its own, so that its peak memory
can be measured. The unit 1 F is one 4096 x 4096 float32 rfft2 + irfft2 by SciPy with two workers, in the same run. The
other packages are installed in a separate environment (`.venv-peers`); a missing package is skipped and reported.
`benchmarks.fft_libraries` compares FFT libraries in the same loop; here each package runs as its users run it.
"""

from __future__ import annotations

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

STEPS = 20
IMAGE_PX, PSF_PX = 2048, 4096
REPOSITORY = Path(__file__).parents[1]


def heliopsf(image: np.ndarray, psf: np.ndarray) -> np.ndarray:
    from astropy.io.fits import Header

    from psfcore.deconvolve.methods.richardson_lucy import richardson_lucy
    from psfcore.image import Image
    from psfcore.psf import Psf

    observed = Image(image.astype(float), np.zeros(image.shape, np.uint8), Header(), "DN/s", 1.0)
    kernel = Psf(psf.astype(float), "bench", "1", None, "draft", None, None)
    return richardson_lucy(observed, kernel, steps=STEPS, threads=os.cpu_count() or 1).pixels


def scipy_fft(image: np.ndarray, psf: np.ndarray) -> np.ndarray:
    """The simplest loop: float32, two workers; the image is padded to the shape of the PSF."""
    import scipy.fft

    image, psf = image.astype(np.float32), psf.astype(np.float32)
    shape = psf.shape
    transfer = scipy.fft.rfft2(np.fft.ifftshift(psf), workers=2)
    ny, nx = image.shape
    padded = np.zeros(shape, np.float32)
    padded[:ny, :nx] = image
    estimate = padded.copy()
    floor = np.float32(2.0**-23 * image.max())
    for _ in range(STEPS):
        model = scipy.fft.irfft2(scipy.fft.rfft2(estimate, workers=2) * transfer, s=shape, workers=2)
        ratio = padded / np.maximum(model, floor)
        estimate *= scipy.fft.irfft2(scipy.fft.rfft2(ratio, workers=2) * transfer.conj(), s=shape, workers=2)
    return estimate[:ny, :nx]


def scikit_image(image: np.ndarray, psf: np.ndarray) -> np.ndarray:
    from skimage.restoration import richardson_lucy

    odd = psf[1:, 1:]  # the package expects the centre in the middle of an odd array
    start = image.astype(np.float32) / image.max()
    return richardson_lucy(start, odd.astype(np.float32), num_iter=STEPS, clip=False) * image.max()


def aiapy(image: np.ndarray, psf: np.ndarray) -> np.ndarray:
    """The loop of aiapy. It uses double precision and periodic convolution, so the image is padded first."""
    from aiapy.psf import deconvolve

    padded = np.zeros(psf.shape)
    padded[: image.shape[0], : image.shape[1]] = image
    done = deconvolve(aia_map(padded), psf=psf, iterations=STEPS)
    return np.asarray(done.data)[: image.shape[0], : image.shape[1]]


def aia_map(pixels: np.ndarray) -> Any:
    """A sunpy Map of these pixels, with the cards that aiapy needs."""
    import astropy.units as u
    import sunpy.map

    header: dict[str, Any] = {
        "ctype1": "HPLN-TAN",
        "ctype2": "HPLT-TAN",
        "cunit1": "arcsec",
        "cunit2": "arcsec",
    }
    header |= {"cdelt1": 0.6, "cdelt2": 0.6, "crpix1": 1, "crpix2": 1, "crval1": 0, "crval2": 0}
    header |= {"telescop": "SDO/AIA", "instrume": "AIA_3", "wavelnth": 171, "waveunit": "angstrom"}
    header |= {"date-obs": "2020-01-01T00:00:00", "hgln_obs": 0, "hglt_obs": 0, "dsun_obs": u.AU.to(u.m)}
    return sunpy.map.Map(pixels, header)


CONTENDERS: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
    "heliopsf": heliopsf,
    "scipy.fft, two workers": scipy_fft,
    "scikit-image": scikit_image,
    "aiapy": aiapy,
}


def data() -> tuple[np.ndarray, np.ndarray]:
    """A textured image, and a PSF with a sharp core and the softened power law of the paper."""
    rng = np.random.default_rng(0)
    y, x = np.indices((PSF_PX, PSF_PX), dtype=np.float32) - PSF_PX // 2
    psf = 0.1525 / (6.15 + np.hypot(x, y)) ** 2.53
    psf[PSF_PX // 2, PSF_PX // 2] = 1 - (psf.sum() - psf[PSF_PX // 2, PSF_PX // 2])
    image = rng.gamma(2.0, 200.0, (IMAGE_PX, IMAGE_PX))
    image[600:620, 900:930] += 20_000
    return image.astype(np.float32), (psf / psf.sum()).astype(np.float32)


def reference_s() -> float:
    import scipy.fft

    field = np.random.default_rng(0).random((4096, 4096), dtype=np.float32)
    times = []
    for _ in range(5):
        start = time.perf_counter()
        scipy.fft.irfft2(scipy.fft.rfft2(field, workers=2), s=field.shape, workers=2)
        times.append(time.perf_counter() - start)
    return min(times)


def peak_gib() -> float:
    """Largest resident size of this process, in GiB. (getrusage would include the parent's memory at the fork.)"""
    line = next(
        line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM")
    )
    return int(line.split()[1]) / 2**20


def run_one(name: str, folder: Path) -> None:
    """Time one package in this process. heliopsf first runs on a small image, which loads its compiled kernels."""
    image, psf = np.load(folder / "image.npy"), np.load(folder / "psf.npy")
    if name == "heliopsf":
        CONTENDERS[name](image[:64, :64], psf[2016:2080, 2016:2080])  # loads compiled kernels
    start = time.perf_counter()
    result = CONTENDERS[name](image, psf)
    seconds = time.perf_counter() - start
    np.save(folder / f"{name.split()[0]}.npy", result.astype(np.float32))
    print(json.dumps({"seconds": seconds, "peak_gib": peak_gib()}))


def main(interpreters: dict[str, str]) -> None:
    f_s = reference_s()
    print(f"1 F = {f_s:.3f} s; {IMAGE_PX} px image, {PSF_PX} px PSF, {STEPS} steps")
    with TemporaryDirectory(prefix="heliopsf-peers-") as name:
        folder = Path(name)
        for label, array in zip(("image", "psf"), data(), strict=True):
            np.save(folder / f"{label}.npy", array)
        took: dict[str, float] = {}
        for contender in CONTENDERS:
            python = interpreters.get(contender, sys.executable)
            command = [python, str(Path(__file__).resolve()), "--one", contender, str(folder)]
            environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
            answer = subprocess.run(command, capture_output=True, text=True, env=environment)
            if answer.returncode:
                last = (answer.stderr.strip().splitlines() or ["no message"])[-1]
                print(f"{contender:<24} skipped: {last}")
                continue
            measured = json.loads(answer.stdout.splitlines()[-1])
            took[contender] = measured["seconds"]
            ours = np.load(folder / "heliopsf.npy")
            theirs = np.load(folder / f"{contender.split()[0]}.npy")
            inner = (slice(256, -256), slice(256, -256))
            apart = float(np.abs(theirs - ours)[inner].max() / ours.max())
            print(
                f"{contender:<24} {measured['seconds']:8.2f} s {measured['seconds'] / f_s:8.1f} F "
                f"{took['heliopsf'] / measured['seconds']:6.3f} (ours / theirs)   peak {measured['peak_gib']:.2f} GiB   "
                f"difference {apart:.1e} of the maximum, without edges"
            )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        run_one(sys.argv[2], Path(sys.argv[3]))
    else:
        peers = sys.argv[1] if len(sys.argv) > 1 else sys.executable
        main({"scikit-image": peers, "aiapy": peers})
