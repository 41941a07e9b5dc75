"""The arms of a mesh's diffraction pattern, measured round a bright compact source such as a flare.

Hofmeister et al., The point-spread function of HRI_EUV, sections "Solar flare" and "Mesh geometry": the
pattern of a flare tells the meshes' orientation and the spacing of their orders. The flare's core is
saturated and its form unknown, so the form is found together with the pattern: all orders of narrow peaks
are the same picture S of the source, at

    r_ak = r_0 + k s e_a,   e_a = (cos t_a, sin t_a),   k = +-1, +-2, ...                            Eq. (1)
    d(r) = sum over a, k of A_ak S(r - r_ak) + plane_ak(r),                                          Eq. (2)

S a cubic spline on the pixels, the plane that of the order nearest to r; the median of each ring away from
the arms is taken off before. Everything is fitted at once by
weighted least squares (Gauss-Newton); r_0 is not: where it is off, S shifts. Errors of t and s are those of
the normal equations with all else free, times the root of the reduced chi^2. S must be blurred over a pixel
or more, as images are: orders of a point that fill one pixel each lie where the pixels are.

First values come from a search: at which angles and spacing does the image, freed of what is smooth, have
more light at the orders than half-way between them.

| symbol | name | unit |
|---|---|---|
| d | difference: image, less the reference where there is one | DN |
| r_0 | centre_xy | px |
| t_a | angles_deg, from +x towards +y, -90 to 90: an arm is a line through the centre | degrees |
| s | spacing_px | px |
| A_ak, S | amplitudes, source | -, DN |
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from threadpoolctl import threadpool_limits

from psfcore.errors import DataError

SMALLEST_SPACING_PX = 4.0
LARGEST_SPACING_PX = 40.0
_SEARCH_STEP_DEG = 0.25
_SEARCH_STEP_PX = 0.25
_LARGEST_SEARCH_PX = 300.0
_APART_DEG = 4.0
_NEAR_PX = 100.0
_NEAR_ORDERS = 6
_NEEDED_PEAKS_AN_ARM = 3
_PEAK_SIGMA = 5.0
_STEPS = 30
_TURNS = 3
_KNOT_PX = 1.0
_CONVERGED = 1e-3  # of a standard error
_RANK = 1e-11
_CUT = 5.0
_FLARE_SIGMA = 10.0
_NEAR_DEG = 3.0
_USABLE_SHARE = 0.7

Plane = NDArray[np.float64]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Peak:
    """One order: its arm (index), its order k, where the fit puts it (px), amplitude over its error."""

    arm: int
    order: int
    x_px: float
    y_px: float
    significance: float


@dataclass(frozen=True)
class ArmMeasurement:
    """Directions of the arms and the distance between orders, with 1-sigma errors.

    angles_deg ascend within -90 to 90; spacing_px is common to all arms. chi2 is that of `pixels_used`
    pixels less `degrees_of_freedom` fitted figures' share; source [y, x] is S about the centre, with
    `model` and `fitted` [y, x] the fit and where it was made.
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
        """chi^2 over degrees of freedom, by which the squares of the errors are scaled."""
        return self.chi2 / self.degrees_of_freedom


