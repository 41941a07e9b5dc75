"""Angles and order spacing of the arms of a mesh's diffraction pattern around a bright compact source.

Hofmeister et al., The point-spread function of HRI_EUV, sections "Solar flare" and "Mesh geometry": the
diffraction pattern of a flare shows the orientation of the meshes and the spacing of their orders. The core of
the flare is saturated and its shape is unknown, so the shape S is fitted together with the pattern. The orders
are narrow, so every order is the same picture S of the source:

    r_ak = r_0 + k s e_a,   e_a = (cos t_a, sin t_a),   k = +-1, +-2, ...                            Eq. (1)
    d(r) = sum over a, k of A_ak S(r - r_ak) + plane_ak(r),                                          Eq. (2)

S is a cubic spline on the pixels. Each order has its own plane, on the pixels that are nearest to this order. Before the
fit, the smooth light around the source is subtracted: the median of each ring without the arms. Weighted least squares
(Gauss-Newton) fits all quantities together except r_0, because an error of r_0 only shifts S. The errors of t and s come
from the normal equations with all other quantities free; they are multiplied by the square root of the reduced chi^2.
S must be at least one pixel wide, as in real images. If each order of a point source filled a single pixel, the fit
could only find the centres of these pixels.

`arms_search` prepares the data and finds the first values; `arms_fit` implements Eq. (1) and Eq. (2).

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
from threadpoolctl import threadpool_limits

from psfcore.flare.arms_fit import (
    FitResult,
    FitState,
    Geometry,
    Orders,
    first_fit,
    first_source,
    iterate,
    order_positions,
)
from psfcore.flare.arms_search import (
    Flags,
    Plane,
    expected_light,
    pixel_sigma,
    prepared,
    ring_halo,
    search_arms,
    smooth,
    source_centre,
)

_LARGEST_SEARCH_PX = 300.0
_NEAR_PX = 100.0  # the first fit uses the orders within this radius
_NEAR_ORDERS = 6  # the first fit uses at least this number of orders on each side of an arm


@dataclass(frozen=True)
class Peak:
    """One diffraction order: index of its arm, order k, fitted position (px). significance: amplitude / error."""

    arm: int
    order: int
    x_px: float
    y_px: float
    significance: float


@dataclass(frozen=True)
class ArmMeasurement:
    """Directions of the arms and spacing of the orders, with 1-sigma errors.

    angles_deg: ascending, within -90 to 90. spacing_px: the same for all arms. chi2: the sum over the fitted pixels.
    degrees_of_freedom: the number of fitted pixels minus the number of fitted quantities. source [y, x]: the
    coefficients of S. model [y, x]: the fitted image. fitted [y, x]: True for the fitted pixels.
    """

    angles_deg: tuple[float, ...]
    angles_sigma_deg: tuple[float, ...]
    spacing_px: float
    spacing_sigma_px: float
    centre_xy: tuple[float, float]
    chi2: float
    degrees_of_freedom: int
    peaks: tuple[Peak, ...]
    steps_done: int
    stopped_because: str
    source: Plane
    model: Plane
    fitted: Flags

    @property
    def reduced_chi2(self) -> float:
        """chi^2 divided by the degrees of freedom. The errors are multiplied by its square root."""
        return self.chi2 / self.degrees_of_freedom


# The matrices are so small that threads cost several times more time than they save.
@threadpool_limits.wrap(limits=1, user_api="blas")
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

    centre_xy: position of the source; default: the middle of the largest saturated patch, else the brightest pixel.
    saturated: True where pixels must not be used; pixels that are not finite are never used.
    source_radius_px: half size of S; default: from the saturated patch. reach_px: largest radius at which orders are used.

    Raises DataError "arms-bad-input", "all-masked", "no-flare", "too-few-peaks".
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
    significance = state.amplitude / result.error[arms + 1 :]
    peaks = tuple(
        Peak(int(place[arm]), int(k), float(px), float(py), float(s))
        for arm, k, px, py, s in zip(orders.arm, orders.k, x, y, significance, strict=True)
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
        chi2=result.chi2,
        degrees_of_freedom=result.freedom,
        peaks=peaks,
        steps_done=result.done,
        stopped_because=result.why,
        source=state.source,
        model=model,
        fitted=fitted,
    )
