"""Diffraction by an open disc or ring, integrated over detector pixels.

The Airy pattern (Goodman, Introduction to Fourier Optics, section "Fresnel and Fraunhofer diffraction"), with
e the obscured fraction of the diameter and v = pi D r / (lambda f):

    U(v) = (2 J1(v) / v - e^2 2 J1(e v) / (e v)) / (1 - e^2)                                     Eq. (1)
    dB/dv = -(1 - e^2) v U(v)^2 / 2;   for a disc B = J0(v)^2 + J1(v)^2                          Eq. (2)

B(r) is the share of the light beyond the radius r (1 - encircled energy). The pattern is the divergence of the radial
field -B / (2 pi r), so the light in a pixel is a flux through its four edges. The flux is easier to integrate than the
pattern, because B / (2 pi r) is smooth and the pattern has hundreds of rings:

    light in a pixel = [1 in the central pixel, else 0] - outward flux of B / (2 pi r)            Eq. (3)

| symbol | name | unit |
|---|---|---|
| D, e D | diameter_mm, obscuration_diameter_mm | mm |
| lambda | wavelength_angstrom | Angstrom |
| f | focal_length_mm | mm |
| v | v = pi D r / (lambda f), with r the radius on the detector | - |
| B | airy_light_beyond | - |
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_simpson
from scipy.special import j0, j1

from psfcore.compiled import compiled
from psfcore.instruments.workload import AIRY_STEP

_MM_PER_ANGSTROM = 1e-7
_UM_PER_MM = 1e3
NEAR_PX = 24
# Number of points of the integral along an edge: within NEAR_PX of an axis, and farther out.
NEAR_POINTS, FAR_POINTS = 48, 16


def airy_light_beyond(v: NDArray[np.float64], obscured: float = 0.0) -> NDArray[np.float64]:
    """Return B of Eq. (2) at each v. v must ascend from 0 in equal steps; `obscured` is e."""
    if obscured == 0:
        return np.asarray(j0(v) ** 2 + j1(v) ** 2)
    amplitude = (_jinc(v) - obscured**2 * _jinc(obscured * v)) / (1 - obscured**2)  # Eq. (1)
    inside = cumulative_simpson((1 - obscured**2) * v * amplitude**2 / 2, x=v, initial=0)
    return np.asarray(1 - inside)


def _jinc(v: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.divide(2 * j1(v), v, out=np.ones_like(v), where=v > 0))


def airy_kernel(
    *,
    wavelength_angstrom: float,
    focal_length_mm: float,
    diameter_mm: float,
    pixel_pitch_um: float,
    size: int,
    obscuration_diameter_mm: float = 0.0,
) -> NDArray[np.float64]:
    """The share of all light in each pixel, shape (size, size), centre at [size // 2, size // 2]; size must be even.

    The kernel is not normalised: its sum is below 1, because light falls outside the array.
    """
    resolved_px = (
        wavelength_angstrom * _MM_PER_ANGSTROM * focal_length_mm / diameter_mm * _UM_PER_MM / pixel_pitch_um
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
def _edge_fluxes(table, steps_per_px, half, near, far):  # type: ignore[no-untyped-def]
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
