"""The diffraction orders along the arms, Eq. (1) of `arms`, and the least-squares fit of Eq. (2).

The fitted quantities are amplitudes, source, angles and spacing. First, amplitudes and source are fitted in turn, at
fixed angles and spacing. Then Gauss-Newton steps fit all quantities together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from psfcore.arrays import Flags, Plane, Vector
from psfcore.errors import DataError

Indices = NDArray[np.intp]

NEEDED_ORDERS_AN_ARM = 3
KNOT_PX = 1.0  # distance between the knots of the spline
ORDER_SIGMA = 5.0
_USABLE_SHARE = 0.7  # an order is fitted if at least this fraction of the pixels around it is usable
_STEPS = 30  # largest number of Gauss-Newton steps
_TURNS = 3  # number of fits of the amplitudes; between two of them the source is fitted
_CONVERGED = 1e-3  # the fit stops if angles and spacing change by less than this fraction of their errors
_RANK = 1e-11  # eigenvalues below this fraction of the largest eigenvalue are taken as 0


@dataclass(frozen=True)
class Geometry:
    """The quantities that the fit does not change.

    Attributes
    ----------
    centre
        The centre of the flare (x, y), px.
    half_px
        Half size of S.
    radii_px
        The smallest and the largest radius of the fitted orders.
    """

    centre: tuple[float, float]
    half_px: float
    radii_px: tuple[float, float]

    @property
    def reach(self) -> int:
        """The number of knots of S on each side of the middle knot."""
        return int(np.ceil(self.half_px / KNOT_PX))

    @property
    def disc(self) -> Flags:
        """A mask [y, x] of the knots of S: True for the fitted knots. They lie within the half size of S."""
        knots = np.arange(-self.reach, self.reach + 1) * KNOT_PX
        return np.asarray(np.hypot(knots[:, None], knots) <= self.half_px + 0.25)

    def source(self, coefficients: Vector) -> Plane:
        """The coefficients of S on all knots [y, x]: these coefficients on the disc, and 0 outside."""
        plane = np.zeros(self.disc.shape)
        plane[self.disc] = coefficients
        return plane


@dataclass(frozen=True)
class Orders:
    """The fitted orders, and the pixels around them.

    Each order has one value of arm (its index) and of k. Each pixel has one value of row, column, nearest (index of the
    nearest order), value (of the difference) and sigma. number [y, x] is the index of a pixel in these lists, or -1.
    """

    arm: Indices
    k: Vector
    row: Indices
    column: Indices
    nearest: Indices
    value: Vector
    sigma: Vector
    number: Indices

    def planes(self) -> list[tuple[Indices, Plane]]:
        """For each order with at least 3 pixels: the indices of its pixels, and a basis [pixel, 3].

        The basis is orthonormal. It spans the functions that are linear in x and y on these pixels, divided by sigma.
        """
        found = []
        by_order = np.argsort(self.nearest, kind="stable")
        for pixels in np.split(by_order, np.cumsum(np.bincount(self.nearest))[:-1]):
            if pixels.size < 3:
                continue
            x, y = (place[pixels] - place[pixels].mean() for place in (self.column, self.row))
            linear = np.stack((np.ones(pixels.size), x, y), axis=1)
            basis, _ = np.linalg.qr(linear / self.sigma[pixels, None])
            found.append((pixels, basis))
        return found


def orders_between(pattern: Vector, radii_px: tuple[float, float]) -> tuple[Indices, Vector]:
    """Arm index and k of all orders between two radii (px)."""
    first, last = int(np.ceil(radii_px[0] / pattern[-1])), int(radii_px[1] / pattern[-1])
    one_side = np.arange(max(first, 1), last + 1, dtype=np.float64)
    k = np.concatenate((-one_side[::-1], one_side))
    arms = pattern.size - 1
    return np.repeat(np.arange(arms), k.size), np.tile(k, arms)


def order_positions(
    centre: tuple[float, float], pattern: Vector, arm: Indices, k: Vector
) -> tuple[Vector, Vector]:
    """Eq. (1): x and y of each order, px."""
    along = k * pattern[-1]
    return centre[0] + along * np.cos(pattern[arm]), centre[1] + along * np.sin(pattern[arm])


def select_pixels(
    difference: Plane,
    usable: Flags,
    sigma: Plane,
    geometry: Geometry,
    pattern: Vector,
    arm: Indices,
    k: Vector,
) -> Orders:
    """The orders that lie on usable pixels, and the pixels around them."""
    ny, nx = difference.shape
    x, y = order_positions(geometry.centre, pattern, arm, k)
    half = round(geometry.half_px)
    on = (x >= half) & (x <= nx - 1 - half) & (y >= half) & (y <= ny - 1 - half)
    full = ndimage.uniform_filter(usable.astype(np.float64), 2 * half + 1)
    on[on] &= full[np.rint(y[on]).astype(int), np.rint(x[on]).astype(int)] >= _USABLE_SHARE
    arm, k, x, y = arm[on], k[on], x[on], y[on]
    distance = np.full(difference.shape, np.inf)
    nearest = np.zeros(difference.shape, dtype=np.intp)
    for index, (x0, y0) in enumerate(zip(x, y, strict=True)):
        top, left = round(float(y0)) - half, round(float(x0)) - half
        rows, columns = slice(top, top + 2 * half + 1), slice(left, left + 2 * half + 1)
        yy, xx = np.ogrid[rows, columns]
        apart = np.hypot(yy - y0, xx - x0)
        closer = apart < distance[rows, columns]
        distance[rows, columns][closer] = apart[closer]
        nearest[rows, columns][closer] = index
    row, column = np.nonzero(np.isfinite(distance) & usable)
    number = np.full(difference.shape, -1, dtype=np.intp)
    number[row, column] = np.arange(row.size)
    return Orders(
        arm=arm,
        k=k,
        row=row,
        column=column,
        nearest=nearest[row, column],
        value=difference[row, column],
        sigma=sigma[row, column],
        number=number,
    )


def check_enough_orders(arm: Indices, arms: int) -> None:
    """Raise DataError "too-few-peaks" if an arm has fewer than NEEDED_ORDERS_AN_ARM orders."""
    count = np.bincount(arm, minlength=arms)
    if count.min() < NEEDED_ORDERS_AN_ARM:
        raise DataError(
            "too-few-peaks",
            f"expected at least {NEEDED_ORDERS_AN_ARM} orders above {ORDER_SIGMA:g} sigma on each arm; got "
            f"{', '.join(map(str, count))}: fit fewer arms, or use a brighter flare",
        )


@dataclass(frozen=True)
class FitState:
    """The fitted quantities.

    Attributes
    ----------
    pattern
        The angles (radian), then the spacing (px).
    amplitude
        The amplitudes A_ak.
    source
        The coefficients of S [y, x].
    """

    pattern: Vector
    amplitude: Vector
    source: Plane

    def moved(self, step: Vector, geometry: Geometry) -> FitState:
        """The state after a step in all quantities, in the order pattern, amplitude, source."""
        one, two = self.pattern.size, self.pattern.size + self.amplitude.size
        return FitState(
            self.pattern + step[:one],
            self.amplitude + step[one:two],
            self.source + geometry.source(step[two:]),
        )


@dataclass(frozen=True)
class FitResult:
    """The result of a fit, apart from its state.

    Attributes
    ----------
    error
        The standard errors of pattern and amplitudes.
    reduced_chi2
        The chi^2 divided by the degrees of freedom, which are the number of fitted pixels minus the number of fitted
        quantities.
    light
        The fitted light of each pixel, DN.
    why
        The reason why the fit stopped.
    """

    error: Vector
    reduced_chi2: float
    light: Vector
    why: str


def first_fit(
    difference: Plane,
    usable: Flags,
    sigma: Plane,
    geometry: Geometry,
    pattern: Vector,
    source: Plane,
) -> tuple[FitState, Orders]:
    """Fit amplitudes and S at given angles and spacing; keep the significant orders.

    Raises DataError "too-few-peaks".
    """
    arm, k = orders_between(pattern, geometry.radii_px)
    state = FitState(pattern, np.ones(arm.size), source)
    for _ in range(2):  # first with all orders, then with the significant orders
        orders = select_pixels(difference, usable, sigma, geometry, pattern, arm, k)
        # If the source is near a corner, an arm may have no order on the image.
        check_enough_orders(orders.arm, pattern.size - 1)
        state, error = _alternate(orders, geometry, state)
        significant = state.amplitude > ORDER_SIGMA * error
        arm, k = orders.arm[significant], orders.k[significant]
        check_enough_orders(arm, pattern.size - 1)
    orders = select_pixels(difference, usable, sigma, geometry, pattern, arm, k)
    return _alternate(orders, geometry, state)[0], orders


def iterate(orders: Orders, geometry: Geometry, state: FitState) -> tuple[FitState, FitResult]:
    """Fit all quantities together by Gauss-Newton steps. The values in `state` must be close to the solution."""
    weight = 1 / orders.sigma
    of_pattern = state.pattern.size
    why = f"the limit of {_STEPS} steps was reached"
    for _ in range(_STEPS):
        bases = _bases(orders, geometry, state.pattern)
        columns = np.hstack(
            (
                _columns_of_pattern(orders, bases, state),
                _columns_of_stamps(orders, bases, bases.stamps(state.source)),
                _columns_of_source(orders, bases, geometry, state.amplitude),
            )
        )
        left = (orders.value - _light(orders, bases, state)) * weight
        step, covariance, rank = _solve(
            _without_planes(orders, columns * weight[:, None]), _without_planes(orders, left)
        )
        state = state.moved(step, geometry)
        error = np.sqrt(np.diag(covariance))[: of_pattern + state.amplitude.size]
        if np.all(np.abs(step[:of_pattern]) < _CONVERGED * error[:of_pattern]):
            why = f"angles and spacing changed by less than {_CONVERGED:g} of their errors"
            break
    light = _light(orders, _bases(orders, geometry, state.pattern), state)
    left = _without_planes(orders, (orders.value - light) * weight)
    freedom = max(orders.value.size - rank - 3 * state.amplitude.size, 1)
    reduced_chi2 = float(left @ left) / freedom
    return state, FitResult(error * np.sqrt(reduced_chi2), reduced_chi2, orders.value - left / weight, why)


def _alternate(orders: Orders, geometry: Geometry, state: FitState) -> tuple[FitState, Vector]:
    """Fit amplitudes and S in turn at given angles and spacing; return the state and the errors of the amplitudes."""
    bases = _bases(orders, geometry, state.pattern)
    weight = 1 / orders.sigma
    target = _without_planes(orders, orders.value * weight)
    source = state.source
    for turn in range(_TURNS):
        columns = _columns_of_stamps(orders, bases, bases.stamps(source)) * weight[:, None]
        columns = _without_planes(orders, columns)
        amplitude, covariance, rank = _solve(columns, target)
        if turn < _TURNS - 1:
            shaped = _columns_of_source(orders, bases, geometry, np.maximum(amplitude, 0.0)) * weight[:, None]
            found, _, _ = _solve(_without_planes(orders, shaped), target)
            source = geometry.source(found)
    left = target - columns @ amplitude
    chi2 = float(left @ left) / max(target.size - 3 * amplitude.size - rank, 1)
    return FitState(state.pattern, amplitude, source), np.sqrt(np.diag(covariance) * chi2)


def first_source(geometry: Geometry) -> Plane:
    """The coefficients of S from which the fit starts: a round Gaussian."""
    knots = np.arange(-geometry.reach, geometry.reach + 1) * KNOT_PX
    line = np.exp(-0.5 * (knots / (0.4 * geometry.half_px)) ** 2)
    return np.outer(line, line)


@dataclass(frozen=True)
class _Bases:
    """The cubic splines and their slopes at the pixels around each order [order, pixel of the box, coefficient].

    `index` [order, y, x] is the index of the pixel among the fitted pixels, or -1.
    """

    index: Indices
    x: Vector
    y: Vector
    slope_x: Vector
    slope_y: Vector

    def stamps(self, source: Plane, *, slope: str = "") -> Vector:
        """The values of S on the box of each order [order, y, x].

        Parameters
        ----------
        slope
            "x" or "y" for the derivative along this axis.
        """
        along_x = self.slope_x if slope == "x" else self.x
        along_y = self.slope_y if slope == "y" else self.y
        return np.asarray(along_y @ source @ along_x.transpose(0, 2, 1))


def _bases(orders: Orders, geometry: Geometry, pattern: Vector) -> _Bases:
    """Evaluate the splines at the pixels around each order."""
    box_px = int(np.ceil((geometry.reach + 2) * KNOT_PX))
    box = np.arange(-box_px, box_px + 1)
    coefficients = np.arange(-geometry.reach, geometry.reach + 1)
    index, lines, slopes = [], [], []
    for place, limit in zip(
        order_positions(geometry.centre, pattern, orders.arm, orders.k),
        orders.number.shape[::-1],
        strict=True,
    ):
        pixels = np.rint(place).astype(np.intp)[:, None] + box
        offset = (pixels - place[:, None])[:, :, None] / KNOT_PX - coefficients
        lines.append(_spline(offset))
        slopes.append(_spline_slope(offset) / KNOT_PX)
        index.append(np.where((pixels >= 0) & (pixels < limit), pixels, -1))
    columns, rows = index
    inside = (rows[:, :, None] >= 0) & (columns[:, None, :] >= 0)
    number = np.where(inside, orders.number[rows[:, :, None], columns[:, None, :]], -1)
    return _Bases(index=number, x=lines[0], y=lines[1], slope_x=slopes[0], slope_y=slopes[1])


def _spline(t: Vector) -> Vector:
    """The cubic B-spline."""
    u = np.abs(t)
    near, far = 2 / 3 - u**2 + u**3 / 2, (2 - u) ** 3 / 6
    return np.where(u < 1, near, np.where(u < 2, far, 0.0))


def _spline_slope(t: Vector) -> Vector:
    """Derivative of the cubic B-spline."""
    u = np.abs(t)
    near, far = -2 * u + 1.5 * u**2, -((2 - u) ** 2) / 2
    return np.sign(t) * np.where(u < 1, near, np.where(u < 2, far, 0.0))


def _light(orders: Orders, bases: _Bases, state: FitState) -> Vector:
    """The sum of A_ak S in Eq. (2) at the fitted pixels."""
    return _added_up(orders, bases, state.amplitude[:, None, None] * bases.stamps(state.source))


def _added_up(orders: Orders, bases: _Bases, stamps: Vector) -> Vector:
    """The sum of the stamps of all orders, at each fitted pixel."""
    on = bases.index >= 0
    total = np.bincount(bases.index[on], weights=stamps[on], minlength=orders.value.size)
    return np.asarray(total, dtype=np.float64)


def _columns_of_stamps(orders: Orders, bases: _Bases, stamps: Vector) -> Plane:
    """Columns [pixel, order] of the Jacobian for the amplitudes: each column is the stamp (S) of one order."""
    columns = np.zeros((orders.value.size, orders.k.size))
    which, y, x = np.nonzero(bases.index >= 0)
    columns[bases.index[which, y, x], which] = stamps[which, y, x]
    return columns


def _columns_of_source(orders: Orders, bases: _Bases, geometry: Geometry, amplitude: Vector) -> Plane:
    """Derivatives of the model by the spline coefficients of the source picture S [fitted pixel, knot of the
    disc].
    """
    row, column = np.nonzero(geometry.disc)
    columns = np.zeros((orders.value.size, row.size))
    for which, a in enumerate(amplitude):
        y, x = np.nonzero(bases.index[which] >= 0)
        product = bases.y[which, y][:, row] * bases.x[which, x][:, column]
        columns[bases.index[which, y, x]] += a * product
    return columns


def _columns_of_pattern(orders: Orders, bases: _Bases, state: FitState) -> Plane:
    """Columns of the Jacobian for each angle (radian) and for the spacing, from Eq. (1) and (2)."""
    spacing = state.pattern[-1]
    cosine, sine = np.cos(state.pattern[orders.arm]), np.sin(state.pattern[orders.arm])
    to_x = -state.amplitude[:, None, None] * bases.stamps(state.source, slope="x")
    to_y = -state.amplitude[:, None, None] * bases.stamps(state.source, slope="y")
    k = orders.k[:, None, None]
    outward = k * (cosine[:, None, None] * to_x + sine[:, None, None] * to_y)
    across = k * spacing * (cosine[:, None, None] * to_y - sine[:, None, None] * to_x)
    by_angle = [
        _added_up(orders, bases, across * (orders.arm == arm)[:, None, None])
        for arm in range(state.pattern.size - 1)
    ]
    return np.stack((*by_angle, _added_up(orders, bases, outward)), axis=1)


def _without_planes(orders: Orders, weighted: Vector) -> Vector:
    """Subtract from each column its best-fitting planes around the orders.

    With these columns the fit needs no parameters for the planes, and its solution and errors stay the same.

    Parameters
    ----------
    weighted
        The columns, or one column, already divided by sigma.
    """
    rest = weighted.copy()
    for pixels, basis in orders.planes():
        rest[pixels] -= basis @ (basis.T @ rest[pixels])
    return rest


def _solve(columns: Plane, target: Vector) -> tuple[Vector, Plane, int]:
    """Solve the least-squares problem with the smallest norm; return solution, covariance and rank.

    Some combinations of parameters are undetermined: the planes can compensate for a constant and for slopes of S, and
    the amplitudes can compensate for a factor of S. The solution is 0 along these combinations. Neither the angles nor
    the spacing depend on them.
    """
    scale = np.sqrt((columns**2).sum(axis=0))
    scale[scale == 0] = 1.0
    scaled = columns / scale
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    kept = values > _RANK * values[-1]
    vectors = vectors[:, kept]
    covariance = (vectors / values[kept]) @ vectors.T / np.outer(scale, scale)
    return covariance @ (columns.T @ target), covariance, int(kept.sum())
