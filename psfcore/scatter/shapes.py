"""Shapes of diffuse scatter that can be fitted to a transit.

Eq. (2) comes from Hofmeister et al., The point-spread function of HRI_EUV, section "The diffuse scattered light". Every
shape is a falloff: f(d) is proportional to the light that is scattered by the offset d = (dx, dy). The scatter kernel s
is scaled so that its weights outside the central pixel sum to `total` on the full reach:

    s(d) = total f(d) / sum over d != 0 of f   for d != 0,   s(0) = 1 - total        Eq. (1)

    softened power law            f = (b + r)^-c, the shape of the paper              Eq. (2)
    stretched                     Eq. (2) with r = |exp(-[[p, q], [q, -p]]) d|        Eq. (3)
    one-sided                     Eq. (2) times 1 + x_share cos t + y_share sin t      Eq. (4)
    knee                          Eq. (2) times (1 + (r / r_k)^2)^(-bend / 2)          Eq. (5)
    two power laws                Eq. (2) + a second power law, (b_2 + r)^-c           Eq. (6)
    core                          Eq. (2) + a Gaussian                                 Eq. (7)

For Eq. (3), a stretch by the factor 1 + s along the angle t corresponds to ln(1 + s) = hypot(p, q) and 2 t = atan2(q,
p). At zero stretch the angle is not defined, but the kernel is a smooth function of p and q. In Eq. (4), t is the
direction of d. In Eq. (6) and (7), the second term contains a fraction of `total` (halo_share, core_share).

The fit uses unbounded coordinates instead of the parameters: the logarithm of a positive number, the logit of a
fraction.

| symbol | name | unit |
|---|---|---|
| b, b_2, r_k, sigma | b_px, halo_b_px, knee_px, core_px | px |
| c, bend | c, bend | - |
| p, q | stretch_p, stretch_q | - |
| r | length of d | px |
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from psfcore.arrays import Kernel, Matrix, Vector
from psfcore.compiled import compiled
from psfcore.errors import DataError
from psfcore.psf import REACH_GRID_PX, crop_centred, squared_radii

Values = Mapping[str, float]

FARTHEST = 700.0  # exp of a larger coordinate is no double
DIFFERENCE = 1e-3  # step of a coordinate for central differences
HALO_B_PX = 120.0
KNEE_PX = 100.0
CORE_PX = 1.5


@dataclass(frozen=True)
class Parameter:
    """A parameter of a shape.

    Attributes
    ----------
    start
        The value at which a fit starts.
    scale
        The function that turns a value into the unbounded coordinate.
    largest_step
        The largest change of the coordinate in one round of the fit.
    """

    name: str
    unit: str
    start: float
    scale: Literal["log", "logit", "linear"]
    largest_step: float
    meaning: str

    def coordinate(self, value: float) -> float:
        """The unbounded coordinate that corresponds to a value."""
        if self.scale == "log":
            return math.log(value)
        return math.log(value / (1 - value)) if self.scale == "logit" else value

    def value(self, coordinate: float) -> float:
        """The value at a coordinate. Raises DataError "transit-says-too-little" if a fit left the range of numbers."""
        if self.scale != "linear" and not abs(coordinate) < FARTHEST:
            raise DataError(
                "transit-says-too-little",
                f"expected images that determine {self.name}; the fit left the range of its values: add images, or "
                "fit a shape with fewer parameters",
            )
        if self.scale == "log":
            return math.exp(coordinate)
        return 1 / (1 + math.exp(-coordinate)) if self.scale == "logit" else coordinate

    def slope(self, coordinate: float) -> float:
        """The derivative d value / d coordinate."""
        value = self.value(coordinate)
        if self.scale == "log":
            return value
        return value * (1 - value) if self.scale == "logit" else 1.0


Falloff = Callable[[Values, int], Kernel]  # parameters and size to f on a (size, size) array; not normalised
Radial = Callable[[Vector], Vector]  # maps radii (px) to f at these radii; f is not normalised


@dataclass(frozen=True)
class Shape:
    """A shape of scatter. An isotropic shape has `radial`, a function of the radius; any other shape has `falloff`."""

    name: str
    parameters: tuple[Parameter, ...]
    radial: Callable[[Values], Radial] | None = None
    falloff: Falloff | None = None

    @property
    def isotropic(self) -> bool:
        """Whether the scatter is the same in all directions."""
        return self.radial is not None

    @property
    def start(self) -> Vector:
        """Coordinates at which a fit starts."""
        return np.array([p.coordinate(p.start) for p in self.parameters])

    @property
    def names(self) -> tuple[str, ...]:
        """Parameter names, in order."""
        return tuple(p.name for p in self.parameters)

    def values(self, coordinates: Vector) -> dict[str, float]:
        """Parameter values by name at these coordinates."""
        return {p.name: p.value(float(q)) for p, q in zip(self.parameters, coordinates, strict=True)}

    def value_sigma(self, coordinates: Vector, covariance: Matrix) -> dict[str, float]:
        """Standard errors of the parameters by name.

        Parameters
        ----------
        covariance
            Covariance matrix of the coordinates.
        """
        return {
            p.name: abs(p.slope(float(q))) * float(sigma)
            for p, q, sigma in zip(self.parameters, coordinates, np.sqrt(np.diag(covariance)), strict=True)
        }

    def described(self, values: Values, sigma: Values) -> dict[str, dict[str, float | str]]:
        """The parameters by name: value, standard error (sigma), unit and meaning."""
        return {
            p.name: {"value": values[p.name], "sigma": sigma[p.name], "unit": p.unit, "meaning": p.meaning}
            for p in self.parameters
        }

    def coordinates(self, values: Values) -> Vector:
        """Coordinates of these values. A parameter that is not in `values` gets the value at which a fit starts."""
        return np.array([p.coordinate(values.get(p.name, p.start)) for p in self.parameters])

    def length(self, step: Vector) -> float:
        """The length of a step: its largest change of a coordinate, in units of the largest step of this coordinate."""
        return float((np.abs(step) / np.array([p.largest_step for p in self.parameters])).max())

    def shortened(self, step: Vector) -> tuple[Vector, bool]:
        """Shorten a step if it changes a coordinate by more than the largest step of this coordinate.

        Returns the step, and True if it was not shortened.
        """
        length = self.length(step)
        return (step, True) if length <= 1 else (step / length, False)

    def kernel(self, coordinates: Vector, size: int) -> Kernel:
        """The scatter kernel [y, x] of Eq. (1) on (size, size), centre at [size // 2, size // 2]."""
        values = self.values(coordinates)
        if self.radial is not None:
            falloff_at, (r, count) = self.radial(values), pixel_radii(REACH_GRID_PX)
            whole = float((falloff_at(r) * count)[1:].sum())
            by_radius = falloff_at(pixel_radii(size)[0]) * (values["total"] / whole)
            by_radius[0] = 1 - values["total"]
            return np.asarray(by_radius[_radius_index(size)])
        assert self.falloff is not None
        reach = max(size, REACH_GRID_PX)
        falloff = self.falloff(values, reach)
        middle = reach // 2
        falloff[middle, middle] = 0.0
        within = crop_centred(falloff, (REACH_GRID_PX, REACH_GRID_PX))
        scaled = falloff * (values["total"] / within.sum())
        scaled[middle, middle] = 1 - values["total"]
        return crop_centred(scaled, (size, size))

    def slope(self, coordinates: Vector, k: int, size: int) -> Kernel:
        """The derivative of the kernel with respect to coordinate k, [y, x] on (size, size), from central
        differences.
        """
        step = np.zeros_like(coordinates)
        step[k] = DIFFERENCE
        ahead, behind = (self.kernel(coordinates + side * step, size) for side in (1, -1))
        ahead -= behind
        ahead /= 2 * DIFFERENCE
        return ahead


_POWER_LAW = (
    Parameter("b_px", "px", 6.0, "log", 0.5, "radius within which the power law flattens"),
    Parameter("c", "", 2.5, "linear", 0.3, "exponent of the power law"),
    Parameter("total", "", 0.4, "logit", 0.4, "fraction of the light that is scattered, on the full reach"),
)


def _softened(values: Values) -> Radial:
    return lambda r: np.asarray((values["b_px"] + r) ** -values["c"])


def _stretched(values: Values, size: int) -> Kernel:
    return np.asarray(
        _power_law_of_ellipses(
            size, values["b_px"], values["c"], values.get("stretch_p", 0.0), values.get("stretch_q", 0.0)
        )
    )


def _one_sided(values: Values, size: int) -> Kernel:
    d = np.arange(size) - size // 2
    r = np.hypot(d[:, None], d[None, :])
    r[size // 2, size // 2] = 1.0
    lean = 1 + (values["x_share"] * d[None, :] + values["y_share"] * d[:, None]) / r  # Eq. (4)
    isotropic = _softened(values)(pixel_radii(size)[0])[_radius_index(size)]
    return np.asarray(isotropic * np.maximum(lean, 0.0))


def _knee(values: Values) -> Radial:
    first = _softened(values)
    return lambda r: np.asarray(first(r) * (1 + (r / KNEE_PX) ** 2) ** (-values["bend"] / 2))  # Eq. (5)


def _mixed(values: Values, share: float, second: Radial) -> Radial:
    """Eq. (2) and a second term, which contains the fraction `share` of `total`."""
    first, (r, count) = _softened(values), pixel_radii(REACH_GRID_PX)
    ratio = float((first(r) * count)[1:].sum()) / float((second(r) * count)[1:].sum())
    return lambda r: np.asarray((1 - share) * first(r) + share * ratio * second(r))


def _two(values: Values) -> Radial:
    return _mixed(values, values["halo_share"], lambda r: (HALO_B_PX + r) ** -values["c"])  # Eq. (6)


def _core(values: Values) -> Radial:
    return _mixed(values, values["core_share"], lambda r: np.exp(-0.5 * (r / CORE_PX) ** 2))  # Eq. (7)


def _more(name: str, largest_step: float, meaning: str) -> Parameter:
    """A parameter beside those of the power law; if it is zero, the shape is the power law."""
    return Parameter(name, "", 0.0, "linear", largest_step, meaning)


_ALONG_X = _more("stretch_p", 0.1, "ln(1 + stretch) along x")
_BY_COS = _more("stretch_p", 0.1, "ln(1 + stretch) times cos of twice its angle")
_BY_SIN = _more("stretch_q", 0.1, "ln(1 + stretch) times sin of twice its angle")
_TOWARDS_X = _more("x_share", 0.2, "excess towards +x, deficit towards -x")
_TOWARDS_Y = _more("y_share", 0.2, "excess towards +y, deficit towards -y")
_BEND = _more("bend", 0.3, f"steepening beyond {KNEE_PX:g} px")
_HALO = _more(
    "halo_share", 0.1, f"fraction of the scatter in a second power law, softened at {HALO_B_PX:g} px"
)
_CORE = _more("core_share", 0.1, f"fraction of the scatter in a Gaussian with a sigma of {CORE_PX:g} px")
SOFTENED_POWER_LAW = Shape("softened-power-law", _POWER_LAW, _softened)
SHAPES: dict[str, Shape] = {
    shape.name: shape
    for shape in (
        SOFTENED_POWER_LAW,
        Shape("stretched-along-x", (*_POWER_LAW, _ALONG_X), falloff=_stretched),
        Shape("stretched", (*_POWER_LAW, _BY_COS, _BY_SIN), falloff=_stretched),
        Shape("one-sided", (*_POWER_LAW, _TOWARDS_X, _TOWARDS_Y), falloff=_one_sided),
        Shape("knee", (*_POWER_LAW, _BEND), _knee),
        Shape("two-power-laws", (*_POWER_LAW, _HALO), _two),
        Shape("core", (*_POWER_LAW, _CORE), _core),
    )
}


def shape_named(name: str) -> Shape:
    """The shape with this name. Raises DataError "unknown-shape"."""
    if name not in SHAPES:
        raise DataError(
            "unknown-shape", f"expected a shape of scatter: {', '.join(SHAPES)}; got {name!r:.40}"
        )
    return SHAPES[name]


def stretch_of(values: Values) -> tuple[float, float]:
    """Stretch s and angle t of Eq. (3); t in degrees from +x towards +y, -90 to 90."""
    p, q = values.get("stretch_p", 0.0), values.get("stretch_q", 0.0)
    return math.expm1(math.hypot(p, q)), math.degrees(math.atan2(q, p)) / 2


@cache
def pixel_radii(size: int) -> tuple[Vector, Vector]:
    """The distinct radii of the pixels of a (size, size) square, in ascending order, and the number of pixels at
    each.
    """
    squares, count = np.unique(squared_radii((size, size)), return_counts=True)
    return np.sqrt(squares), count.astype(np.float64)


@cache
def _radius_index(size: int) -> NDArray[np.int32]:
    squares = squared_radii((size, size))
    position = np.zeros(int(squares.max()) + 1, np.int32)
    distinct = np.unique(squares)
    position[distinct] = np.arange(distinct.size)
    return np.asarray(position[squares])


@compiled()
def _power_law_of_ellipses(size, b, c, p, q):  # type: ignore[no-untyped-def]  # compiled
    """The falloff of Eq. (2) with the radius r of Eq. (3), on (size, size)."""
    out = np.empty((size, size))
    s = math.hypot(p, q)
    # For a symmetric 2 x 2 matrix S with trace 0 and eigenvalues s and -s, exp(-S) = cosh(s) - S sinh(s) / s.
    grow = math.cosh(s)
    shrink = math.sinh(s) / s if s > 1e-12 else 1.0
    xx, yy, xy = grow - p * shrink, grow + p * shrink, -q * shrink
    middle = size // 2
    for j in range(size):
        for i in range(size):
            dx, dy = float(i - middle), float(j - middle)
            r = math.hypot(xx * dx + xy * dy, xy * dx + yy * dy)
            out[j, i] = math.exp(-c * math.log(b + r))
    return out
