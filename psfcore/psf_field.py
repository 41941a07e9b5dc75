"""A PSF that changes over the field: its terms, and where the pixels of an image lie on the detector.

    K(u, v) = K0 + sum over m of u^a v^b K_m                        Eq. (1)
    u = 2 x / (nx - 1) - 1,   v = 2 y / (ny - 1) - 1               Eq. (2)

Light from the pixel (x, y) of the detector, counted from 0, is spread by K(u, v). Beyond the edges of the detector, u
and v keep their values at the edge, -1 or 1. K_m may be negative; K may not.

| symbol | name | unit |
|---|---|---|
| K0, K_m | kernel of the PSF, `FieldTerm.kernel` | - |
| a, b | x_power, y_power | - |
| u, v | coordinates on the detector, from -1 to 1 | - |
| nx, ny | size of the detector | px |
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.arrays import Kernel, Vector, cut
from psfcore.errors import DataError
from psfcore.recipe import REACH_GRID_PX

MOST_POWERS = 4  # largest sum of the powers of a term
MOST_TERMS = sum(range(2, MOST_POWERS + 2))  # as many pairs of powers there are
# A weight below 0 is rounding if it is this small against the weights that it is the sum of: files hold float32.
ROUNDING = 1e-6
# Places along each axis at which weights are checked if a power is above 1; of powers up to 1, the edges have the
# extremes.
_CHECKED_PLACES = 17
_PIXELS_AT_ONCE = 2**18


@dataclass(frozen=True, eq=False)
class FieldTerm:
    """One term u^a v^b K_m of Eq. (1).

    Attributes
    ----------
    kernel
        The weights K_m [y, x] of any shape; the centre is [ny // 2, nx // 2].
    x_power, y_power
        The powers a and b.
    """

    kernel: Kernel
    x_power: int
    y_power: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "kernel", np.ascontiguousarray(self.kernel, dtype=np.float64))
        powers = (self.x_power, self.y_power)
        if min(powers) < 0 or not 1 <= sum(powers) <= MOST_POWERS:
            raise DataError(
                "psf-field",
                f"expected powers XPOWER and YPOWER of at least 0 whose sum is 1 to {MOST_POWERS}; got {powers[0]} and "
                f"{powers[1]}: correct the cards of the extension FIELD",
            )
        if self.kernel.ndim != 2 or not np.isfinite(self.kernel).all():
            raise DataError(
                "psf-field",
                f"expected finite weights with two axes in the term u^{powers[0]} v^{powers[1]}; got shape "
                f"{self.kernel.shape}: replace weights that are NaN or infinite, for example by 0",
            )


@dataclass(frozen=True)
class Place:
    """Where the pixels of an image lie on the detector, Eq. (2). Along each axis: the coordinate of the centre of the
    first pixel, and its change from pixel to pixel.
    """

    x: tuple[float, float]
    y: tuple[float, float]

    @classmethod
    def of_detector(cls, nx: int, ny: int) -> Place:
        """The pixels of a detector of nx x ny px. Raises DataError "psf-field" for fewer than 2 px."""
        if min(nx, ny) < 2:
            raise DataError(
                "psf-field",
                f"expected FIELDNX and FIELDNY of at least 2 px, the size of the detector; got {nx} and {ny}: correct "
                "the cards of the extension FIELD",
            )
        return cls((-1.0, 2 / (nx - 1)), (-1.0, 2 / (ny - 1)))

    @property
    def detector(self) -> tuple[int, int]:
        """Size (nx, ny) of the detector, in pixels of the image, if this is the place of a whole detector."""
        return round(2 * abs(self.x[0] / self.x[1])) + 1, round(2 * abs(self.y[0] / self.y[1])) + 1

    def from_pixel(self, x_px: float, y_px: float) -> Place:
        """The place of an image whose first pixel is the pixel (x_px, y_px) of this one."""
        return Place((self.x[0] + x_px * self.x[1], self.x[1]), (self.y[0] + y_px * self.y[1], self.y[1]))

    def binned(self, factor: int) -> Place:
        """The place of an image whose pixels are the means of factor x factor pixels of this one."""
        middle = self.from_pixel((factor - 1) / 2, (factor - 1) / 2)
        return Place((middle.x[0], factor * self.x[1]), (middle.y[0], factor * self.y[1]))

    def coordinates(self, shape: tuple[int, int]) -> tuple[Vector, Vector]:
        """The coordinates u (nx,) and v (ny,) of the pixels of an image of this shape, at most 1 in size."""
        (u, du), (v, dv) = self.x, self.y
        ny, nx = shape
        return np.clip(u + du * np.arange(nx), -1, 1), np.clip(v + dv * np.arange(ny), -1, 1)


def common_shape(kernels: Sequence[Kernel]) -> list[Kernel]:
    """Kernels on arrays of one shape that holds each of them, with the centre at [ny // 2, nx // 2]."""
    ny, nx = (max(one.shape[axis] for one in kernels) for axis in (0, 1))
    return [
        one
        if one.shape == (ny, nx)
        else cut(one, one.shape[0] // 2 - ny // 2, one.shape[1] // 2 - nx // 2, (ny, nx))
        for one in kernels
    ]


def nine_places() -> Iterator[tuple[float, float]]:
    """The coordinates (u, v) of nine places: the corners, the middles of the edges, and the centre of the detector."""
    return ((u, v) for v in (-1.0, 0.0, 1.0) for u in (-1.0, 0.0, 1.0))


def factors_at(terms: Sequence[FieldTerm], places: Iterable[tuple[float, float]]) -> NDArray[np.float64]:
    """The factors of K0 (1) and of the K_m of Eq. (1) at places (u, v): (places, 1 + terms)."""
    return np.array([[1.0, *(u**term.x_power * v**term.y_power for term in terms)] for u, v in places])


def check_field(
    kernel: Kernel, terms: Sequence[FieldTerm], place: Place | None, sums: tuple[float, float]
) -> None:
    """Raise DataError "psf-field" if the place is unknown, and "psf-negative" or "psf-sum", which name a place of the
    detector where K has a weight below 0 or a sum outside `sums`.
    """
    if place is None:
        raise DataError(
            "psf-field",
            "expected the size of the detector (FIELDNX, FIELDNY) beside terms FIELD; got none: give it",
        )
    places = checked_places(terms)
    factors = factors_at(terms, places)
    planes = common_shape([kernel, *(term.kernel for term in terms)])
    ny, nx = planes[0].shape
    # The sum is defined over the full reach; a larger array may sum to more.
    rows, columns = (
        slice(max(n - REACH_GRID_PX, 0) // 2, (max(n - REACH_GRID_PX, 0) // 2) + REACH_GRID_PX)
        for n in (ny, nx)
    )
    total = factors @ [plane[rows, columns].sum() for plane in planes]
    for index in (int(total.argmin()), int(total.argmax())):
        if not sums[0] < total[index] <= sums[1]:
            raise DataError(
                "psf-sum",
                f"expected weights that sum to {sums[0]:g} to {sums[1]:g} everywhere on the detector; got "
                f"{total[index]:.6g} at {_pixel(place, *places[index])}: correct the terms FIELD",
            )
    smallest, index = lowest_weight(planes, factors)
    if smallest < 0:
        raise DataError(
            "psf-negative",
            f"expected weights >= 0 everywhere on the detector; the smallest is {smallest:.3g} at "
            f"{_pixel(place, *places[index])}: correct the terms FIELD",
        )


def checked_places(terms: Sequence[FieldTerm]) -> list[tuple[float, float]]:
    """The coordinates (u, v) of the places at which a PSF is checked.

    If no power is above 1, K has its extremes at the corners of the detector.
    """
    curved = any(max(term.x_power, term.y_power) > 1 for term in terms)
    along = np.linspace(-1, 1, _CHECKED_PLACES if curved else 2)
    return [(float(u), float(v)) for v in along for u in along]


def lowest_weight(planes: Sequence[Kernel], factors: NDArray[np.float64]) -> tuple[float, int]:
    """The lowest weight of K and the number of its place; 0 if no weight is below 0 by more than rounding.

    Parameters
    ----------
    planes
        K0 and all K_m, of one shape.
    factors
        1 and all u^a v^b, (places, planes).
    """
    size = np.sum([np.abs(plane) for plane in planes], axis=0)
    # Most weights of K0 exceed all that the terms can subtract.
    doubtful = 2 * planes[0] < size * (1 - ROUNDING)
    weights = np.array([plane[doubtful] for plane in planes])
    rounding = ROUNDING * size[doubtful]
    lowest, place = 0.0, 0
    for first in range(0, weights.shape[1], _PIXELS_AT_ONCE):
        here = slice(first, first + _PIXELS_AT_ONCE)
        at_places = factors @ weights[:, here] + rounding[here]
        index = int(at_places.argmin())
        if at_places.flat[index] < lowest:
            lowest, place = float(at_places.flat[index]), index // at_places.shape[1]
    return lowest, place


def _pixel(place: Place, u: float, v: float) -> str:
    nx, ny = place.detector
    return f"x, y = {(u + 1) / 2 * (nx - 1):.0f}, {(v + 1) / 2 * (ny - 1):.0f} px of the detector"
