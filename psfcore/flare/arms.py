"""Angles and order spacing of the arms of a mesh's diffraction pattern around a bright compact source.

Hofmeister et al., The point-spread function of HRI_EUV, sections "Solar flare" and "Mesh geometry": the
diffraction pattern of a flare shows the orientation of the meshes and the spacing of their orders. The core of
the flare is saturated and its shape is unknown, so the shape S is fitted together with the pattern. The orders
are narrow, so every order is the same picture S of the source:

    r_ak = r_0 + k s e_a,   e_a = (cos t_a, sin t_a),   k = +-1, +-2, ...                            Eq. (1)
    d(r) = sum over a, k of A_ak S(r - r_ak) + plane_ak(r),                                          Eq. (2)

S is a cubic spline on the pixels. Each order has its own plane, on the pixels that are nearest to this order. Before
the fit, the smooth light around the source is subtracted: the median of each ring without the arms. Weighted least
squares (Gauss-Newton) fits all quantities together except r_0, because an error of r_0 only shifts S. The errors of t
and s come from the normal equations with all other quantities free; they are multiplied by the square root of the
reduced chi^2. S must be at least one pixel wide, as in real images. If each order of a point source filled a single
pixel, the fit could only find the centres of these pixels.

The first values of angles and spacing come from a grid search: the smooth part of the image is removed, and at the
correct angle and spacing, the remaining image is brighter at the orders than halfway between the orders. `arms_fit`
implements Eq. (1) and Eq. (2).

| symbol | name | unit |
|---|---|---|
| d | difference: image minus the reference, if there is one | DN |
| r_0 | centre_xy | px |
| t_a | angles_deg, from +x towards +y, -90 to 90: an arm is a line through the centre | degrees |
| s | spacing_px | px |
| A_ak, S | amplitudes, source | -, DN |
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from threadpoolctl import threadpool_limits

from psfcore.arrays import Flags, Plane, Vector
from psfcore.errors import DataError
from psfcore.flare.arms_fit import (
    NEEDED_ORDERS_AN_ARM,
    FitResult,
    FitState,
    Geometry,
    Orders,
    first_fit,
    first_source,
    iterate,
    order_positions,
)

SMALLEST_SPACING_PX = 4.0
LARGEST_SPACING_PX = 40.0
_FLARE_SIGMA = 10.0
_SEARCH_STEP_DEG = 0.25
_SEARCH_STEP_PX = 0.25
_APART_DEG = 4.0  # two arms are at least this far apart
_CUT = 5.0  # largest contrast, in local standard deviations
_LARGEST_SEARCH_PX = 300.0
_NEAR_PX = 100.0  # the first fit uses the orders within this radius
_NEAR_ORDERS = 6  # the first fit uses at least this number of orders on each side of an arm


@dataclass(frozen=True)
class Peak:
    """One diffraction order: index of its arm, order k, fitted position (px)."""

    arm: int
    order: int
    x_px: float
    y_px: float


@dataclass(frozen=True)
class ArmMeasurement:
    """Directions of the arms and spacing of the orders, with 1-sigma errors.

    Attributes
    ----------
    angles_deg
        Directions of the arms, ascending, within -90 to 90.
    spacing_px
        Spacing of the orders, the same for all arms.
    reduced_chi2
        The chi^2 of the fitted pixels divided by the degrees of freedom; the errors are multiplied by its square root.
    model
        The fitted image [y, x].
    fitted
        True for the fitted pixels [y, x].
    """

    angles_deg: tuple[float, ...]
    angles_sigma_deg: tuple[float, ...]
    spacing_px: float
    spacing_sigma_px: float
    centre_xy: tuple[float, float]
    reduced_chi2: float
    peaks: tuple[Peak, ...]
    stopped_because: str
    model: Plane
    fitted: Flags


# The matrices are so small that threads cost several times more time than they save.
@threadpool_limits.wrap(limits=1, user_api="blas")  # type: ignore[untyped-decorator]  # threadpoolctl has no types
def measure_arms(
    image: Plane,
    centre_xy: tuple[float, float] | None = None,
    *,
    reference: Plane | None = None,
    saturated: Flags | None = None,
    n_arms: int = 2,
    source_radius_px: float | None = None,
    reach_px: float | None = None,
) -> ArmMeasurement:
    """Measure `n_arms` arms around a flare in `image` [y, x] (DN), or in `image` minus `reference`.

    Raises DataError "arms-bad-input", "all-masked", "no-flare", "too-few-peaks".

    Parameters
    ----------
    centre_xy
        Position of the source; default: the middle of the largest saturated patch, else the brightest pixel.
    saturated
        True where pixels must not be used; pixels that are not finite are never used.
    source_radius_px
        Half size of S; default: from the saturated patch.
    reach_px
        Largest radius at which orders are used.
    """
    difference, usable, patch = prepared(image, reference, saturated)
    centre, patch_radius = source_centre(difference, usable, patch, centre_xy)
    half = source_radius_px or float(np.clip(patch_radius + 2.0, 3.0, 8.0))
    inner = 2 * (patch_radius + half)  # at smaller radii, a plane does not describe the smooth light well
    reach = min(reach_px or np.inf, _LARGEST_SEARCH_PX, float(np.hypot(*image.shape)))
    angles, spacing = search_arms(difference, usable, centre, n_arms, (inner, reach))
    halo = ring_halo(difference, usable, centre, angles, half)
    difference = difference - halo
    expected = expected_light(image, reference, usable)
    # The near orders are fitted first, because the angles of the search are too uncertain for the far orders.
    near = Geometry(centre, half, (inner, min(reach, max(_NEAR_PX, inner + _NEAR_ORDERS * spacing))))
    geometry = Geometry(centre, half, (inner, reach))
    sigma = pixel_sigma(expected)
    pattern = np.append(np.deg2rad(angles), spacing)
    state, orders = first_fit(difference, usable, sigma, near, pattern, first_source(near))
    state, _ = iterate(orders, near, state)
    state, orders = first_fit(difference, usable, sigma, geometry, state.pattern, state.source)
    state, result = iterate(orders, geometry, state)
    # Fit once more, with weights from the light of the fitted model.
    rest = (expected - smooth(difference, usable, 2.0))[orders.row, orders.column]
    orders = replace(orders, sigma=pixel_sigma(result.light + rest))
    state, result = iterate(orders, geometry, state)
    return _measurement(orders, geometry, state, result, halo)


def _measurement(
    orders: Orders, geometry: Geometry, state: FitState, result: FitResult, halo: Plane
) -> ArmMeasurement:
    """The measurement, with arms sorted by angle."""
    arms = state.pattern.size - 1
    angles = (np.rad2deg(state.pattern[:-1]) + 90.0) % 180.0 - 90.0
    by_angle = np.argsort(angles)
    place = np.argsort(by_angle)
    x, y = order_positions(geometry.centre, state.pattern, orders.arm, orders.k)
    peaks = tuple(
        Peak(int(place[arm]), int(k), float(px), float(py))
        for arm, k, px, py in zip(orders.arm, orders.k, x, y, strict=True)
    )
    model, fitted = np.zeros(halo.shape), np.zeros(halo.shape, dtype=bool)
    model[orders.row, orders.column] = result.light + halo[orders.row, orders.column]
    fitted[orders.row, orders.column] = True
    return ArmMeasurement(
        angles_deg=tuple(float(a) for a in angles[by_angle]),
        angles_sigma_deg=tuple(float(s) for s in np.rad2deg(result.error[:arms])[by_angle]),
        spacing_px=float(state.pattern[-1]),
        spacing_sigma_px=float(result.error[arms]),
        centre_xy=geometry.centre,
        reduced_chi2=result.reduced_chi2,
        peaks=peaks,
        stopped_because=result.why,
        model=model,
        fitted=fitted,
    )


# --- the image --------------------------------------------------------------------------------------------


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
        raise DataError(
            "all-masked",
            f"expected some usable pixels; got {usable.size} pixels, all masked: use another image",
        )
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
        raise DataError(
            "no-flare",
            f"expected a flare, a spot at least {_FLARE_SIGMA:g} times the scatter ({scatter:.3g}) above the median "
            f"({middle:.3g}); got {peak:.3g} at the brightest pixel: give its centre, or use another image",
        )
    brightest = np.unravel_index(int(np.where(usable, smoothed, -np.inf).argmax()), smoothed.shape)
    return (float(brightest[1]), float(brightest[0])), radius


def smooth(plane: Plane, usable: Flags, width_px: float) -> Plane:
    """Gaussian-weighted mean of the usable pixels; 0 where no usable pixel is near."""
    weight = ndimage.gaussian_filter(usable.astype(np.float64), width_px)
    total = ndimage.gaussian_filter(np.where(usable, plane, 0.0), width_px)
    return np.divide(total, weight, out=np.zeros_like(total), where=weight > 1e-6)


def expected_light(image: Plane, reference: Plane | None, usable: Flags) -> Plane:
    """The light (DN, smoothed) that causes the photon noise of the difference: the image, plus the reference if it is
    given.
    """
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


# --- first values of angles and spacing --------------------------------------------------------------------


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
    """The image without its smooth part, divided by its local standard deviation, clipped at +-_CUT; 0 where
    unusable.
    """
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
