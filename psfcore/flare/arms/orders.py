"""The diffraction orders along the arms: where they lie, Eq. (1) of `measure`, and the pixels around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from psfcore.errors import DataError
from psfcore.flare.arms.image import Flags, Plane

KNOT_PX = 1.0  # distance between the knots of the spline
NEEDED_ORDERS_AN_ARM = 3
ORDER_SIGMA = 5.0
_USABLE_SHARE = 0.7  # an order is fitted if at least this fraction of the pixels around it is usable


@dataclass(frozen=True)
class Geometry:
    """The quantities that the fit does not change.

    centre: (x, y) px. half_px: half size of S. radii_px: the smallest and the largest radius of the fitted orders.
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

    def source(self, coefficients: NDArray[np.float64]) -> Plane:
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

    arm: NDArray[np.intp]
    k: NDArray[np.float64]
    row: NDArray[np.intp]
    column: NDArray[np.intp]
    nearest: NDArray[np.intp]
    value: NDArray[np.float64]
    sigma: NDArray[np.float64]
    number: NDArray[np.intp]

    def planes(self) -> list[tuple[NDArray[np.intp], Plane]]:
        """For each order with at least 3 pixels: the indices of its pixels, and a basis [pixel, 3].

        The basis is orthonormal. It spans the functions that are linear in x and y on these pixels, divided by sigma.
        """
        found = []
        by_order = np.argsort(self.nearest, kind="stable")
        for pixels in np.split(by_order, np.cumsum(np.bincount(self.nearest))[:-1]):
            if pixels.size < 3:
                continue
            flat = np.ones(pixels.size)
            x, y = (
                self.column[pixels] - self.column[pixels].mean(),
                self.row[pixels] - self.row[pixels].mean(),
            )
            basis, _ = np.linalg.qr(np.stack((flat, x, y), axis=1) / self.sigma[pixels, None])
            found.append((pixels, basis))
        return found


def orders_between(
    pattern: NDArray[np.float64], radii_px: tuple[float, float]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Arm index and k of all orders between two radii (px)."""
    first, last = int(np.ceil(radii_px[0] / pattern[-1])), int(radii_px[1] / pattern[-1])
    one_side = np.arange(max(first, 1), last + 1, dtype=np.float64)
    k = np.concatenate((-one_side[::-1], one_side))
    arms = pattern.size - 1
    return np.repeat(np.arange(arms), k.size), np.tile(k, arms)


def order_positions(
    centre: tuple[float, float], pattern: NDArray[np.float64], arm: NDArray[np.intp], k: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Eq. (1): x and y of each order, px."""
    along = k * pattern[-1]
    return centre[0] + along * np.cos(pattern[arm]), centre[1] + along * np.sin(pattern[arm])


def select_pixels(
    difference: Plane,
    usable: Flags,
    sigma: Plane,
    geometry: Geometry,
    pattern: NDArray[np.float64],
    arm: NDArray[np.intp],
    k: NDArray[np.float64],
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


def check_enough_orders(arm: NDArray[np.intp], arms: int) -> None:
    """Raise DataError "too-few-peaks" if an arm has fewer than NEEDED_ORDERS_AN_ARM orders."""
    count = np.bincount(arm, minlength=arms)
    if count.min() < NEEDED_ORDERS_AN_ARM:
        wanted = f"at least {NEEDED_ORDERS_AN_ARM} orders above {ORDER_SIGMA:g} sigma on each arm"
        raise DataError("too-few-peaks", f"expected {wanted}; got {', '.join(map(str, count))}")
