"""Diffraction by a regular mesh in the far field.

Hofmeister et al., The point-spread function of HRI_EUV, section "Analytical solution for mesh diffraction",
here Eq. (1), separable in x and y; one axis of it, with sinc(u) = sin(u) / u:

    I(x) = sinc^2(pi w x / (lambda z)) (sin(N pi d x / (lambda z)) / sin(pi d x / (lambda z)))^2     Eq. (1)

The paper samples Eq. (1) finely and bins it. Here it is integrated over each pixel exactly: the grating
factor is a finite cosine series (Fejer), and each term has an antiderivative in the sine integral:

    (sin(N p) / sin(p))^2 = sum_m (N - |m|) cos(2 m p)                                               Eq. (2)
    sinc^2(alpha x) cos(q x) = (g(2 alpha + q) + g(2 alpha - q) - 2 g(q)) / (4 alpha^2)              Eq. (3)
    g(k) = (1 - cos(k x)) / x^2,  integral of g(k) from 0 to x = k Si(k x) - (1 - cos(k x)) / x      Eq. (4)

| symbol | name | unit |
|---|---|---|
| lambda | wavelength_angstrom | Angstrom |
| z | distance_mm: from the mesh, or the focal length for a mesh in the entrance pupil | mm |
| d | pitch_um | um |
| w | pitch_um - wire_um, the window | um |
| N | windows | - |
| x | offset on the detector | px |
| lambda z / d | order_spacing_px | px |
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import sici

_UM_PER_ANGSTROM = 1e-4
_UM_PER_MM = 1e3


def order_spacing_px(
    *, wavelength_angstrom: float, distance_mm: float, pitch_um: float, pixel_pitch_um: float
) -> float:
    """Distance between diffraction orders, lambda z / d, px."""
    reach_um2 = wavelength_angstrom * _UM_PER_ANGSTROM * distance_mm * _UM_PER_MM
    return reach_um2 / pitch_um / pixel_pitch_um


def mesh_line(
    *,
    wavelength_angstrom: float,
    distance_mm: float,
    pitch_um: float,
    wire_um: float,
    windows: int,
    pixel_pitch_um: float,
    size: int,
) -> NDArray[np.float64]:
    """Eq. (1) integrated over `size` pixels, centre at [size // 2], as a fraction of the light on them.

    Returns shape (size,), sum 1: normalised to the light over this reach.
    """
    spacing_px = order_spacing_px(
        wavelength_angstrom=wavelength_angstrom,
        distance_mm=distance_mm,
        pitch_um=pitch_um,
        pixel_pitch_um=pixel_pitch_um,
    )
    alpha = np.pi * (pitch_um - wire_um) / pitch_um / spacing_px
    edges_px = np.arange(size + 1, dtype=np.float64) - size // 2 - 0.5
    light = np.diff(_integral(edges_px, alpha=alpha, spacing_px=spacing_px, windows=windows))
    line = np.maximum(light, 0.0)  # an integral of a square: only rounding takes it below zero
    return np.asarray(line / line.sum())


def mesh_kernel(line_y: NDArray[np.float64], line_x: NDArray[np.float64]) -> NDArray[np.float64]:
    """The pattern of a mesh, the outer product of its two lines, [y, x]."""
    return np.outer(line_y, line_x)


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
    """Eq. (4); x is never 0 because pixel edges lie at half pixels."""
    return np.asarray(k * sici(k * x)[0] - (1 - np.cos(k * x)) / x)
