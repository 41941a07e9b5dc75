"""Compare the times of one Richardson-Lucy loop with three FFTs: heliopsf's engine, SciPy and ducc0.

The comparison shows whether `psfcore.convolution.engine`, `psfcore.convolution.fft_kernels` and `psfcore.compiled` are
worth their code. All three loops run the published method: 20 steps in float32 with a scene that is zero beyond the
field, the same padded lengths, and the same number of threads. A heliopsf without its own engine would transform only
the rows of the field along x, so the loops with SciPy and ducc0 do the same. The loops run in turn, each in a separate
process; the shortest of three times is printed.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.race import peers
from benchmarks.timing import THREADS
from psfcore.convolution.lengths import good_length
from psfcore.convolution.offsets import needed_kernel

STEPS = 20
IMAGE_PX = 2048
ROUNDS = 3
AGREEMENT = 1e-5  # largest difference allowed, relative to the brightest pixel
LIBRARIES = ("heliopsf", "scipy.fft", "ducc0")
_FLOOR_OF_MAXIMUM = 2.0**-23
_DARK_OF_FLOOR = 1e-6

Single = NDArray[np.float32]
Spectrum = NDArray[np.complex64]
Forward = Callable[[Single], Spectrum]
Inverse = Callable[[Spectrum], Single]


def compare(image: Single, psf: Single, folder: Path, f_s: float) -> None:
    """Print times and ratios of the three loops for an image and a PSF [y, x]; f_s: seconds of 1 F.

    Raises RuntimeError if their results differ by more than AGREEMENT.
    """
    np.save(folder / "image.npy", image)
    np.save(folder / "psf.npy", psf)
    seconds = {name: float("inf") for name in LIBRARIES}
    for _ in range(ROUNDS):
        for name in LIBRARIES:
            seconds[name] = min(seconds[name], _in_a_process(name, folder))
    ours = np.load(folder / "heliopsf.npy")
    apart = {
        name: float(np.abs(np.load(folder / f"{name}.npy") - ours).max() / ours.max())
        for name in LIBRARIES[1:]
    }
    if max(apart.values()) > AGREEMENT:
        raise RuntimeError(f"expected results that agree to {AGREEMENT:g} of the maximum; got {apart}")
    times = ", ".join(f"{name} {seconds[name] / f_s:.1f} F" for name in LIBRARIES)
    ratios = ", ".join(f"{name} / heliopsf {seconds[name] / seconds['heliopsf']:.2f}" for name in apart)
    print(f"Richardson-Lucy, {STEPS} steps, {image.shape[0]} px: {times}; ratios: {ratios}")
    print("  largest difference from heliopsf, of the maximum: " + json.dumps(apart))


def _in_a_process(name: str, folder: Path) -> float:
    command = [sys.executable, "-m", "benchmarks.race.fft_libraries", name, str(folder)]
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    return float(answer.stdout.splitlines()[-1])


def heliopsf(image: Single, psf: Single) -> Single:
    """The loop of heliopsf, from the preparation of the PSF to the result."""
    return peers.heliopsf(image, psf, STEPS).astype(np.float32)


def scipy_fft(image: Single, psf: Single) -> Single:
    """The loop with SciPy's transforms."""
    import scipy.fft

    ny, nx = image.shape
    ly, lx = _lengths(image, psf)

    def forward(x: Single) -> Spectrum:
        rows = scipy.fft.rfft(x, n=lx, axis=1, workers=THREADS)
        return np.asarray(scipy.fft.fft(rows, n=ly, axis=0, workers=THREADS, overwrite_x=True))

    def inverse(spectrum: Spectrum) -> Single:
        columns = scipy.fft.ifft(spectrum, axis=0, workers=THREADS, overwrite_x=True)[:ny]
        rows = scipy.fft.irfft(columns, n=lx, axis=1, workers=THREADS, overwrite_x=True)
        return np.asarray(rows[:, :nx])

    transfer = scipy.fft.rfft2(_corner(psf, image.shape, (ly, lx)), workers=THREADS)
    return _loop(image, forward, inverse, transfer)


