"""The true scatter kernel of a simulation: a softened power law that may be stretched and lopsided.

Source: Hofmeister et al., The point-spread function of HRI_EUV, section "The diffuse scattered light". The paper's
scatter is isotropic; stretch and dipole are additions. This module shares no code with the fit. An error in
one of the two therefore becomes visible when both are compared.

    s(u, v) = a F(u, v)  outside the central pixel,  s(0) = 1 - total                 Eq. (1)
    F = (b + r')^-c (1 + d cos(theta - t)),  r'^2 = (u / (1 + s))^2 + (v (1 + s))^2    Eq. (2)
    a = total / (sum of F over the full reach without the central pixel)              Eq. (3)

| symbol | name | unit |
|---|---|---|
| b, c, total | b_px, c, total | px, -, - |
| s in Eq. (2) | stretch: the kernel is 1 + s times as long along t | - |
| t | angle_deg, from +x towards +y | degrees |
| d | dipole: if positive, more light is scattered towards t | - |
| u, v | offset from the centre along t and across it | px |
| theta | angle of the offset, from +x towards +y | - |
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from psfcore.arrays import Kernel
from psfcore.convolution.convolver import linear_convolve
from psfcore.errors import DataError
from psfcore.psf import REACH_GRID_PX, crop_centred

PARAMETERS = ("b", "c", "total", "stretch")


@dataclass(frozen=True)
class ScatterTruth:
    """The true scatter kernel's parameters. Raises DataError "bad-scatter" if they do not describe a PSF."""

    b_px: float
    c: float
    total: float
    stretch: float = 0.0
    angle_deg: float = 0.0
    dipole: float = 0.0

    def __post_init__(self) -> None:
        numbers = (self.b_px, self.c, self.total, self.stretch, self.angle_deg, self.dipole)
        if not all(math.isfinite(value) for value in numbers):
            raise DataError("bad-scatter", f"expected finite numbers; got {self}")
        if not (self.b_px > 0 and self.c > 0 and 0 <= self.total < 1 and self.stretch > -1):
            raise DataError("bad-scatter", f"expected b > 0, c > 0, 0 <= total < 1, stretch > -1; got {self}")
        if not abs(self.dipole) <= 1:
            raise DataError("bad-scatter", f"expected a dipole of -1 to 1; got {self.dipole}")

    @property
    def a(self) -> float:
        """Amplitude of Eq. (3), px^c."""
        return float(self.total / _falloff(self).sum())


def anisotropic_kernel(scatter: ScatterTruth, size: int = REACH_GRID_PX) -> Kernel:
    """Eq. (1) on (size, size), size <= 2048, centre at [size // 2, size // 2]; the sum is 1 for size 2048."""
    falloff = _falloff(scatter)
    kernel = falloff * (scatter.total / falloff.sum())  # Eq. (1), Eq. (3)
    kernel[REACH_GRID_PX // 2, REACH_GRID_PX // 2] = 1 - scatter.total
    return crop_centred(kernel, (size, size))


def total_kernel(
    scatter: ScatterTruth, diffraction: Kernel, size: int = REACH_GRID_PX, *, threads: int = 1
) -> Kernel:
    """The total PSF: the scatter kernel convolved with the diffraction PSF, on (size, size).

    The convolution is linear, and its result is not renormalised.

    Parameters
    ----------
    diffraction
        The diffraction PSF: weights [y, x], centre at [n // 2, n // 2], sum 1.
    """
    return convolved(anisotropic_kernel(scatter, REACH_GRID_PX), diffraction, size, threads=threads)


def convolved(full_kernel: Kernel, diffraction: Kernel, size: int, *, threads: int = 1) -> Kernel:
    """Convolve a kernel on the full reach with the diffraction PSF; the result has shape (size, size).

    Only the part of the kernel that contributes to the result is transformed.
    """
    needed = size + max(diffraction.shape) + 2
    part = full_kernel if needed >= REACH_GRID_PX else crop_centred(full_kernel, (needed, needed))
    return linear_convolve(part, diffraction, (size, size), threads=threads)


def kernel_slopes(scatter: ScatterTruth) -> dict[str, Kernel]:
    """The derivatives of the kernel with respect to PARAMETERS, on the full reach.

    Each derivative sums to 0, because Eq. (3) keeps the sum of the kernel at 1.
    """
    falloff = _falloff(scatter)
    norm = falloff.sum()
    # The central pixel is 1 - total for all b, c and stretches. The falloff and its slopes are 0 in this pixel.
    slopes = {
        name: (scatter.total / norm) * (slope - falloff * (slope.sum() / norm))
        for name, slope in _falloff_slopes(scatter, falloff).items()
    }
    slopes["total"] = falloff / norm
    slopes["total"][REACH_GRID_PX // 2, REACH_GRID_PX // 2] = -1.0
    return {name: slopes[name] for name in PARAMETERS}


def amplitude_slopes(scatter: ScatterTruth) -> dict[str, float]:
    """The derivatives of the amplitude a of Eq. (3) with respect to PARAMETERS."""
    falloff = _falloff(scatter)
    norm = float(falloff.sum())
    sums = {name: float(slope.sum()) for name, slope in _falloff_slopes(scatter, falloff).items()}
    slopes = {name: -scatter.total * total / norm**2 for name, total in sums.items()}
    return {name: slopes.get(name, 1 / norm) for name in PARAMETERS}


def _falloff_slopes(scatter: ScatterTruth, falloff: Kernel) -> dict[str, Kernel]:
    """The derivatives of F with respect to b, c and the stretch."""
    radius = _radius(scatter)
    by_b = -scatter.c * falloff / (scatter.b_px + radius)
    by_c = -np.log(scatter.b_px + radius) * falloff
    return {"b": by_b, "c": by_c, "stretch": by_b * _radius_slope(scatter, radius)}


def _falloff(scatter: ScatterTruth) -> Kernel:
    """F of Eq. (2) on the full reach, 0 at the centre."""
    falloff: Kernel = (scatter.b_px + _radius(scatter)) ** -scatter.c
    if scatter.dipole:
        along, across = _offsets(scatter.angle_deg)
        falloff = falloff * (1 + scatter.dipole * along / np.maximum(np.hypot(along, across), 1e-300))
    falloff[REACH_GRID_PX // 2, REACH_GRID_PX // 2] = 0.0
    return falloff


def _radius(scatter: ScatterTruth) -> Kernel:
    """R' of Eq. (2)."""
    along, across = _offsets(scatter.angle_deg)
    factor = 1 + scatter.stretch
    return np.asarray(np.sqrt((along / factor) ** 2 + (across * factor) ** 2))


def _radius_slope(scatter: ScatterTruth, radius: Kernel) -> Kernel:
    """The derivative of r' with respect to the stretch."""
    along, across = _offsets(scatter.angle_deg)
    factor = 1 + scatter.stretch
    return (across**2 * factor - along**2 / factor**3) / np.maximum(radius, 1e-300)


def _offsets(angle_deg: float) -> tuple[Kernel, Kernel]:
    """U and v of each pixel of the full reach."""
    axis = np.arange(REACH_GRID_PX, dtype=np.float64) - REACH_GRID_PX // 2
    x, y = axis[None, :], axis[:, None]
    cos, sin = np.cos(np.deg2rad(angle_deg)), np.sin(np.deg2rad(angle_deg))
    return x * cos + y * sin, y * cos - x * sin