# Factorisations so small that threads cost several times what they bring.
@threadpool_limits.wrap(limits=1, user_api="blas")
def measure_arms(
    image: Plane,
    centre_xy: tuple[float, float] | None = None,
    *,
    reference: Plane | None = None,
    noise: tuple[float, float] | None = None,
    saturated: Flags | None = None,
    n_arms: int = 2,
    spacing_range_px: tuple[float, float] = (SMALLEST_SPACING_PX, LARGEST_SPACING_PX),
    angles_near_deg: tuple[float, ...] | None = None,
    source_radius_px: float | None = None,
    reach_px: float | None = None,
) -> ArmMeasurement:
    """Measure `n_arms` lines of orders round a flare in `image` [y, x] (DN), or in image less `reference`.

    centre_xy: the source; without it the middle of the largest saturated patch, else the brightest spot.
    noise: (DN a photon, rms of the readout in DN); without it the scatter of the residuals serves.
    saturated: True where pixels are not to be trusted; not finite ones never are.
    angles_near_deg: look for one arm within 3 degrees of each. spacing_range_px: look only there.
    source_radius_px: half size of S, else from the saturated patch. reach_px: no orders farther out.

    Raises DataError "arms-bad-input", "all-masked", "no-flare", "too-few-peaks".
    """
    difference, usable, patch = _prepared(image, reference, saturated)
    centre, patch_radius = _centre(difference, usable, patch, centre_xy)
    half = source_radius_px or float(np.clip(patch_radius + 2.0, 3.0, 8.0))
    inner = 2 * (patch_radius + half)  # farther in, a plane does not follow the halo
    reach = min(reach_px or np.inf, _LARGEST_SEARCH_PX, float(np.hypot(*image.shape)))
    angles, spacing = _search(
        difference, usable, centre, n_arms, spacing_range_px, angles_near_deg, (inner, reach)
    )
    halo = _halo(difference, usable, centre, angles, half)
    difference = difference - halo
    expected = _expected(image, reference, usable)
    # Near orders first: far ones would be missed by what the search leaves open.
    near = _Grid(centre, half, (inner, min(reach, max(_NEAR_PX, inner + _NEAR_ORDERS * spacing))))
    grid = _Grid(centre, half, (inner, reach))
    sigma = _sigma(expected, noise)
    figures = np.append(np.deg2rad(angles), spacing)
    state, orders = _first_fit(difference, usable, sigma, near, figures, _first_source(near))
    state, _ = _iterate(orders, near, state)
    state, orders = _first_fit(difference, usable, sigma, grid, state.figures, state.source)
    state, result = _iterate(orders, grid, state)
    # Once more, weighted by the light that the fit expects.
    rest = (expected - _smooth(difference, usable, 2.0))[orders.row, orders.column]
    orders = replace(orders, sigma=_sigma(result.light + rest, noise))
    state, result = _iterate(orders, grid, state)
    return _measurement(orders, grid, state, result, halo)


def _prepared(image: Plane, reference: Plane | None, saturated: Flags | None) -> tuple[Plane, Flags, Flags]:
    """The difference (0 where unusable), where it can be used, and the largest saturated patch."""
    for name, plane in (("reference", reference), ("saturated", saturated)):
        if plane is not None and plane.shape != image.shape:
            raise DataError("arms-bad-input", f"expected {name} of {image.shape}; got {plane.shape}")
    difference = np.asarray(image if reference is None else image - reference, dtype=np.float64)
    usable = np.isfinite(difference)
    patch = np.zeros(image.shape, dtype=bool)
    if saturated is not None and saturated.any():
        usable &= ~saturated
        labels, _ = ndimage.label(saturated, structure=np.ones((3, 3)))
        patch = labels == np.bincount(labels.ravel())[1:].argmax() + 1
    if not usable.any():
        raise DataError("all-masked", f"expected pixels to measure; all {usable.size} are masked")
    return np.where(usable, difference, 0.0), usable, patch


def _centre(
    difference: Plane, usable: Flags, patch: Flags, given: tuple[float, float] | None
) -> tuple[tuple[float, float], float]:
    """Where the source is, (x, y) px, and the radius of its saturated patch, px."""
    radius = float(np.sqrt(patch.sum() / np.pi)) if patch.any() else 1.5
    if given is not None:
        ny, nx = difference.shape
        if not (0 <= given[0] < nx and 0 <= given[1] < ny):
            raise DataError("arms-bad-input", f"expected a centre on {nx} x {ny} px; got {given}")
        return given, radius
    if patch.any():
        y, x = np.nonzero(patch)
        return (float(x.mean()), float(y.mean())), radius
    smooth = _smooth(difference, usable, 1.0)
    values = smooth[usable]
    middle, scatter = _median_and_scatter(values)
    peak = float(values.max())
    if not peak > middle + _FLARE_SIGMA * scatter:
        wanted = f"a spot {_FLARE_SIGMA:g} times the scatter {scatter:.3g} above the median {middle:.3g}"
        raise DataError("no-flare", f"expected a flare, {wanted}; the brightest is {peak:.3g}")
    brightest = np.unravel_index(int(np.where(usable, smooth, -np.inf).argmax()), smooth.shape)
    return (float(brightest[1]), float(brightest[0])), radius


