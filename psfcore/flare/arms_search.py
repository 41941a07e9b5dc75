"""The flare image, prepared for the measurement of arms, and first values of their angles and of the spacing of orders.

The preparation gives the difference, the mask, the centre, the noise and the halo. The first values come from a grid
search: the smooth part of the image is removed, and at the correct angle and spacing, the remaining image is brighter at
the orders than halfway between the orders.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from psfcore.errors import DataError

Vector = NDArray[np.float64]
Indices = NDArray[np.intp]
Plane = NDArray[np.float64]
Flags = NDArray[np.bool_]

NEEDED_ORDERS_AN_ARM = 3
SMALLEST_SPACING_PX = 4.0
LARGEST_SPACING_PX = 40.0
_FLARE_SIGMA = 10.0
_SEARCH_STEP_DEG = 0.25
_SEARCH_STEP_PX = 0.25
_APART_DEG = 4.0  # two arms are at least this far apart
_CUT = 5.0  # largest contrast, in local standard deviations


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
    middle = float(np.median(values))
    scatter = float(1.4826 * np.median(np.abs(values - middle)))  # from the median absolute deviation
    peak = float(values.max())
    if not peak > middle + _FLARE_SIGMA * scatter:
        wanted = f"a spot at least {_FLARE_SIGMA:g} times the scatter ({scatter:.3g}) above the median ({middle:.3g})"
        raise DataError("no-flare", f"expected a flare, {wanted}; got {peak:.3g} at the brightest pixel")
    brightest = np.unravel_index(int(np.where(usable, smoothed, -np.inf).argmax()), smoothed.shape)
    return (float(brightest[1]), float(brightest[0])), radius


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


def pixel_sigma(expected: Plane) -> Plane:
    """The standard error of each pixel: the square root of the light, DN, correct up to a factor."""
    floor = max(1e-3 * float(np.median(expected)), 1e-12)
    return np.asarray(np.sqrt(np.maximum(expected, floor)))


def ring_halo(
    difference: Plane,
    usable: Flags,
    centre: tuple[float, float],
    angles_deg: Vector,
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


def search_arms(
    difference: Plane,
    usable: Flags,
    centre: tuple[float, float],
    n_arms: int,
    radii_px: tuple[float, float],
) -> tuple[Vector, float]:
    """Return first values of the angles (degrees) and of the spacing (px).

    Along an arm, the orders are brighter than the pixels beside the arm and brighter than the pixels between the
    orders. At the returned spacing, the orders on the found arms are brighter than the pixels between the orders by the
    largest amount.
    """
    degrees = np.arange(-90.0, 90.0, _SEARCH_STEP_DEG)
    lit, seen = _along_lines(_contrast(difference, usable), usable, centre, degrees, radii_px)
    step = 2 * _SEARCH_STEP_PX / radii_px[1]
    most = np.log(LARGEST_SPACING_PX / SMALLEST_SPACING_PX)
    spacings = SMALLEST_SPACING_PX * np.exp(np.arange(0.0, most + step, step))
    scores = np.array([_scores(lit, seen, spacing, radii_px) for spacing in spacings])  # [spacing, 2, angle]
    found = _best_angles(degrees, scores.sum(axis=1).max(axis=0), n_arms)
    near = np.array([_between_deg(degrees, angle) <= 2 * _SEARCH_STEP_DEG for angle in found])
    between = np.array([scores[:, 1, here].max(axis=1) for here in near]).sum(axis=0)
    best = int(between.argmax())
    beside = scores[best].sum(axis=0)
    angles = [degrees[here][int(beside[here].argmax())] for here in near]
    return np.asarray(angles), float(spacings[best])


def _contrast(difference: Plane, usable: Flags) -> Plane:
    """The image without its smooth part, divided by its local standard deviation, clipped at +-_CUT; 0 where unusable."""
    detail = smooth(difference, usable, 0.7) - smooth(difference, usable, 5.0)
    scatter = np.sqrt(smooth(detail**2, usable, 15.0))
    ratio = np.divide(detail, scatter, out=np.zeros_like(detail), where=usable & (scatter > 0))
    return np.clip(ratio, -_CUT, _CUT)


def _along_lines(
    contrast: Plane,
    usable: Flags,
    centre: tuple[float, float],
    degrees: Vector,
    radii_px: tuple[float, float],
) -> tuple[Plane, Plane]:
    """The contrast and the number of usable pixels [angle, radius step], each summed over both sides of the centre."""
    radii = np.arange(0.0, radii_px[1], _SEARCH_STEP_PX)
    lit, seen = np.zeros((degrees.size, radii.size)), np.zeros((degrees.size, radii.size))
    cosine, sine = np.cos(np.deg2rad(degrees))[:, None], np.sin(np.deg2rad(degrees))[:, None]
    for side in (1, -1):
        where = (centre[1] + side * radii * sine, centre[0] + side * radii * cosine)
        lit += ndimage.map_coordinates(contrast, where, order=1, mode="constant")
        seen += ndimage.map_coordinates(usable.astype(np.float64), where, order=1, mode="constant")
    seen[:, radii < radii_px[0]] = 0
    lit[:, radii < radii_px[0]] = 0
    return lit, seen


def _scores(lit: Plane, seen: Plane, spacing: float, radii_px: tuple[float, float]) -> Plane:
    """Two scores [2, angle] that are large if orders lie at this spacing along this angle.

    The first is the summed contrast at the orders. The second is this sum minus the summed contrast between the orders.
    Each score is divided by the square root of its number of pixels. It is 0 if too few orders are usable.
    """
    orders = np.arange(1, int(radii_px[1] / spacing))
    at = np.rint(orders * spacing / _SEARCH_STEP_PX).astype(int)
    between = np.rint((orders + 0.5) * spacing / _SEARCH_STEP_PX).astype(int)
    between = between[between < lit.shape[1]]
    lit_at, lit_between = lit[:, at].sum(axis=1), lit[:, between].sum(axis=1)
    seen_at = seen[:, at].sum(axis=1)
    number = seen_at + seen[:, between].sum(axis=1)
    enough = seen_at >= NEEDED_ORDERS_AN_ARM
    none = np.zeros_like(lit_at)
    return np.stack(
        (
            np.divide(lit_at, np.sqrt(seen_at), out=none.copy(), where=enough),
            np.divide(lit_at - lit_between, np.sqrt(number), out=none, where=enough),
        )
    )


def _best_angles(degrees: Vector, score: Vector, n_arms: int) -> Vector:
    """The angles with the best scores, at least _APART_DEG apart."""
    found: list[float] = []
    allowed = np.ones(degrees.size, dtype=bool)
    for _ in range(n_arms):
        found.append(float(degrees[int(np.where(allowed, score, -np.inf).argmax())]))
        allowed &= _between_deg(degrees, found[-1]) >= _APART_DEG
    return np.sort(np.asarray(found))


def _between_deg(a: Vector, b: float) -> Vector:
    """Angle between two lines, 0 to 90 degrees."""
    return np.asarray(np.abs((a - b + 90.0) % 180.0 - 90.0))
