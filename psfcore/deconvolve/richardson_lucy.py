"""Richardson-Lucy deconvolution: Richardson (1972), Lucy (1974), as Hofmeister et al. recommend for HRI_EUV.

    x <- x * H^T( w y / (H x) + (1 - w) / s ),   s = H^T 1      Eq. (1)

Without masked pixels (w = 1) this is the published step and keeps the flux, sum x = sum y, because H^T meets
the very H x it divides by. A pixel that is not trusted (w = 0) counts as agreeing with the model: it neither
pulls nor pushes. Agreeing is 1 / s and not 1, because light that leaves the field is not given back by
the published step: its ratios settle at 1 / s, and pixels held at 1 would fade by s at each step.
A negative pixel is noise about zero and counts as 0 in the ratio: the method knows no negative light.

| symbol | name | unit |
|---|---|---|
| y | observed | image unit |
| x | estimate | image unit |
| w | trusted, 1 or 0 | - |
| s | what of a pixel's light the field and the PSF's array hold; (1 - w) / s is agreed | - |
| H, H^T | Engine.apply, Engine.adjoint | - |
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from psfcore.deconvolve.result import Deconvolved
from psfcore.engine import Engine, buffer_from_spectrum, spectrum_from_buffer
from psfcore.errors import DataError
from psfcore.fft_kernels import LANES, forward, inverse
from psfcore.image import Image, MaskBit
from psfcore.psf import Psf, check_compatible

# float32's resolution of the brightest pixel: below it the transform's rounding decides, and a floor
# there keeps denormal numbers, which are slow, out of the loop.
FLOOR_OF_MAXIMUM = 2.0**-23

Single = NDArray[np.float32]


def richardson_lucy(
    image: Image,
    psf: Psf,
    *,
    steps: int = 20,
    threads: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Deconvolved:
    """Estimate the scene behind `image` [y, x] seen through `psf`.

    The estimate starts from the observation. The result is NaN where the image is not finite and the
    estimate where it is saturated. progress(step, steps) is called after each step; what it raises
    passes through. Raises DataError: "bad-steps", "no-signal", "plate-scale-mismatch".
    """
    if steps < 1:
        raise DataError("bad-steps", f"expected at least one step; got {steps}")
    check_compatible(image, psf)
    trusted = image.valid
    light = np.where(trusted, np.maximum(image.pixels, 0.0), 0.0)
    if not light.any():
        raise DataError("no-signal", "expected a trusted pixel above zero; got none")
    observed = light.astype(np.float32)
    engine = Engine(psf.kernel, observed.shape, threads=threads)
    estimate = _first_estimate(image, observed, engine)
    agreed = _agreed(trusted, engine)
    found, change = _iterate(estimate, observed, agreed, engine, steps=steps, progress=progress)
    pixels = found.astype(np.float64)
    flux_out = float(pixels[trusted].sum())
    pixels[(image.mask & MaskBit.NONFINITE) != 0] = np.nan
    return Deconvolved(
        pixels=pixels,
        method="richardson-lucy",
        steps_done=steps,
        stopped_because=f"all {steps} steps asked for were done",
        flux_in=float(light.sum()),
        flux_out=flux_out,
        negative_pixels=int(np.count_nonzero(image.pixels[trusted] < 0)),
        last_change=change,
    )


def _iterate(
    estimate: Single,
    observed: Single,
    agreed: Single,
    engine: Engine,
    *,
    steps: int,
    progress: Callable[[int, int], None] | None,
) -> tuple[Single, float]:
    """Eq. (1) `steps` times; returns the estimate and the relative change of the last step.

    Between the two convolutions of a step, and between two steps, a block of rows stays in cache.
    """
    floor = np.float32(FLOOR_OF_MAXIMUM * float(estimate.max()))
    tiny = floor * np.float32(1e-6)
    x, y, masked = engine.to_lanes(estimate), engine.to_lanes(observed), bool(agreed.any())
    held = engine.to_lanes(agreed) if masked else np.zeros((1, 1, 1, 1), np.float32)
    moved, total = np.zeros(engine.row_blocks), np.zeros(engine.row_blocks)
    engine.rows_forward(x)
    for step in range(1, steps + 1):
        engine.columns(adjoint=False)
        engine.row_stage(_ratio_rows, y, held, masked, floor)
        engine.columns(adjoint=True)
        engine.row_stage(_update_rows, x, tiny, step < steps, moved, total)  # Eq. (1)
        if progress is not None:
            progress(step, steps)
    change = float(np.sqrt(moved.sum() / total.sum())) if total.sum() > 0 else 0.0
    return engine.from_lanes(x), change


def _agreed(trusted: NDArray[np.bool_], engine: Engine) -> Single:
    """(1 - w) / s of Eq. (1): 0 where a pixel is trusted."""
    agreed = np.zeros(trusted.shape, dtype=np.float32)
    if not trusted.all():
        held = engine.adjoint(np.ones(trusted.shape, dtype=np.float32))
        agreed[~trusted] = 1 / held[~trusted]
    return agreed


def _first_estimate(image: Image, observed: Single, engine: Engine) -> Single:
    """The observation, above the floor; at non-finite pixels the PSF-weighted mean of trusted ones."""
    estimate = observed.copy()
    saturated = (image.mask & (MaskBit.SATURATED | MaskBit.NONFINITE)) == MaskBit.SATURATED
    estimate[saturated] = np.maximum(image.pixels[saturated], 0.0)
    missing = (image.mask & MaskBit.NONFINITE) != 0
    if missing.any():
        near = engine.apply(image.valid.astype(np.float32))[missing]
        seen = engine.apply(observed)[missing]
        everywhere = np.float32(observed[image.valid].mean())
        estimate[missing] = np.where(near > 1e-4, seen / np.maximum(near, 1e-4), everywhere)
    floor = np.float32(FLOOR_OF_MAXIMUM * float(estimate.max()))
    return np.maximum(estimate, floor)


@njit(nogil=True, cache=True)
def _ratio_rows(spectrum, observed, agreed, masked, floor, buffer, corner, start, stop, length, radices, lengths, tw, offsets, place):  # type: ignore[no-untyped-def]  # fmt: skip
    """H x <- w y / (H x) + (1 - w) / s, the inner part of Eq. (1); H x not below the floor."""
    nx = observed.shape[1]
    z = buffer.reshape((-1, 2, LANES))
    for block in range(start, stop):
        buffer_from_spectrum(spectrum, buffer, corner, block, length, place)
        inverse(buffer, length, radices, lengths, tw, offsets)
        for i in range(nx):
            for side in range(2):
                for w in range(LANES):
                    ratio = observed[block, i, side, w] / max(z[i, side, w], floor)
                    if masked and agreed[block, i, side, w] > 0:
                        ratio = agreed[block, i, side, w]
                    z[i, side, w] = ratio
        buffer[nx * 2 * LANES : length * 2 * LANES] = np.float32(0.0)
        forward(buffer, length, radices, lengths, tw, offsets)
        spectrum_from_buffer(spectrum, buffer, corner, block, length, place)


@njit(nogil=True, cache=True)
def _update_rows(spectrum, estimate, tiny, again, moved, total, buffer, corner, start, stop, length, radices, lengths, tw, offsets, place):  # type: ignore[no-untyped-def]  # fmt: skip
    """x <- x * correction, Eq. (1), zero below `tiny`; sums of (change)^2 and x^2 for each block."""
    nx = estimate.shape[1]
    zero = np.float32(0.0)
    z = buffer.reshape((-1, 2, LANES))
    for block in range(start, stop):
        buffer_from_spectrum(spectrum, buffer, corner, block, length, place)
        inverse(buffer, length, radices, lengths, tw, offsets)
        moved_here = 0.0
        total_here = 0.0
        for i in range(nx):
            moved_row = zero
            total_row = zero
            for side in range(2):
                for w in range(LANES):
                    old = estimate[block, i, side, w]
                    # Rounding may take a correction of 0 below 0.
                    new = old * max(z[i, side, w], zero)
                    new = zero if new < tiny else new
                    estimate[block, i, side, w] = new
                    z[i, side, w] = new
                    moved_row += (new - old) * (new - old)
                    total_row += new * new
            moved_here += moved_row
            total_here += total_row
        moved[block] = moved_here
        total[block] = total_here
        if again:
            buffer[nx * 2 * LANES : length * 2 * LANES] = zero
            forward(buffer, length, radices, lengths, tw, offsets)
            spectrum_from_buffer(spectrum, buffer, corner, block, length, place)
