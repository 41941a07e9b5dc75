"""A point-spread function, and the figures read off it.

Reach and normalisation: light is counted over all pixels of a 2048 px grid round the centre, to 1448 px,
on which a PSF sums to 1. A smaller array holds what falls on it, sums to less and is never renormalised.

| symbol | name | unit |
|---|---|---|
| r | radius_px, pixel centre to pixel centre | px |
| C(R) | cumulative_curve: 100 (1 - sum of weights with r <= R) | % |
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from psfcore.errors import DataError
from psfcore.plate_scale import PLATE_SCALE_TOLERANCE as PLATE_SCALE_TOLERANCE

REACH_GRID_PX = 2048
LARGEST_SUM = 1 + 1e-3
SMALLEST_SUM = 0.05
CENTRE_TOLERANCE = 1e-3  # of the largest weight: pixels that share the peak may differ by rounding

Kernel = NDArray[np.float64]


@dataclass(frozen=True)
class FittedShape:
    """The formula that a scatter kernel was fitted with, and how well it is known.

    shape: its name in psfcore.scatter.shapes. parameters: their names; coordinates: the unbounded ones that the fit
    moves in; covariance: of these.
    """

    shape: str
    parameters: tuple[str, ...]
    coordinates: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Psf:
    """Weights [y, x] (fraction of a point's light per pixel) round [ny // 2, nx // 2], and their origin.

    `components` are kernels with the same centring ("DIFFRACTION", "SCATTER"); `provenance` is free,
    JSON-able text and numbers; `fitted` what SCATTER was fitted with. Raises DataError: "psf-not-2d", "psf-nonfinite", "psf-negative",
    "psf-sum", "psf-not-centred".
    """

    kernel: Kernel
    name: str
    version: str
    instrument: str | None
    status: str
    plate_scale_arcsec: float | None = None
    wavelength_angstrom: float | None = None
    components: dict[str, Kernel] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    fitted: FittedShape | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "kernel", np.ascontiguousarray(self.kernel, dtype=np.float64))
        _check_weights(self.kernel)
        _check_centre(self.kernel)

    @property
    def total(self) -> float:
        """Sum of all weights on this array: 1 on the full reach, less on a smaller array, more on a larger."""
        return float(self.kernel.sum())

    @property
    def reach_px(self) -> float:
        """Distance of the farthest pixel from the centre, px."""
        ny, nx = self.kernel.shape
        return float(np.hypot(ny // 2, nx // 2))


def _check_weights(kernel: Kernel) -> None:
    if kernel.ndim != 2 or min(kernel.shape, default=0) < 1:
        raise DataError("psf-not-2d", f"expected weights on two axes; got shape {kernel.shape}")
    if not np.isfinite(kernel).all():
        bad = int(np.count_nonzero(~np.isfinite(kernel)))
        raise DataError("psf-nonfinite", f"expected finite weights; got {bad} that are NaN or infinite")
    largest, smallest = float(kernel.max()), float(kernel.min())
    # Light counts over the full reach; an array beyond it may hold more.
    total = float(crop_centred(kernel, _within_reach(kernel.shape)).sum())
    if smallest < -1e-12 * max(largest, 0.0):
        raise DataError("psf-negative", f"expected weights >= 0; the smallest is {smallest:.3g}")
    if not SMALLEST_SUM < total <= LARGEST_SUM:
        wanted = f"a sum of 1 on the full reach, less when cropped ({SMALLEST_SUM} to {LARGEST_SUM})"
        raise DataError("psf-sum", f"expected {wanted}; got {total:.6g}: divide the weights first")


def _within_reach(shape: tuple[int, ...]) -> tuple[int, int]:
    return min(shape[0], REACH_GRID_PX), min(shape[1], REACH_GRID_PX)


def _check_centre(kernel: Kernel) -> None:
    """The centre holds the largest weight: a peak one pixel off would shift every deconvolved image by it."""
    centre = (kernel.shape[0] // 2, kernel.shape[1] // 2)
    if kernel[centre] < kernel.max() * (1 - CENTRE_TOLERANCE):
        peak = np.unravel_index(int(kernel.argmax()), kernel.shape)
        found = tuple(int(p) for p in peak)
        hint = " (the corner origin of a Fourier transform: shift it first)" if found == (0, 0) else ""
        raise DataError("psf-not-centred", f"expected the peak at [y, x] = {centre}; got {found}{hint}")


def crop_centred(kernel: Kernel, shape: tuple[int, int]) -> Kernel:
    """The middle of `kernel` with its centre at [n // 2] of the new, not larger, shape. Not renormalised."""
    ny, nx = shape
    top, left = kernel.shape[0] // 2 - ny // 2, kernel.shape[1] // 2 - nx // 2
    return kernel[top : top + ny, left : left + nx].copy()


def crop_or_pad(kernel: Kernel, size: int) -> Kernel:
    """A square kernel on (size, size), its centre at [size // 2, size // 2]; zero where it did not reach."""
    if kernel.shape[0] >= size and kernel.shape[1] >= size:
        return crop_centred(kernel, (size, size))
    out = np.zeros((size, size))
    ny, nx = (min(n, size) for n in kernel.shape)
    part = crop_centred(kernel, (ny, nx))
    top, left = size // 2 - ny // 2, size // 2 - nx // 2
    out[top : top + ny, left : left + nx] = part
    return out


def squared_radii(shape: tuple[int, int]) -> NDArray[np.int64]:
    """r^2 [y, x] (px^2, whole numbers) from the pixel [ny // 2, nx // 2]."""
    dy = np.arange(shape[0], dtype=np.int64) - shape[0] // 2
    dx = np.arange(shape[1], dtype=np.int64) - shape[1] // 2
    return np.asarray(dy[:, None] ** 2 + dx[None, :] ** 2)


def encircled_energy(kernel: Kernel, radii_px: ArrayLike) -> NDArray[np.float64]:
    """Sum of the weights with r <= R for each R of `radii_px`; same shape as `radii_px`."""
    by_square = np.bincount(squared_radii(kernel.shape).ravel(), weights=kernel.ravel())
    inside = np.concatenate(([0.0], np.cumsum(by_square)))
    radii = np.asarray(radii_px, dtype=np.float64)
    # A radius such as sqrt(2) squares to 2.0000000000000004 or 1.9999999999999998: allow for the rounding.
    squares = np.floor(radii**2 * (1 + 1e-12)).astype(np.int64)
    filled = np.where(radii < 0, 0, np.clip(squares + 1, 0, by_square.size))
    return np.asarray(inside[filled])


def cumulative_curve(kernel: Kernel, radii_px: ArrayLike) -> NDArray[np.float64]:
    """Percent of a point's light that lands farther than each R (px), or off the array.

    Not below 0: an array larger than the full reach holds more than all of the light.
    """
    return np.asarray(100.0 * np.maximum(1.0 - encircled_energy(kernel, radii_px), 0.0))


def radial_profile(kernel: Kernel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(radius_px, mean weight) over rings one pixel wide: ring k holds the pixels whose r rounds to k."""
    ring = np.rint(np.sqrt(squared_radii(kernel.shape))).astype(np.int64).ravel()
    count = np.bincount(ring)
    mean = np.bincount(ring, weights=kernel.ravel()) / np.maximum(count, 1)
    occupied = count > 0
    return np.flatnonzero(occupied).astype(np.float64), mean[occupied]