def ducc0(image: Single, psf: Single) -> Single:
    """The loop with ducc0's transforms."""
    from ducc0 import fft

    ny, nx = image.shape
    ly, lx = _lengths(image, psf)
    padded = np.zeros((ny, lx), np.float32)
    spectrum = np.zeros((ly, lx // 2 + 1), np.complex64)

    def forward(x: Single) -> Spectrum:
        padded[:, :nx] = x
        fft.r2c(padded, axes=(1,), nthreads=THREADS, out=spectrum[:ny])
        spectrum[ny:] = 0
        return np.asarray(fft.c2c(spectrum, axes=(0,), nthreads=THREADS, out=spectrum))

    def inverse(spectrum: Spectrum) -> Single:
        columns = fft.c2c(spectrum, axes=(0,), forward=False, inorm=2, nthreads=THREADS, out=spectrum)[:ny]
        rows = fft.c2r(columns, axes=(1,), lastsize=lx, forward=False, inorm=2, nthreads=THREADS)
        return np.asarray(rows[:, :nx])

    transfer = fft.r2c(_corner(psf, image.shape, (ly, lx)), axes=(0, 1), nthreads=THREADS)
    return _loop(image, forward, inverse, transfer)


def _lengths(image: Single, psf: Single) -> tuple[int, int]:
    """Lengths (y, x) of the padded plane, as heliopsf's engine chooses them."""
    kernel, first = needed_kernel(psf, (image.shape[0], image.shape[1]))
    ly, lx = (
        good_length(size + max(-low, low + count - 1, 0))
        for size, low, count in zip(image.shape, first, kernel.shape, strict=True)
    )
    return ly, lx


def _corner(psf: Single, field_shape: tuple[int, ...], lengths: tuple[int, int]) -> Single:
    """Put the PSF on the padded plane, with its centre at [0, 0]."""
    kernel, first = needed_kernel(psf, (field_shape[0], field_shape[1]))
    plane = np.zeros(lengths, np.float32)
    plane[: kernel.shape[0], : kernel.shape[1]] = kernel
    return np.roll(plane, first, axis=(0, 1))


def _loop(image: Single, forward: Forward, inverse: Inverse, transfer: Spectrum) -> Single:
    """Eq. (1) of `psfcore.deconvolve.methods.richardson_lucy` without masked pixels; model values have the same
    floor."""
    scale = np.abs(image).max()
    observed = np.maximum(image / scale, 0)
    floor = np.float32(_FLOOR_OF_MAXIMUM) * observed.max()
    dark = floor * np.float32(_DARK_OF_FLOOR)
    adjoint = transfer.conj()
    estimate = np.maximum(observed, floor)
    for _ in range(STEPS):
        spectrum = forward(estimate)
        spectrum *= transfer
        model = inverse(spectrum)
        np.maximum(model, floor, out=model)
        np.divide(observed, model, out=model)
        spectrum = forward(model)
        spectrum *= adjoint
        correction = inverse(spectrum)
        np.maximum(correction, 0, out=correction)
        estimate *= correction
        estimate[estimate < dark] = 0
    return np.asarray(estimate * scale)


LOOPS: dict[str, Callable[[Single, Single], Single]] = {
    "heliopsf": heliopsf,
    "scipy.fft": scipy_fft,
    "ducc0": ducc0,
}


def run_one(name: str, folder: Path) -> None:
    """Time one loop in this process.

    The loop first runs on a small image, to load the compiled kernels and libraries.
    """
    image, psf = np.load(folder / "image.npy"), np.load(folder / "psf.npy")
    centre = psf.shape[0] // 2
    LOOPS[name](image[:64, :64], psf[centre - 32 : centre + 32, centre - 32 : centre + 32])
    start = time.perf_counter()
    result = LOOPS[name](image, psf)
    seconds = time.perf_counter() - start
    np.save(folder / f"{name}.npy", result)
    print(seconds)


if __name__ == "__main__":
    run_one(sys.argv[1], Path(sys.argv[2]))
