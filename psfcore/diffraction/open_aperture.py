"""Diffraction by an open aperture, integrated over detector pixels, where its mask would need too many samples.

`airy_kernel`, for a disc or ring: the Airy pattern (Goodman, Introduction to Fourier Optics, section "Fresnel and
Fraunhofer diffraction"), with e the obscured fraction of the diameter and v = pi D r / (lambda f):

    U(v) = (2 J1(v) / v - e^2 2 J1(e v) / (e v)) / (1 - e^2)                                     Eq. (1)
    dB/dv = -(1 - e^2) v U(v)^2 / 2;   for a disc B = J0(v)^2 + J1(v)^2                          Eq. (2)

B(r) is the share of the light beyond the radius r (1 - encircled energy). The pattern is the divergence of the radial
field -B / (2 pi r), so the light in a pixel is a flux through its four edges. The flux is easier to integrate than the
pattern, because B / (2 pi r) is smooth and the pattern has hundreds of rings:

    light in a pixel = [1 in the central pixel, else 0] - outward flux of B / (2 pi r)            Eq. (3)

`edge_kernel`, for any outline, far from the core: the light that the edges of the opening diffract. Born and Wolf,
Principles of Optics, section "The Rubinowicz representation": the diffracted wave comes from the edge of the opening.
Where a pixel is many times wider than lambda f / D, the waves of different edges interfere so fast that
their intensities add. A straight edge of length L sends its light along its normal, an arc of radius R along the
directions of its radii. On a line from the centre along the normal, to both sides:

    light between x and x + dx = k L dx / x^2,   k = lambda f / (4 pi^2 p A)                            Eq. (4)
    an arc is a fan of such lines, each with L = R d(angle)                                           Eq. (5)
    light in the central pixel = 1 - all other light

Eq. (4) follows from the transform of a half-plane, 1 / (2 pi i q): its square, summed along the edge (Parseval), is L /
(4 pi^2 q^2), with q = x p / (lambda f). For a whole disc, the sum over all directions is 2 / (pi v), which is the mean
of B of Eq. (2) for large v. The line of a straight edge is lambda f / (L p) pixels wide; here it is infinitely thin. An
edge must therefore be longer than lambda f / p.

| symbol | name | unit |
|---|---|---|
| D, e D | diameter_mm, obscuration_diameter_mm | mm |
| lambda | wavelength_angstrom | Angstrom |
| f | focal_length_mm | mm |
| p | pixel_pitch_um | um |
| v | v = pi D r / (lambda f), with r the radius on the detector | - |
| B | airy_light_beyond | - |
| A, L | area and lengths of the edges | mm^2, mm |
| x | distance from the centre | px |
"""

from __future__ import annotations

import math

import numpy as np
from scipy.integrate import cumulative_simpson
from scipy.special import j0, j1

from psfcore.arrays import Kernel, Vector
from psfcore.compiled import compiled
from psfcore.instruments.model import MM_PER_ANGSTROM, MM_PER_UM, UM_PER_MM, Aperture, signed_area
from psfcore.instruments.workload import AIRY_STEP

NEAR_PX = 24
# Number of points of the integral along an edge: within NEAR_PX of an axis, and farther out.
NEAR_POINTS, FAR_POINTS = 48, 16
RAYS_A_TURN = 65_536  # lines for a whole circle: seven in each pixel at 1448 px


def airy_light_beyond(v: Vector, obscured: float = 0.0) -> Vector:
    """Return B of Eq. (2) at each v. v must ascend from 0 in equal steps; `obscured` is e."""
    if obscured == 0:
        return np.asarray(j0(v) ** 2 + j1(v) ** 2)
    amplitude = (_jinc(v) - obscured**2 * _jinc(obscured * v)) / (1 - obscured**2)  # Eq. (1)
    inside = cumulative_simpson((1 - obscured**2) * v * amplitude**2 / 2, x=v, initial=0)
    return np.asarray(1 - inside)


def _jinc(v: Vector) -> Vector:
    return np.asarray(np.divide(2 * j1(v), v, out=np.ones_like(v), where=v > 0))


