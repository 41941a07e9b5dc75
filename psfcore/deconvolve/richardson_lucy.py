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
| H, H^T | Convolver.apply, Convolver.adjoint | - |
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from psfcore.deconvolve.result import Deconvolved
from psfcore.errors import DataError
from psfcore.fourier import Convolver
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
    convolver = Convolver(psf.kernel, image.pixels.shape, dtype=np.float32, threads=threads)
    estimate = _first_estimate(image, observed, convolver)
    agreed = _agreed(trusted, convolver)
    change = _iterate(estimate, observed, agreed, convolver, steps=steps, progress=progress)
    pixels = estimate.astype(np.float64)
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
    convolver: Convolver,
    *,
    steps: int,
    progress: Callable[[int, int], None] | None,
) -> float:
    """Eq. (1) `steps` times, in place; returns the relative change of the last step."""
    floor = np.float32(FLOOR_OF_MAXIMUM * float(estimate.max()))
    change = 0.0
    for step in range(1, steps + 1):
        model = convolver.apply(estimate)
        _ratio_in_place(model, observed, agreed, floor)
        correction = convolver.adjoint(model)
        moved, total = _update_in_place(estimate, correction, floor * np.float32(1e-6))  # Eq. (1)
        change = float(np.sqrt(moved / total)) if total > 0 else 0.0
        if progress is not None:
            progress(step, steps)
    return change


def _agreed(trusted: NDArray[np.bool_], convolver: Convolver) -> Single:
    """(1 - w) / s of Eq. (1): 0 where a pixel is trusted."""
    agreed = np.zeros(trusted.shape, dtype=np.float32)
    if not trusted.all():
        held = convolver.adjoint(np.ones(trusted.shape, dtype=np.float32))
        agreed[~trusted] = 1 / held[~trusted]
    return agreed


def _first_estimate(image: Image, observed: Single, convolver: Convolver) -> Single:
    """The observation, above the floor; at non-finite pixels the PSF-weighted mean of trusted ones."""
    estimate = observed.copy()
    saturated = (image.mask & (MaskBit.SATURATED | MaskBit.NONFINITE)) == MaskBit.SATURATED
    estimate[saturated] = np.maximum(image.pixels[saturated], 0.0)
    missing = (image.mask & MaskBit.NONFINITE) != 0
    if missing.any():
        near = convolver.apply(image.valid.astype(np.float32))[missing]
        seen = convolver.apply(observed)[missing]
        everywhere = np.float32(observed[image.valid].mean())
        estimate[missing] = np.where(near > 1e-4, seen / np.maximum(near, 1e-4), everywhere)
    floor = np.float32(FLOOR_OF_MAXIMUM * float(estimate.max()))
    return np.maximum(estimate, floor)


@njit(cache=True, fastmath=False)
def _ratio_in_place(model: Single, observed: Single, agreed: Single, floor: np.float32) -> None:
    """model <- w y / (H x) + (1 - w) / s, the inner part of Eq. (1); H x not below the floor."""
    for j in range(model.shape[0]):
        for i in range(model.shape[1]):
            if agreed[j, i] > 0:
                model[j, i] = agreed[j, i]
            else:
                model[j, i] = observed[j, i] / max(model[j, i], floor)


@njit(cache=True, fastmath=False)
def _update_in_place(estimate: Single, correction: Single, tiny: np.float32) -> tuple[float, float]:
    """x <- x * correction, Eq. (1), zero below `tiny`; returns sums of (change)^2 and x^2."""
    moved = 0.0
    total = 0.0
    zero = np.float32(0.0)
    for j in range(estimate.shape[0]):
        for i in range(estimate.shape[1]):
            old = estimate[j, i]
            new = old * max(correction[j, i], zero)  # rounding may take a correction of 0 below 0
            if new < tiny:
                new = zero
            estimate[j, i] = new
            moved += (new - old) * (new - old)
            total += new * new
    return moved, total