def _median_and_scatter(values: NDArray[np.float64]) -> tuple[float, float]:
    middle = float(np.median(values))
    return middle, float(1.4826 * np.median(np.abs(values - middle)))


def _smooth(plane: Plane, usable: Flags, width_px: float) -> Plane:
    """Gaussian mean over usable pixels; 0 where there are none near."""
    weight = ndimage.gaussian_filter(usable.astype(np.float64), width_px)
    total = ndimage.gaussian_filter(np.where(usable, plane, 0.0), width_px)
    return np.divide(total, weight, out=np.zeros_like(total), where=weight > 1e-6)


def _expected(image: Plane, reference: Plane | None, usable: Flags) -> Plane:
    """The light whose noise is in the difference, DN."""
    counts = image if reference is None else image + reference
    return _smooth(np.nan_to_num(counts), usable, 2.0)


def _sigma(expected: Plane, noise: tuple[float, float] | None) -> Plane:
    """Standard error of each pixel, DN; without `noise` in proportion to the root of the light."""
    gain, read = noise or (1.0, 0.0)
    floor = max(1e-3 * float(np.median(expected)), 1e-12)
    return np.asarray(np.sqrt(gain * np.maximum(expected, floor) + read**2))


def _halo(
    difference: Plane,
    usable: Flags,
    centre: tuple[float, float],
    angles_deg: NDArray[np.float64],
    half_px: float,
) -> Plane:
    """What is round about the source: the median of each ring, away from the arms, between rings a line."""
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


# --- first values -----------------------------------------------------------------------------------------


def _search(
    difference: Plane,
    usable: Flags,
    centre: tuple[float, float],
    n_arms: int,
    spacing_range_px: tuple[float, float],
    angles_near_deg: tuple[float, ...] | None,
    radii_px: tuple[float, float],
) -> tuple[NDArray[np.float64], float]:
    """Angles (degrees) and spacing (px) to start from.

    An arm is where orders stand out from what lies beside them and from what lies between them; the spacing
    is that at which, on those arms, orders stand out most from what lies between.
    """
    degrees = np.arange(-90.0, 90.0, _SEARCH_STEP_DEG)
    lit, seen = _along_lines(_contrast(difference, usable), usable, centre, degrees, radii_px)
    step = 2 * _SEARCH_STEP_PX / radii_px[1]
    low, high = spacing_range_px
    spacings = low * np.exp(np.arange(0.0, np.log(high / low) + step, step))
    scores = np.array([_scores(lit, seen, spacing, radii_px) for spacing in spacings])  # [spacing, 2, angle]
    found = _best_angles(degrees, scores.sum(axis=1).max(axis=0), n_arms, angles_near_deg)
    near = np.array([_between_deg(degrees, angle) <= 2 * _SEARCH_STEP_DEG for angle in found])
    between = np.array([scores[:, 1, here].max(axis=1) for here in near]).sum(axis=0)
    best = int(between.argmax())
    beside = scores[best].sum(axis=0)
    angles = [degrees[here][int(beside[here].argmax())] for here in near]
    return np.asarray(angles), float(spacings[best])


def _contrast(difference: Plane, usable: Flags) -> Plane:
    """The image freed of what is smooth, in units of its local scatter, cut at +-_CUT; 0 where unusable."""
    detail = _smooth(difference, usable, 0.7) - _smooth(difference, usable, 5.0)
    scatter = np.sqrt(_smooth(detail**2, usable, 15.0))
    ratio = np.divide(detail, scatter, out=np.zeros_like(detail), where=usable & (scatter > 0))
    return np.clip(ratio, -_CUT, _CUT)