def airy_kernel(
    *,
    wavelength_angstrom: float,
    focal_length_mm: float,
    diameter_mm: float,
    pixel_pitch_um: float,
    size: int,
    obscuration_diameter_mm: float = 0.0,
) -> Kernel:
    """The share of all light in each pixel, shape (size, size), centre at [size // 2, size // 2]; size must be even.

    The kernel is not normalised: its sum is below 1, because light falls outside the array.
    """
    resolved_px = (
        wavelength_angstrom * MM_PER_ANGSTROM * focal_length_mm / diameter_mm * UM_PER_MM / pixel_pitch_um
    )
    half = size // 2
    v_per_px = math.pi / resolved_px
    v = np.arange(0, v_per_px * (half + 1) * math.sqrt(2) + 2 * AIRY_STEP, AIRY_STEP)
    table = airy_light_beyond(v, obscuration_diameter_mm / diameter_mm)
    near, far = (np.polynomial.legendre.leggauss(points) for points in (NEAR_POINTS, FAR_POINTS))
    flux = _edge_fluxes(table, v_per_px / AIRY_STEP, half, near, far)
    # Flux through the right edge minus flux through the left edge.
    out_x = np.diff(flux, axis=0, prepend=-flux[:1])[: half + 1]
    quarter = -(out_x.T + out_x)
    quarter[0, 0] += 1  # Eq. (3)
    distance = np.abs(np.arange(size) - half)
    return np.ascontiguousarray(quarter[distance[:, None], distance[None, :]])


@compiled()
def _edge_fluxes(table, steps_per_px, half, near, far):  # type: ignore[no-untyped-def]  # compiled
    """Flux of B / (2 pi r) in the direction +x through the right edge of each pixel [x, y] of one quadrant."""
    flux = np.empty((half + 1, half + 1))
    for i in range(half + 1):
        x = i + 0.5
        for k in range(half + 1):
            # Near the axes the rings are almost parallel to the edges, so the integrand varies fast.
            places, weights = near if min(i, k) < NEAR_PX else far
            total = 0.0
            for g in range(len(places)):
                y = k + 0.5 * places[g]
                r2 = x * x + y * y
                at = math.sqrt(r2) * steps_per_px
                low = int(at)
                beyond = table[low] + (at - low) * (table[low + 1] - table[low])
                total += weights[g] * beyond * x / r2
            flux[i, k] = total / (4 * math.pi)  # half the length of the edge, times 1 / (2 pi)
    return flux


def edge_kernel(
    aperture: Aperture,
    *,
    wavelength_angstrom: float,
    focal_length_mm: float,
    pixel_pitch_um: float,
    size: int,
) -> Kernel:
    """The share of all light in each pixel, shape (size, size), centre at [size // 2, size // 2].

    The sum is below 1, because light falls outside the array. Beside the exact patterns of pupils that need 36 to 88
    samples a pixel (disc, ring, quadrant, hexagon), the light outside the central pixel is right to 2 %.
    """
    angles, lengths_mm, area_mm2 = _edges(aperture)
    reach_mm = wavelength_angstrom * MM_PER_ANGSTROM * focal_length_mm
    k = reach_mm / (4 * math.pi**2 * pixel_pitch_um * MM_PER_UM * area_mm2)
    kernel = np.zeros((size, size))
    kernel[size // 2, size // 2] = 1.0
    _cast(kernel, np.cos(angles), np.sin(angles), k * lengths_mm)
    return kernel


def _edges(aperture: Aperture) -> tuple[Vector, Vector, float]:
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
    lengths = np.full(rays, (outer + inner) * opening / rays)  # Eq. (5), of both arcs
    if sector is not None:
        sides = np.array([first, first + opening]) + math.pi / 2
        angles, lengths = np.append(angles, sides), np.append(lengths, [outer - inner] * 2)
    return angles, lengths, opening / 2 * (outer**2 - inner**2)


@compiled()
def _cast(kernel: Kernel, cosines: Vector, sines: Vector, weights: Vector) -> None:
    """Move the light of each line, Eq. (4), from the central pixel to the pixels that the line crosses, on both
    sides.
    """
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
