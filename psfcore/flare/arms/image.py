"""The flare image, prepared for the measurement: difference, mask, centre, noise and halo."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from psfcore.errors import DataError

_FLARE_SIGMA = 10.0

Plane = NDArray[np.float64]
Flags = NDArray[np.bool_]


def prepared(image: Plane, reference: Plane | None, saturated: Flags | None) -> tuple[Plane, Flags, Flags]:
    """Return the difference image (0 where unusable), its usable pixels, and the largest saturated patch.

    Raises DataError "arms-bad-input", "all-masked".
    """
    for name, plane in (("reference", reference), ("saturated", saturated)):
        if plane is not None and plane.shape != image.shape:
            raise DataError(
                "arms-bad-input",
                f"expected {name} with the shape of the image, {image.shape}; got {plane.shape}",
            )
    difference = np.asarray(image if reference is None else image - reference, dtype=np.float64)
    usable = np.isfinite(difference)
    patch = np.zeros(image.shape, dtype=bool)
    if saturated is not None and saturated.any():
        usable &= ~saturated
        labels, _ = ndimage.label(saturated, structure=np.ones((3, 3)))
        patch = labels == np.bincount(labels.ravel())[1:].argmax() + 1
    if not usable.any():
        raise DataError("all-masked", f"expected some usable pixels; got {usable.size} pixels, all masked")
    return np.where(usable, difference, 0.0), usable, patch


def source_centre(
    difference: Plane, usable: Flags, patch: Flags, given: tuple[float, float] | None
) -> tuple[tuple[float, float], float]:
    """Return the position (x, y) of the source in px, and the radius of its saturated patch in px.

    If no position is given, the middle of the patch is used. If no pixel is saturated, the brightest pixel is used, and
    the radius is 1.5 px. Raises DataError "arms-bad-input", "no-flare".
    """
    radius = float(np.sqrt(patch.sum() / np.pi)) if patch.any() else 1.5
    if given is not None:
        ny, nx = difference.shape
        if not (0 <= given[0] < nx and 0 <= given[1] < ny):
            raise DataError(
                "arms-bad-input", f"expected a centre (x, y) on the image of {nx} x {ny} px; got {given}"
            )
        return given, radius
    if patch.any():
        y, x = np.nonzero(patch)
        return (float(x.mean()), float(y.mean())), radius
    smoothed = smooth(difference, usable, 1.0)
    values = smoothed[usable]
    middle, scatter = _median_and_scatter(values)
    peak = float(values.max())
    if not peak > middle + _FLARE_SIGMA * scatter:
        wanted = f"a spot at least {_FLARE_SIGMA:g} times the scatter ({scatter:.3g}) above the median ({middle:.3g})"
        raise DataError("no-flare", f"expected a flare, {wanted}; got {peak:.3g} at the brightest pixel")
    brightest = np.unravel_index(int(np.where(usable, smoothed, -np.inf).argmax()), smoothed.shape)
    return (float(brightest[1]), float(brightest[0])), radius


def _median_and_scatter(values: NDArray[np.float64]) -> tuple[float, float]:
    """Median, and standard deviation estimated from the median absolute deviation."""
    middle = float(np.median(values))
    return middle, float(1.4826 * np.median(np.abs(values - middle)))


def smooth(plane: Plane, usable: Flags, width_px: float) -> Plane:
    """Gaussian-weighted mean of the usable pixels; 0 where no usable pixel is near."""
    weight = ndimage.gaussian_filter(usable.astype(np.float64), width_px)
    total = ndimage.gaussian_filter(np.where(usable, plane, 0.0), width_px)
    return np.divide(total, weight, out=np.zeros_like(total), where=weight > 1e-6)


def expected_light(image: Plane, reference: Plane | None, usable: Flags) -> Plane:
    """The light (DN, smoothed) that causes the photon noise of the difference: the image, plus the reference if it is
    given."""
    counts = image if reference is None else image + reference
    return smooth(np.nan_to_num(counts), usable, 2.0)


def pixel_sigma(expected: Plane, noise: tuple[float, float] | None) -> Plane:
    """The standard error of each pixel, DN. Without `noise` it is the square root of the light, correct up to a factor."""
    gain, read = noise or (1.0, 0.0)
    floor = max(1e-3 * float(np.median(expected)), 1e-12)
    return np.asarray(np.sqrt(gain * np.maximum(expected, floor) + read**2))


def ring_halo(
    difference: Plane,
    usable: Flags,
    centre: tuple[float, float],
    angles_deg: NDArray[np.float64],
    half_px: float,
) -> Plane:
    """The smooth light around the source: the median of each ring without the arms, interpolated linearly in radius."""
    dy, dx = np.indices(difference.shape, dtype=np.float64)
    dy, dx = dy - centre[1], dx - centre[0]
    away = usable.copy()
    for angle in np.deg2rad(angles_deg):
        away &= np.abs(dy * np.cos(angle) - dx * np.sin(angle)) > half_px
    radius = np.hypot(dx, dy)
    ring = np.rint(radius).astype(np.intp)
    labels = np.unique(ring[away])
    if labels.size < 2:
        return np.zeros_like(difference)
    middle = ndimage.median(difference, np.where(away, ring, -1), labels)
    return np.asarray(np.interp(radius, labels, middle))
