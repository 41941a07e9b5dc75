"""Diffraction by an open pupil of any outline, far from the core: the light that its edges diffract.

Born and Wolf, Principles of Optics, section "The Rubinowicz representation": the diffracted wave comes from the edge of
the opening. Where a pixel is many times wider than lambda f / D, the waves of different edges interfere so fast that
their intensities add. A straight edge of length L sends its light along its normal, an arc of radius R along the
directions of its radii. On a line from the centre along the normal, to both sides:

    light between x and x + dx = k L dx / x^2,   k = lambda f / (4 pi^2 p A)                            Eq. (1)
    an arc is a fan of such lines, each with L = R d(angle)                                           Eq. (2)
    light in the central pixel = 1 - all other light

Eq. (1) follows from the transform of a half-plane, 1 / (2 pi i q): its square, summed along the edge (Parseval), is
L / (4 pi^2 q^2), with q = x p / (lambda f). For a whole disc, the sum over all directions is 2 / (pi v), which is the mean of
B of `airy` for large v. The line of a straight edge is lambda f / (L p) pixels wide; here it is infinitely thin. An
edge must therefore be longer than lambda f / p.

| symbol | name | unit |
|---|---|---|
| lambda | wavelength_angstrom | Angstrom |
| f | focal_length_mm | mm |
| p | pixel_pitch_um | um |
| A, L | area and lengths of the edges | mm^2, mm |
| x | distance from the centre | px |
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled
from psfcore.instruments.model import Aperture, signed_area

RAYS_A_TURN = 65_536  # lines for a whole circle: seven in each pixel at 1448 px
_MM_PER_ANGSTROM, _MM_PER_UM = 1e-7, 1e-3

Vector = NDArray[np.float64]


def edge_kernel(
    aperture: Aperture,
    *,
    wavelength_angstrom: float,
    focal_length_mm: float,
    pixel_pitch_um: float,
    size: int,
) -> NDArray[np.float64]:
    """The share of all light in each pixel, shape (size, size), centre at [size // 2, size // 2].

    The sum is below 1, because light falls outside the array. Beside the exact patterns of pupils that need 36 to 88
    samples a pixel (disc, ring, quadrant, hexagon), the light outside the central pixel is right to 2 %.
    """
    angles, lengths_mm, area_mm2 = edges(aperture)
    reach_mm = wavelength_angstrom * _MM_PER_ANGSTROM * focal_length_mm
    k = reach_mm / (4 * math.pi**2 * pixel_pitch_um * _MM_PER_UM * area_mm2)
    kernel = np.zeros((size, size))
    kernel[size // 2, size // 2] = 1.0
    _cast(kernel, np.cos(angles), np.sin(angles), k * lengths_mm)
    return kernel


def edges(aperture: Aperture) -> tuple[Vector, Vector, float]:
    """The directions of the normals (radians) and the lengths (mm) of all edges, and the open area (mm^2)."""
    if aperture.corners_mm:
        corners = np.array(aperture.corners_mm)
        along = np.roll(corners, -1, axis=0) - corners
        return (
            np.arctan2(-along[:, 0], along[:, 1]),
            np.hypot(*along.T),
            abs(signed_area(aperture.corners_mm)),
        )
    outer, inner = aperture.diameter_mm / 2, aperture.obscuration_diameter_mm / 2
    sector = aperture.sector
    first, opening = (
        (0.0, 2 * math.pi)
        if sector is None
        else (math.radians(sector.first_angle_deg), math.radians(sector.opening_deg))
    )
    rays = math.ceil(RAYS_A_TURN * opening / (2 * math.pi))
    angles = first + (np.arange(rays) + 0.5) * opening / rays
    lengths = np.full(rays, (outer + inner) * opening / rays)  # Eq. (2), of both arcs
    if sector is not None:
        sides = np.array([first, first + opening]) + math.pi / 2
        angles, lengths = np.append(angles, sides), np.append(lengths, [outer - inner] * 2)
    return angles, lengths, opening / 2 * (outer**2 - inner**2)


@compiled()
def _cast(kernel, cosines, sines, weights):  # type: ignore[no-untyped-def]
    """Move the light of each line, Eq. (1), from the central pixel to the pixels that the line crosses, on both sides."""
    size = kernel.shape[0]
    half = size // 2
    for n in range(len(weights)):
        across, up = abs(cosines[n]), abs(sines[n])
        step_x, step_y = (1 if cosines[n] > 0 else -1), (1 if sines[n] > 0 else -1)
        # Distances along the line to the next border in x and in y.
        at_x = 0.5 / across if across > 1e-9 else np.inf
        at_y = 0.5 / up if up > 1e-9 else np.inf
        i = j = 0
        near = min(at_x, at_y)
        kernel[half, half] -= 2 * weights[n] / near
        while abs(i) <= half and abs(j) <= half:
            if at_x <= at_y:
                i += step_x
                at_x += 1 / across
            else:
                j += step_y
                at_y += 1 / up
            far = min(at_x, at_y)
            light = weights[n] * (1 / near - 1 / far)
            for side in (-1, 1):
                x, y = half + side * i, half + side * j
                if 0 <= x < size and 0 <= y < size:
                    kernel[y, x] += light
            near = far
