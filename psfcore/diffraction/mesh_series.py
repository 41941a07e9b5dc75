"""Diffraction by a regular mesh in the far field: a mesh with square openings, and one with hexagonal openings.

Hofmeister et al., The point-spread function of HRI_EUV, section "Analytical solution for mesh diffraction",
here Eq. (1). The pattern is separable in x and y. Eq. (1) is the factor of one axis, with sinc(u) = sin(u) / u:

    I(x) = sinc^2(pi w x / (lambda z)) (sin(N pi d x / (lambda z)) / sin(pi d x / (lambda z)))^2     Eq. (1)

The paper samples Eq. (1) finely and bins the samples. Here Eq. (1) is integrated exactly over each pixel: the grating
factor is a finite cosine series (Fejer), and each term has an antiderivative with the sine integral Si:

    (sin(N p) / sin(p))^2 = sum_m (N - |m|) cos(2 m p)                                               Eq. (2)
    sinc^2(alpha x) cos(q x) = (g(2 alpha + q) + g(2 alpha - q) - 2 g(q)) / (4 alpha^2)              Eq. (3)
    g(k) = (1 - cos(k x)) / x^2,  integral of g(k) from 0 to x = k Si(k x) - (1 - cos(k x)) / x      Eq. (4)

The pattern of a rotated mesh is rotated by the same angle and is not separable on the pixels.
`rotated_mesh_kernel` divides each axis of the rotated pattern into cells. The cells are small at the orders. The light
of every pair of cells is distributed over the pixels that the pair covers. The light on a whole axis is known:

    integral of Eq. (1) over all x = (N d / w) (lambda z / d)                                        Eq. (5)

(The transform of the envelope is a triangle. Only the term m = 0 of the cosine series lies within its support.) The
weights are fractions of the light on the whole plane, so light outside the array is missing from the sum.

A mesh with hexagonal openings (a honeycomb): Goodman, Introduction to Fourier Optics, section "Gratings": the pattern
of a periodic mask consists of orders at the vectors g of the reciprocal lattice. With openings at distances d from
their six neighbours and F the transform of one opening, the share of the transmitted light in an order is

    light(g) = |F(g)|^2 / (A B),   A = sqrt(3) w^2 / 2,   B = sqrt(3) d^2 / 2                          Eq. (6)
    g = (h (1, -1 / sqrt(3)) + k (0, 2 / sqrt(3))) / d                                              Eq. (7)

in the frame of the mesh, whose x axis points from an opening to the next; h and k are whole numbers. The six nearest
orders are 2 / (sqrt(3) d) from the centre, at angles of 60 degrees, beginning at 30 degrees. The opening consists of
three rhombi that meet in its centre, with sides v and u, two corners of the hexagon that are 120 degrees apart:

    F(g) = sum over the rhombi of |v x u| sinc(pi g.v) sinc(pi g.u) cos(pi g.(v + u))                  Eq. (8)

By Parseval's theorem the shares sum to 1, and order 0 has the open share A / B = (w / d)^2. On the detector, the order
g is at lambda z g. Its light is spread over a small square as wide as an order of so many windows; the pattern of the
aperture widens it further.

| symbol | name | unit |
|---|---|---|
| lambda | wavelength_angstrom | Angstrom |
| z | distance_mm: from the mesh to the detector; for a mesh in the entrance pupil, the focal length | mm |
| d | pitch_um | um |
| w | pitch_um - wire_um, the width of a window; the distance between opposite sides of a hexagon | um |
| N | windows | - |
| A, B | areas of a hexagonal opening and of a cell of its mesh | - |
| x | offset on the detector | px |
| lambda z / d | order_spacing_px | px |
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.special import sici

from psfcore.compiled import compiled
from psfcore.instruments.model import UM_PER_ANGSTROM, UM_PER_MM
from psfcore.instruments.workload import FINEST_CELL_PX

_LARGEST_CELL_PX = 0.4
# The density of cells is proportional to the square root of light times width. About _CELLS_AN_ORDER cells are
# distributed over each order, and about _CELLS_IN_ALL further cells over the whole axis. An order that contains less
# than _FAINT_SHARE of all light gets fewer cells.
_CELLS_AN_ORDER = 30
_CELLS_IN_ALL = 600
_FAINT_SHARE = 1e-4
_GAUSS_POINTS = 6


def order_spacing_px(
    *, wavelength_angstrom: float, distance_mm: float, pitch_um: float, pixel_pitch_um: float
) -> float:
    """Spacing of the diffraction orders, lambda z / d, px."""
    reach_um2 = wavelength_angstrom * UM_PER_ANGSTROM * distance_mm * UM_PER_MM
    return reach_um2 / pitch_um / pixel_pitch_um


def mesh_line(
    spacing_px: float, *, pitch_um: float, wire_um: float, windows: int, size: int
) -> NDArray[np.float64]:
    """Integrate Eq. (1) over each of `size` pixels, centre at [size // 2].

    Returns shape (size,), normalised to sum 1.

    Parameters
    ----------
    spacing_px
        Spacing of the orders, see `order_spacing_px`.
    """
    alpha = np.pi * (pitch_um - wire_um) / pitch_um / spacing_px
    edges_px = np.arange(size + 1, dtype=np.float64) - size // 2 - 0.5
    light = np.diff(_integral(edges_px, alpha=alpha, spacing_px=spacing_px, windows=windows))
    line = np.maximum(light, 0.0)  # the integral of a square can be negative only because of rounding
    return np.asarray(line / line.sum())


def rotated_mesh_kernel(
    spacing_px: float, *, pitch_um: float, wire_um: float, windows: int, angle_deg: float, size: int
) -> NDArray[np.float64]:
    """The pattern of a mesh, rotated by `angle_deg` (from +x towards +y) and integrated over pixels.

    Returns shape (size, size), centre at [size // 2, size // 2]; the weights are fractions of the light on the whole
    plane, Eq. (5). At angle 0, the weight of each pixel differs by at most 1e-4 from the product of the exact lines.
    The sum of all absolute differences is at most 5e-4. Misplaced light falls into a pixel next to the correct one.
    """
    # A rotation by 90 degrees does not change a square mesh.
    turn = np.deg2rad((angle_deg + 45.0) % 90.0 - 45.0)
    reach_px = (size // 2 + 1.5) * float(np.cos(turn) + abs(np.sin(turn)))
    where_px, width_px, light = _cells(
        reach_px, spacing_px=spacing_px, open_share=(pitch_um - wire_um) / pitch_um, windows=windows
    )
    kernel = np.zeros((size, size))
    _share_out(kernel, where_px, width_px, light, float(np.cos(turn)), float(np.sin(turn)))
    return kernel


def _cells(
    reach_px: float, *, spacing_px: float, open_share: float, windows: int
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Divide one axis of the pattern, from -reach_px to reach_px, into cells; return the middle (px), width (px) and
    light of each cell.

    The light of a cell is a fraction of the light on the whole axis. A cell is a part of a lobe of the grating factor,
    a whole lobe, or, where there is little light, several lobes. The middle of a cell is the centroid of its light.
    """
    lobe_px = spacing_px / windows
    parts = max(1, int(np.ceil(lobe_px / FINEST_CELL_PX)))
    count = int(np.ceil(reach_px / lobe_px * parts))
    edges = np.asarray(np.arange(count + 1) * (lobe_px / parts), dtype=np.float64)
    points, weights = np.polynomial.legendre.leggauss(_GAUSS_POINTS)
    x = edges[:-1, None] + (points + 1) / 2 * np.diff(edges)[:, None]
    whole = windows * spacing_px / open_share  # Eq. (5)
    inside = _intensity(x, spacing_px, open_share, windows) * weights * (np.diff(edges)[:, None] / 2) / whole
    light, moment = inside.sum(axis=1), (inside * x).sum(axis=1)
    first = _first_of_each_cell(edges, light, spacing_px)
    light, moment = np.add.reduceat(light, first), np.add.reduceat(moment, first)
    borders = np.append(edges[first], edges[-1])
    middle = np.divide(moment, light, out=(borders[1:] + borders[:-1]) / 2, where=light > 1e-300)
    width = 2 * np.minimum(middle - borders[:-1], borders[1:] - middle)
    return (
        np.concatenate((-middle[::-1], middle)),
        np.concatenate((width[::-1], width)),
        np.concatenate((light[::-1], light)),
    )


def _first_of_each_cell(
    edges: NDArray[np.float64], light: NDArray[np.float64], spacing_px: float
) -> NDArray[np.intp]:
    """Combine fine cells into larger cells, by the width and light of the fine cells.

    Returns the index of the first fine cell of each larger cell.
    """
    half = max(spacing_px, 1.0) / 2
    below = np.concatenate(([0.0], np.cumsum(light)))
    middle = (edges[1:] + edges[:-1]) / 2
    near = np.interp(middle + half, edges, below) - np.interp(middle - half, edges, below)
    crowding = np.sqrt(light * np.diff(edges))
    local = crowding / np.sqrt(2 * half * (near + _FAINT_SHARE))
    density = np.diff(edges) / _LARGEST_CELL_PX + _CELLS_AN_ORDER * local + _CELLS_IN_ALL * crowding
    number = np.floor(np.cumsum(np.minimum(density, 1.0)) - np.minimum(density[0], 1.0))
    return np.concatenate(([0], np.flatnonzero(np.diff(number)) + 1)).astype(np.intp)


def _intensity(
    x: NDArray[np.float64], spacing_px: float, open_share: float, windows: int
) -> NDArray[np.float64]:
    """Eq. (1) at x (px)."""
    phase = np.pi * x / spacing_px
    sine = np.sin(phase)
    near_order = np.abs(sine) < 1e-9
    grating = np.sin(windows * phase) / np.where(near_order, 1.0, sine)
    grating = np.where(near_order, float(windows), grating)
    return np.asarray((np.sinc(open_share * x / spacing_px) * grating) ** 2)  # Eq. (1); sinc(t) has sin(pi t)


@compiled()
def _share_out(
    kernel: NDArray[np.float64],
    where_px: NDArray[np.float64],
    width_px: NDArray[np.float64],
    light: NDArray[np.float64],
    cosine: float,
    sine: float,
) -> None:
    """Add the light of all pairs of cells (one along the mesh, one across) to the pixels that they cover.

    The area of a pair is a rotated rectangle, narrower than a pixel. An upright, evenly bright box of the same extent
    replaces it.
    """
    size = kernel.shape[0]
    origin = size // 2 + 0.5  # pixel i extends from i to i + 1
    for i in range(where_px.size):
        for j in range(where_px.size):
            x = cosine * where_px[i] - sine * where_px[j] + origin
            y = sine * where_px[i] + cosine * where_px[j] + origin
            if x < -1 or y < -1 or x > size + 1 or y > size + 1:
                continue
            half_x = (cosine * width_px[i] + abs(sine) * width_px[j]) / 2
            half_y = (abs(sine) * width_px[i] + cosine * width_px[j]) / 2
            left, right = np.floor(x - half_x), np.floor(x + half_x)
            low, high = np.floor(y - half_y), np.floor(y + half_y)
            share_x = 1.0 if left == right else (x + half_x - right) / (2 * half_x)
            share_y = 1.0 if low == high else (y + half_y - high) / (2 * half_y)
            amount = light[i] * light[j]
            for row, part_y in ((int(low), 1 - share_y), (int(high), share_y)):
                for column, part_x in ((int(left), 1 - share_x), (int(right), share_x)):
                    if 0 <= row < size and 0 <= column < size:
                        kernel[row, column] += amount * part_x * part_y


def _integral(
    x: NDArray[np.float64], *, alpha: float, spacing_px: float, windows: int
) -> NDArray[np.float64]:
    """Integral of Eq. (1) from 0 to each x (px)."""
    total = np.zeros_like(x)
    for m in range(windows):
        q = 2 * np.pi * m / spacing_px
        terms = _primitive(2 * alpha + q, x) + _primitive(2 * alpha - q, x) - 2 * _primitive(q, x)
        copies = 1 if m == 0 else 2  # m and -m
        total += copies * (windows - m) * terms / (4 * alpha**2)  # Eq. (2), Eq. (3)
    return total


def _primitive(k: float, x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Eq. (4); x is never 0, because pixel edges are at half pixels."""
    return np.asarray(k * sici(k * x)[0] - (1 - np.cos(k * x)) / x)


def hexagonal_mesh_kernel(
    spacing_px: float, *, pitch_um: float, wire_um: float, windows: int, angle_deg: float, size: int
) -> NDArray[np.float64]:
    """The pattern of a hexagonal mesh, shape (size, size), centre at [size // 2, size // 2].

    The weights are fractions of the light on the whole plane.

    Parameters
    ----------
    angle_deg
        The direction from an opening to the next opening.
    """
    kernel = np.zeros((size, size))
    turn = math.radians(angle_deg)
    open_share = 1 - wire_um / pitch_um
    _add_orders(kernel, spacing_px, open_share, spacing_px / windows, math.cos(turn), math.sin(turn))
    return kernel


@compiled()
def _add_orders(
    kernel: NDArray[np.float64],
    reach_px: float,
    open_share: float,
    width_px: float,
    cosine: float,
    sine: float,
) -> None:
    """Add all orders of Eq. (7) to their pixels.

    Parameters
    ----------
    reach_px
        The distance lambda z / d of Eq. (7), px.
    open_share
        The ratio w / d of Eq. (7).
    """
    size = kernel.shape[0]
    origin = size // 2 + 0.5  # pixel i extends from i to i + 1
    corner_px = (size // 2 + 1) * math.sqrt(2.0)
    root = math.sqrt(3.0)
    rho = open_share / root  # from the centre of an opening to a corner, in units of the pitch
    angles = np.array([30.0, 150.0, 270.0]) * math.pi / 180
    vx, vy = rho * np.cos(angles), rho * np.sin(angles)
    rhombus = root / 2 * rho * rho
    areas = 3 * rhombus * root / 2  # A B, in units of the pitch
    most = int(corner_px / reach_px) + 1
    for h in range(-most, most + 1):
        middle, extent = h / 2, root / 2 * math.sqrt(max(0.0, (corner_px / reach_px) ** 2 - h * h))
        for k in range(math.ceil(middle - extent), math.floor(middle + extent) + 1):
            gx, gy = float(h), (2 * k - h) / root  # Eq. (7)
            f = 0.0
            for n in range(3):
                m = (n + 1) % 3
                one, other = math.pi * (gx * vx[n] + gy * vy[n]), math.pi * (gx * vx[m] + gy * vy[m])
                part = rhombus * math.cos(one + other)
                if abs(one) > 1e-9:
                    part *= math.sin(one) / one
                if abs(other) > 1e-9:
                    part *= math.sin(other) / other
                f += part  # Eq. (8)
            light = f * f / areas  # Eq. (6)
            x = reach_px * (cosine * gx - sine * gy) + origin
            y = reach_px * (sine * gx + cosine * gy) + origin
            left, right = math.floor(x - width_px / 2), math.floor(x + width_px / 2)
            low, high = math.floor(y - width_px / 2), math.floor(y + width_px / 2)
            for row in range(low, high + 1):
                part_y = (min(row + 1.0, y + width_px / 2) - max(float(row), y - width_px / 2)) / width_px
                for column in range(left, right + 1):
                    part_x = (
                        min(column + 1.0, x + width_px / 2) - max(float(column), x - width_px / 2)
                    ) / width_px
                    if 0 <= row < size and 0 <= column < size:
                        kernel[row, column] += light * part_x * part_y