def _along_lines(
    contrast: Plane,
    usable: Flags,
    centre: tuple[float, float],
    degrees: NDArray[np.float64],
    radii_px: tuple[float, float],
) -> tuple[Plane, Plane]:
    """Contrast and number of usable pixels, both sides of the centre added, [angle, radius step]."""
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
    """Sum at the orders, and sum at the orders less between them, over the root of their number [2, angle]."""
    orders = np.arange(1, int(radii_px[1] / spacing))
    at = np.rint(orders * spacing / _SEARCH_STEP_PX).astype(int)
    between = np.rint((orders + 0.5) * spacing / _SEARCH_STEP_PX).astype(int)
    between = between[between < lit.shape[1]]
    lit_at, lit_between = lit[:, at].sum(axis=1), lit[:, between].sum(axis=1)
    seen_at = seen[:, at].sum(axis=1)
    number = seen_at + seen[:, between].sum(axis=1)
    enough = seen_at >= _NEEDED_PEAKS_AN_ARM
    none = np.zeros_like(lit_at)
    return np.stack(
        (
            np.divide(lit_at, np.sqrt(seen_at), out=none.copy(), where=enough),
            np.divide(lit_at - lit_between, np.sqrt(number), out=none, where=enough),
        )
    )


def _best_angles(
    degrees: NDArray[np.float64],
    score: NDArray[np.float64],
    n_arms: int,
    near_deg: tuple[float, ...] | None,
) -> NDArray[np.float64]:
    """The n_arms best angles at least _APART_DEG apart, or the best within _NEAR_DEG of each given."""
    found: list[float] = []
    for arm in range(n_arms if near_deg is None else len(near_deg)):
        allowed = np.ones(degrees.size, dtype=bool)
        if near_deg is not None:
            allowed = _between_deg(degrees, near_deg[arm]) <= _NEAR_DEG
        for other in found:
            allowed &= _between_deg(degrees, other) >= _APART_DEG
        found.append(float(degrees[int(np.where(allowed, score, -np.inf).argmax())]))
    return np.sort(np.asarray(found))


def _between_deg(a: NDArray[np.float64], b: float) -> NDArray[np.float64]:
    """Angle between lines, 0 to 90 degrees."""
    return np.asarray(np.abs((a - b + 90.0) % 180.0 - 90.0))


# --- the fit ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Grid:
    """What stays: the centre (x, y) px, the half size of S px, and the radii px between which orders count."""

    centre: tuple[float, float]
    half_px: float
    radii_px: tuple[float, float]

    @property
    def reach(self) -> int:
        """Knots of S on each side of its middle."""
        return int(np.ceil(self.half_px / _KNOT_PX))

    @property
    def disc(self) -> Flags:
        """The knots of S that are used [y, x]: those within its half size."""
        knots = np.arange(-self.reach, self.reach + 1) * _KNOT_PX
        return np.asarray(np.hypot(knots[:, None], knots) <= self.half_px + 0.25)

    def source(self, coefficients: NDArray[np.float64]) -> Plane:
        """S's coefficients [y, x] from those of the disc."""
        plane = np.zeros(self.disc.shape)
        plane[self.disc] = coefficients
        return plane


@dataclass(frozen=True)
class _State:
    """What is fitted: angles (radian) then spacing (px); A_ak; coefficients of S [y, x]."""

    figures: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    source: Plane

    def moved(self, step: NDArray[np.float64], grid: _Grid) -> _State:
        """The state after a step in all of it, in the order above."""
        one, two = self.figures.size, self.figures.size + self.amplitude.size
        return _State(
            self.figures + step[:one],
            self.amplitude + step[one:two],
            self.source + grid.source(step[two:]),
        )


@dataclass(frozen=True)
class _Result:
    """How a fit ended: errors of figures and amplitudes, chi^2, fitted light of the pixels, DN."""

    error: NDArray[np.float64]
    chi2: float
    freedom: int
    light: NDArray[np.float64]
    done: int
    why: str


@dataclass(frozen=True)
class _Orders:
    """The orders fitted: arm index, k; and the pixels: row, column, nearest order, difference, sigma."""

    arm: NDArray[np.intp]
    k: NDArray[np.float64]
    row: NDArray[np.intp]
    column: NDArray[np.intp]
    nearest: NDArray[np.intp]
    value: NDArray[np.float64]
    sigma: NDArray[np.float64]
    number: NDArray[np.intp]  # [y, x]: index of a pixel in the lists above, or -1

    def planes(self) -> list[tuple[NDArray[np.intp], Plane]]:
        """Of each order its pixels, and an orthonormal basis of weighted planes on them [pixel, 3]."""
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


