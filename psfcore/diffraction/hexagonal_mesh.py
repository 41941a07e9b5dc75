"""Diffraction by a mesh with hexagonal openings (a honeycomb), in the far field.

Goodman, Introduction to Fourier Optics, section "Gratings": the pattern of a periodic mask consists of orders at the
vectors g of the reciprocal lattice. With openings at distances d (pitch) from their six neighbours and F the transform of
one opening, the share of the transmitted light in an order is

    light(g) = |F(g)|^2 / (A B),   A = sqrt(3) w^2 / 2,   B = sqrt(3) d^2 / 2                          Eq. (1)
    g = (h (1, -1 / sqrt(3)) + k (0, 2 / sqrt(3))) / d                                              Eq. (2)

in the frame of the mesh, whose x axis points from an opening to the next; h and k are whole numbers. The six nearest orders
are 2 / (sqrt(3) d) from the centre, at angles of 60 degrees, beginning at 30 degrees. The opening consists of three
rhombi that meet in its centre, with sides v and u, two corners of the hexagon that are 120 degrees apart:

    F(g) = sum over the rhombi of |v x u| sinc(g.v) sinc(g.u) cos(pi g.(v + u))                        Eq. (3)

By Parseval's theorem the shares sum to 1, and order 0 has the open share A / B = (w / d)^2. On the detector, the order g is at
lambda z g. Its light is spread over a small square as wide as an order of so many windows; the pattern of the aperture
widens it further.

| symbol | name | unit |
|---|---|---|
| d, w | pitch_um, pitch_um - wire_um: distance between opposite sides of an opening | um |
| z | distance_mm: from the mesh to the detector; for a mesh in the entrance pupil, the focal length | mm |
| A, B | areas of an opening and of a cell of the mesh | - |
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled
from psfcore.diffraction.mesh_series import order_spacing_px


def hexagonal_mesh_kernel(
    *,
    wavelength_angstrom: float,
    distance_mm: float,
    pitch_um: float,
    wire_um: float,
    windows: int,
    pixel_pitch_um: float,
    angle_deg: float,
    size: int,
) -> NDArray[np.float64]:
    """The pattern of a hexagonal mesh, shape (size, size), centre at [size // 2, size // 2].

    angle_deg: the direction from an opening to the next. The weights are fractions of the light on the whole plane.
    """
    reach_px = order_spacing_px(
        wavelength_angstrom=wavelength_angstrom,
        distance_mm=distance_mm,
        pitch_um=pitch_um,
        pixel_pitch_um=pixel_pitch_um,
    )
    kernel = np.zeros((size, size))
    turn = math.radians(angle_deg)
    _add_orders(kernel, reach_px, 1 - wire_um / pitch_um, reach_px / windows, math.cos(turn), math.sin(turn))
    return kernel


@compiled()
def _add_orders(kernel, reach_px, open_share, width_px, cosine, sine):  # type: ignore[no-untyped-def]
    """Add all orders of Eq. (2) to their pixels. reach_px: lambda z / d; open_share: w / d."""
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
            gx, gy = float(h), (2 * k - h) / root  # Eq. (2)
            f = 0.0
            for n in range(3):
                m = (n + 1) % 3
                one, other = math.pi * (gx * vx[n] + gy * vy[n]), math.pi * (gx * vx[m] + gy * vy[m])
                part = rhombus * math.cos(one + other)
                if abs(one) > 1e-9:
                    part *= math.sin(one) / one
                if abs(other) > 1e-9:
                    part *= math.sin(other) / other
                f += part  # Eq. (3)
            light = f * f / areas  # Eq. (1)
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
