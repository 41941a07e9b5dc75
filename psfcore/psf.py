"""A point-spread function (PSF), its encircled energy and its radial profile.

Reach and normalisation: a PSF sums to 1 over a grid of 2048 x 2048 px around its centre, whose corners are 1448 px
away. A smaller array holds the part of the light that falls on it; its sum is below 1, and it is never renormalised.

| symbol | name | unit |
|---|---|---|
| r | radius_px: distance of a pixel's centre from the centre of the central pixel | px |
| C(R) | cumulative_curve: 100 (1 - sum of weights with r <= R) | % |
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from psfcore.arrays import cut
from psfcore.errors import DataError
from psfcore.instruments.files import PLATE_SCALE_TOLERANCE as PLATE_SCALE_TOLERANCE
from psfcore.psf_field import FieldTerm, Place, check_field, common_shape, factors_at, nine_places
from psfcore.recipe import REACH_GRID_PX as REACH_GRID_PX

SHOWN_RADII_PX = (0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
CURVE_RADII_PX = (0.5, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 300.0)
Kernel = NDArray[np.float64]

LARGEST_SUM = 1 + 1e-3
SMALLEST_SUM = 0.05
SMALLEST_SIDE_PX = 3  # a PSF of one pixel changes no image
# Because of rounding, the central weight may be below the largest weight by this fraction.
CENTRE_TOLERANCE = 1e-3
LARGEST_OFFSET_PX = 0.05  # a PSF moves every image by the offset of its core


@dataclass(frozen=True)
class FittedShape:
    """The fitted formula of a scatter kernel, with its uncertainty.

    Attributes
    ----------
    shape
        Name of the formula in psfcore.scatter.shapes.
    parameters
        Names of the parameters of the formula.
    coordinates
        Values of the unbounded coordinates in which the fit was done.
    covariance
        Covariance matrix of the coordinates.
    """

    shape: str
    parameters: tuple[str, ...]
    coordinates: tuple[float, ...]
    covariance: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Psf:
    """The weights [y, x] of a PSF, and how they were obtained.

    Raises DataError: "psf-not-2d", "psf-too-small", "psf-nonfinite", "psf-negative", "psf-sum", "psf-not-centred",
    "psf-off-centre", "psf-field".

    Attributes
    ----------
    kernel
        The weights: each is the share of a point source's light that a pixel receives; the centre is [ny // 2, nx //
        2].
    components
        Kernels with the same centre ("DIFFRACTION", "SCATTER").
    provenance
        The origin of the PSF, as texts and numbers for JSON.
    fitted
        The fitted formula of SCATTER.
    turn_deg
        The angle from the +x axis of the detector to the +x axis of the kernel.
    cards
        Texts of the file's cards TELESCOP, INSTRUME, DETECTOR and FILTER, which say for which images the PSF is valid.
    field_terms
        The terms of a PSF that changes over the field (`psfcore.psf_field`); `kernel` is then K0.
    place
        Where the pixels of the image lie on the detector; required if there are terms. In a file: those of the whole
        detector.
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
    cards: Mapping[str, str] = field(default_factory=dict)
    turn_deg: float = 0.0
    field_terms: tuple[FieldTerm, ...] = ()
    place: Place | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "kernel", np.ascontiguousarray(self.kernel, dtype=np.float64))
        _check_weights(self.kernel)
        _check_centre(self.kernel)
        _check_core(self.kernel)
        if self.field_terms:
            check_field(self.kernel, self.field_terms, self.place, (SMALLEST_SUM, LARGEST_SUM))

    @property
    def total(self) -> float:
        """Sum of all weights: 1 for the full reach; a larger array may sum to more."""
        return float(self.kernel.sum())

    @property
    def reach_px(self) -> float:
        """Distance of the farthest pixel from the centre, px."""
        ny, nx = self.kernel.shape
        return float(np.hypot(ny // 2, nx // 2))

    def at(self, u: float, v: float) -> Kernel:
        """Compute the weights for light from a place of the detector.

        Parameters
        ----------
        u, v : float
            The place along x and y, from -1 to 1: the first and the last pixel of the detector.

        Returns
        -------
        ndarray of float64
            The weights [y, x]; those of every place if the PSF does not change over the field.
        """
        kernels = common_shape([self.kernel, *(term.kernel for term in self.field_terms)])
        return np.asarray(np.tensordot(factors_at(self.field_terms, [(u, v)])[0], kernels, 1))


def _check_weights(kernel: Kernel) -> None:
    if kernel.ndim != 2:
        raise DataError(
            "psf-not-2d", f"expected weights with two axes; got shape {kernel.shape}: give one plane"
        )
    if min(kernel.shape) < SMALLEST_SIDE_PX:
        raise DataError(
            "psf-too-small", f"expected at least {SMALLEST_SIDE_PX} px per side; got shape {kernel.shape}"
        )
    if not np.isfinite(kernel).all():
        bad = int(np.count_nonzero(~np.isfinite(kernel)))
        raise DataError(
            "psf-nonfinite",
            f"expected finite weights; got {bad} weights that are NaN or infinite: replace them, for example by 0",
        )
    smallest = float(kernel.min())
    if smallest < -1e-12 * max(float(kernel.max()), 0.0):
        raise DataError(
            "psf-negative",
            f"expected weights >= 0; the smallest is {smallest:.3g}: set negative weights to 0, and divide all by "
            "their sum",
        )
    # The sum is defined over the full reach; a larger array may sum to more than 1.
    within = (min(kernel.shape[0], REACH_GRID_PX), min(kernel.shape[1], REACH_GRID_PX))
    total = float((kernel if kernel.shape == within else crop_centred(kernel, within)).sum())
    if not SMALLEST_SUM < total <= LARGEST_SUM:
        expected = f"weights that sum to 1 over the full reach, or to less if cropped ({SMALLEST_SUM} to {LARGEST_SUM})"
        raise DataError(
            "psf-sum",
            f"expected {expected}; got {total:.6g}: divide the weights by their "
            "sum first, or name a PSF, if this file is an image",
        )


def _check_centre(kernel: Kernel) -> None:
    """Check that the central pixel has the largest weight.

    A PSF with another centre would shift every deconvolved image.
    """
    centre = (kernel.shape[0] // 2, kernel.shape[1] // 2)
    if kernel[centre] < kernel.max() * (1 - CENTRE_TOLERANCE):
        peak = np.unravel_index(int(kernel.argmax()), kernel.shape)
        place = tuple(int(p) for p in peak)
        hint = " (the corner origin of a Fourier transform)" if place == (0, 0) else ""
        raise DataError(
            "psf-not-centred",
            f"expected the peak at [y, x] = {centre}; got {place}{hint}: shift the PSF so that its peak is at {centre}",
        )


def _check_core(kernel: Kernel) -> None:
    """Check that the core of the PSF is not beside the central pixel."""
    y, x = kernel.shape[0] // 2, kernel.shape[1] // 2
    core = kernel[y - 1 : y + 2, x - 1 : x + 2]
    if core.shape != (3, 3):
        return
    offset_x_px, offset_y_px = _core_offset_px(*core.sum(axis=0)), _core_offset_px(*core.sum(axis=1))
    if max(abs(offset_x_px), abs(offset_y_px)) > LARGEST_OFFSET_PX:
        raise DataError(
            "psf-off-centre",
            "expected the core of the PSF at the centre of the pixel [ny // 2, nx // 2], within "
            f"{LARGEST_OFFSET_PX:g} px; got it at x {offset_x_px:+.2f}, y {offset_y_px:+.2f} px from there, which "
            "would move every image by as much: shift the PSF by whole and part pixels, for example with "
            "scipy.ndimage.shift",
        )


def _core_offset_px(before: float, centre: float, after: float) -> float:
    """The offset of the core from the central pixel along one axis, px, from the sums of three lines of 3 weights.

    A Gaussian through the three sums has its peak at this offset; a core without light beside the central pixel has the
    offset of its centroid.
    """
    if min(before, after) <= 0 or centre <= 0:
        total = before + centre + after
        return (after - before) / total if total > 0 else 0.0
    curvature = 2 * math.log(centre) - math.log(before) - math.log(after)
    slope = math.log(after) - math.log(before)
    return (
        0.0
        if slope == 0
        else 0.5 * slope / curvature
        if curvature > abs(slope)
        else math.copysign(0.5, slope)
    )


def crop_centred(kernel: Kernel, shape: tuple[int, int]) -> Kernel:
    """Cut out the central part of `kernel`; the new centre is at [ny // 2, nx // 2] of `shape`.

    `shape` must not be larger than the kernel. The weights are not renormalised.
    """
    ny, nx = shape
    top, left = kernel.shape[0] // 2 - ny // 2, kernel.shape[1] // 2 - nx // 2
    return kernel[top : top + ny, left : left + nx].copy()


def psf_from_pixel(psf: Psf, x_px: int, y_px: int) -> Psf:
    """The PSF of the part of an image that begins at the pixel (x_px, y_px); `psf` itself if it has no place."""
    return psf if psf.place is None else replace(psf, place=psf.place.from_pixel(x_px, y_px))


def with_kernels(psf: Psf, change: Callable[[Kernel], Kernel]) -> Psf:
    """The PSF whose kernel, components and terms are changed by a linear function."""
    return replace(
        psf,
        kernel=change(psf.kernel),
        components={name: change(part) for name, part in psf.components.items()},
        field_terms=tuple(replace(term, kernel=change(term.kernel)) for term in psf.field_terms),
    )


def central_part(psf: Psf, size_px: int) -> Psf:
    """The central (size_px, size_px) px of a PSF and of its components. The weights are not renormalised.

    Raises DataError "cutout-too-large" if the PSF is smaller.
    """
    smallest = min(psf.kernel.shape)
    if size_px > smallest:
        raise DataError("cutout-too-large", f"expected a size of 1 to {smallest} px; got {size_px}")
    return with_kernels(psf, lambda kernel: crop_or_pad(kernel, size_px))


def crop_or_pad(kernel: Kernel, size: int) -> Kernel:
    """Crop a kernel, or pad it with zeros, to (size, size); the new centre is at [size // 2, size // 2]."""
    top, left = (n // 2 - size // 2 for n in kernel.shape)
    return np.asarray(cut(kernel, top, left, (size, size)))


def squared_radii(shape: tuple[int, int]) -> NDArray[np.int64]:
    """r^2 [y, x] (px^2, integers), measured from the pixel [ny // 2, nx // 2]."""
    dy = np.arange(shape[0], dtype=np.int64) - shape[0] // 2
    dx = np.arange(shape[1], dtype=np.int64) - shape[1] // 2
    return np.asarray(dy[:, None] ** 2 + dx[None, :] ** 2)


def encircled_energy(kernel: Kernel, radii_px: ArrayLike) -> NDArray[np.float64]:
    """Sum of the weights with r <= R, for each R in `radii_px`; the result has the shape of `radii_px`."""
    by_square = np.bincount(squared_radii(kernel.shape).ravel(), weights=kernel.ravel())
    inside = np.concatenate(([0.0], np.cumsum(by_square)))
    radii = np.asarray(radii_px, dtype=np.float64)
    # The square of sqrt(2) may be 2.0000000000000004 or 1.9999999999999998: allow for rounding.
    squares = np.floor(radii**2 * (1 + 1e-12)).astype(np.int64)
    filled = np.where(radii < 0, 0, np.clip(squares + 1, 0, by_square.size))
    return np.asarray(inside[filled])


def cumulative_curve(kernel: Kernel, radii_px: ArrayLike) -> NDArray[np.float64]:
    """1 - encircled energy in percent: the light beyond each R (px), including light outside the array.

    The result is never below 0, although an array larger than the full reach may sum to more than 1.
    """
    return np.asarray(100.0 * np.maximum(1.0 - encircled_energy(kernel, radii_px), 0.0))


def light_beyond_pct(kernel: Kernel) -> dict[str, float]:
    """The light beyond each of SHOWN_RADII_PX in percent, by the radius as text."""
    curve = cumulative_curve(kernel, np.array(SHOWN_RADII_PX, dtype=float))
    return {str(radius): float(pct) for radius, pct in zip(SHOWN_RADII_PX, curve, strict=True)}


def light_beyond_map(psf: Psf, radii_px: ArrayLike) -> NDArray[np.float64]:
    """The light beyond each R (px) in percent at nine places of the detector, (radii, 3, 3): v and u are -1, 0, 1.

    The light is that of `cumulative_curve`, which is linear in the weights.
    """
    encircled = [
        encircled_energy(one, radii_px) for one in (psf.kernel, *(t.kernel for t in psf.field_terms))
    ]
    beyond = 1.0 - np.transpose(encircled) @ factors_at(psf.field_terms, nine_places()).T
    return np.asarray(100.0 * np.maximum(beyond, 0.0).reshape(-1, 3, 3))


def field_map(psf: Psf) -> dict[str, object]:
    """How a PSF changes over the field, as JSON values: the powers of its terms, the size of the detector, and the maps
    of `light_beyond_map` for SHOWN_RADII_PX.
    """
    assert psf.place is not None
    return {
        "terms": [[term.x_power, term.y_power] for term in psf.field_terms],
        "detector_px": list(psf.place.detector),
        "radii_px": list(SHOWN_RADII_PX),
        "light_beyond_pct": light_beyond_map(psf, SHOWN_RADII_PX).tolist(),
    }


def radial_profile(kernel: Kernel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Radius (px) and mean weight of rings that are one pixel wide. Ring k holds the pixels whose r rounds to k."""
    ring = np.rint(np.sqrt(squared_radii(kernel.shape))).astype(np.int64).ravel()
    count = np.bincount(ring)
    mean = np.bincount(ring, weights=kernel.ravel()) / np.maximum(count, 1)
    occupied = count > 0
    return np.flatnonzero(occupied).astype(np.float64), mean[occupied]