def _first_fit(
    difference: Plane,
    usable: Flags,
    sigma: Plane,
    grid: _Grid,
    figures: NDArray[np.float64],
    source: Plane,
) -> tuple[_State, _Orders]:
    """Amplitudes and S at given angles and spacing, for the orders that show."""
    arm, k = _orders_in(figures, grid.radii_px)
    state = _State(figures, np.ones(arm.size), source)
    for _ in range(2):  # all orders, then those that show
        orders = _select(difference, usable, sigma, grid, figures, arm, k)
        _check_enough(orders.arm, figures.size - 1)  # near a corner arms may leave the image at once
        state, error = _alternate(orders, grid, state)
        shows = state.amplitude > _PEAK_SIGMA * error
        arm, k = orders.arm[shows], orders.k[shows]
        _check_enough(arm, figures.size - 1)
    orders = _select(difference, usable, sigma, grid, figures, arm, k)
    return _alternate(orders, grid, state)[0], orders


def _orders_in(
    figures: NDArray[np.float64], radii_px: tuple[float, float]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    first, last = int(np.ceil(radii_px[0] / figures[-1])), int(radii_px[1] / figures[-1])
    one_side = np.arange(max(first, 1), last + 1, dtype=np.float64)
    k = np.concatenate((-one_side[::-1], one_side))
    arms = figures.size - 1
    return np.repeat(np.arange(arms), k.size), np.tile(k, arms)


def _places(
    centre: tuple[float, float], figures: NDArray[np.float64], arm: NDArray[np.intp], k: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Eq. (1): x and y of each order, px."""
    along = k * figures[-1]
    return centre[0] + along * np.cos(figures[arm]), centre[1] + along * np.sin(figures[arm])


def _select(
    difference: Plane,
    usable: Flags,
    sigma: Plane,
    grid: _Grid,
    figures: NDArray[np.float64],
    arm: NDArray[np.intp],
    k: NDArray[np.float64],
) -> _Orders:
    """The usable pixels round each order, and of the orders those most of whose pixels are usable."""
    ny, nx = difference.shape
    x, y = _places(grid.centre, figures, arm, k)
    half = round(grid.half_px)
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
    return _Orders(
        arm=arm,
        k=k,
        row=row,
        column=column,
        nearest=nearest[row, column],
        value=difference[row, column],
        sigma=sigma[row, column],
        number=number,
    )


def _check_enough(arm: NDArray[np.intp], arms: int) -> None:
    count = np.bincount(arm, minlength=arms)
    if count.min() < _NEEDED_PEAKS_AN_ARM:
        wanted = f"at least {_NEEDED_PEAKS_AN_ARM} orders of {_PEAK_SIGMA:g} sigma on each arm"
        raise DataError("too-few-peaks", f"expected {wanted}; got {', '.join(map(str, count))}")


def _first_source(grid: _Grid) -> Plane:
    """Coefficients of S to start from: a round blob."""
    knots = np.arange(-grid.reach, grid.reach + 1) * _KNOT_PX
    line = np.exp(-0.5 * (knots / (0.4 * grid.half_px)) ** 2)
    return np.outer(line, line)


@dataclass(frozen=True)
class _Bases:
    """Cubic splines and their slopes at the pixels round each order, [order, pixel of the box, coefficient].

    `index` [order, y, x] tells which pixel of the fit that is, or -1.
    """

    index: NDArray[np.intp]
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    slope_x: NDArray[np.float64]
    slope_y: NDArray[np.float64]

    def stamps(self, source: Plane, *, slope: str = "") -> NDArray[np.float64]:
        """S, or its slope along x or y, on the box of each order [order, y, x]."""
        along_x = self.slope_x if slope == "x" else self.x
        along_y = self.slope_y if slope == "y" else self.y
        return np.asarray(along_y @ source @ along_x.transpose(0, 2, 1))


def _bases(orders: _Orders, grid: _Grid, figures: NDArray[np.float64]) -> _Bases:
    box_px = int(np.ceil((grid.reach + 2) * _KNOT_PX))
    box = np.arange(-box_px, box_px + 1)
    coefficients = np.arange(-grid.reach, grid.reach + 1)
    index, lines, slopes = [], [], []
    for place, limit in zip(
        _places(grid.centre, figures, orders.arm, orders.k), orders.number.shape[::-1], strict=True
    ):
        pixels = np.rint(place).astype(np.intp)[:, None] + box
        offset = (pixels - place[:, None])[:, :, None] / _KNOT_PX - coefficients
        lines.append(_spline(offset))
        slopes.append(_spline_slope(offset) / _KNOT_PX)
        index.append(np.where((pixels >= 0) & (pixels < limit), pixels, -1))
    columns, rows = index
    inside = (rows[:, :, None] >= 0) & (columns[:, None, :] >= 0)
    number = np.where(inside, orders.number[rows[:, :, None], columns[:, None, :]], -1)
    return _Bases(index=number, x=lines[0], y=lines[1], slope_x=slopes[0], slope_y=slopes[1])


def _spline(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """The cubic B-spline."""
    u = np.abs(t)
    near, far = 2 / 3 - u**2 + u**3 / 2, (2 - u) ** 3 / 6
    return np.where(u < 1, near, np.where(u < 2, far, 0.0))


def _spline_slope(t: NDArray[np.float64]) -> NDArray[np.float64]:
    u = np.abs(t)
    near, far = -2 * u + 1.5 * u**2, -((2 - u) ** 2) / 2
    return np.sign(t) * np.where(u < 1, near, np.where(u < 2, far, 0.0))


def _light(orders: _Orders, bases: _Bases, state: _State) -> NDArray[np.float64]:
    """Sum of A S of Eq. (2) at the pixels of the fit."""
    return _added_up(orders, bases, state.amplitude[:, None, None] * bases.stamps(state.source))


def _added_up(orders: _Orders, bases: _Bases, stamps: NDArray[np.float64]) -> NDArray[np.float64]:
    on = bases.index >= 0
    total = np.bincount(bases.index[on], weights=stamps[on], minlength=orders.value.size)
    return np.asarray(total, dtype=np.float64)


def _columns_of_stamps(orders: _Orders, bases: _Bases, stamps: NDArray[np.float64]) -> Plane:
    """[pixel, order]: one stamp a column."""
    columns = np.zeros((orders.value.size, orders.k.size))
    which, y, x = np.nonzero(bases.index >= 0)
    columns[bases.index[which, y, x], which] = stamps[which, y, x]
    return columns


def _columns_of_source(orders: _Orders, bases: _Bases, grid: _Grid, amplitude: NDArray[np.float64]) -> Plane:
    """[pixel, coefficient of S on the disc]."""
    row, column = np.nonzero(grid.disc)
    columns = np.zeros((orders.value.size, row.size))
    for which, a in enumerate(amplitude):
        y, x = np.nonzero(bases.index[which] >= 0)
        product = bases.y[which, y][:, row] * bases.x[which, x][:, column]
        columns[bases.index[which, y, x]] += a * product
    return columns


def _columns_of_figures(orders: _Orders, bases: _Bases, state: _State) -> Plane:
    """[pixel, figure]: how Eq. (2) changes with each angle (radian) and the spacing, by Eq. (1)."""
    spacing = state.figures[-1]
    cosine, sine = np.cos(state.figures[orders.arm]), np.sin(state.figures[orders.arm])
    to_x = -state.amplitude[:, None, None] * bases.stamps(state.source, slope="x")
    to_y = -state.amplitude[:, None, None] * bases.stamps(state.source, slope="y")
    k = orders.k[:, None, None]
    outward = k * (cosine[:, None, None] * to_x + sine[:, None, None] * to_y)
    across = k * spacing * (cosine[:, None, None] * to_y - sine[:, None, None] * to_x)
    by_angle = [
        _added_up(orders, bases, across * (orders.arm == arm)[:, None, None])
        for arm in range(state.figures.size - 1)
    ]
    return np.stack((*by_angle, _added_up(orders, bases, outward)), axis=1)


def _without_planes(orders: _Orders, weighted: NDArray[np.float64]) -> NDArray[np.float64]:
    """Columns, or one, over sigma, less their best planes about each order.

    The planes need then not be fitted with the rest: the solution and its errors stay the same.
    """
    rest = weighted.copy()
    for pixels, basis in orders.planes():
        rest[pixels] -= basis @ (basis.T @ rest[pixels])
    return rest


def _solve(columns: Plane, target: NDArray[np.float64]) -> tuple[NDArray[np.float64], Plane, int]:
    """Least squares, least norm: solution, covariance, rank. What the data do not fix stays 0.

    S shares a constant and slopes with the planes, and a factor with A: these are not fixed, and no figure
    that is looked for depends on them.
    """
    scale = np.sqrt((columns**2).sum(axis=0))
    scale[scale == 0] = 1.0
    scaled = columns / scale
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    kept = values > _RANK * values[-1]
    vectors = vectors[:, kept]
    covariance = (vectors / values[kept]) @ vectors.T / np.outer(scale, scale)
    return covariance @ (columns.T @ target), covariance, int(kept.sum())


def _alternate(orders: _Orders, grid: _Grid, state: _State) -> tuple[_State, NDArray[np.float64]]:
    """Amplitudes (and their errors) and S fitted in turn, at given angles and spacing."""
    bases = _bases(orders, grid, state.figures)
    weight = 1 / orders.sigma
    target = _without_planes(orders, orders.value * weight)
    source = state.source
    for turn in range(_TURNS):
        columns = _columns_of_stamps(orders, bases, bases.stamps(source)) * weight[:, None]
        columns = _without_planes(orders, columns)
        amplitude, covariance, rank = _solve(columns, target)
        if turn < _TURNS - 1:
            shaped = _columns_of_source(orders, bases, grid, np.maximum(amplitude, 0.0)) * weight[:, None]
            found, _, _ = _solve(_without_planes(orders, shaped), target)
            source = grid.source(found)
    left = target - columns @ amplitude
    chi2 = float(left @ left) / max(target.size - 3 * amplitude.size - rank, 1)
    return _State(state.figures, amplitude, source), np.sqrt(np.diag(covariance) * chi2)


def _iterate(orders: _Orders, grid: _Grid, state: _State) -> tuple[_State, _Result]:
    """Gauss-Newton over everything at once, from values near enough."""
    weight = 1 / orders.sigma
    figures = state.figures.size
    done, why = 0, f"{_STEPS} steps done"
    while done < _STEPS:
        done += 1
        bases = _bases(orders, grid, state.figures)
        columns = np.hstack(
            (
                _columns_of_figures(orders, bases, state),
                _columns_of_stamps(orders, bases, bases.stamps(state.source)),
                _columns_of_source(orders, bases, grid, state.amplitude),
            )
        )
        left = (orders.value - _light(orders, bases, state)) * weight
        step, covariance, rank = _solve(
            _without_planes(orders, columns * weight[:, None]), _without_planes(orders, left)
        )
        state = state.moved(step, grid)
        error = np.sqrt(np.diag(covariance))[: figures + state.amplitude.size]
        if np.all(np.abs(step[:figures]) < _CONVERGED * error[:figures]):
            why = f"angles and spacing moved by less than {_CONVERGED:g} of their errors"
            break
    light = _light(orders, _bases(orders, grid, state.figures), state)
    left = _without_planes(orders, (orders.value - light) * weight)
    freedom = max(orders.value.size - rank - 3 * state.amplitude.size, 1)
    chi2 = float(left @ left)
    scale = np.sqrt(chi2 / freedom)
    return state, _Result(error * scale, chi2, freedom, orders.value - left / weight, done, why)


def _measurement(orders: _Orders, grid: _Grid, state: _State, result: _Result, halo: Plane) -> ArmMeasurement:
    arms = state.figures.size - 1
    angles = (np.rad2deg(state.figures[:-1]) + 90.0) % 180.0 - 90.0
    by_angle = np.argsort(angles)
    place = np.argsort(by_angle)
    x, y = _places(grid.centre, state.figures, orders.arm, orders.k)
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
        spacing_px=float(state.figures[-1]),
        spacing_sigma_px=float(result.error[arms]),
        centre_xy=grid.centre,
        chi2=result.chi2,
        degrees_of_freedom=result.freedom,
        peaks=peaks,
        steps_done=result.done,
        stopped_because=result.why,
        source=state.source,
        model=model,
        fitted=fitted,
    )
