"""Effect of a wrong dark level on a fitted PSF: repeat the fit with an offset added to every readout.

Source: the last experiment in Hofmeister et al., The point-spread function of HRI_EUV, section "Accuracy and robustness".
An offset of o DN adds o / t DN/s to an image with exposure time t, Eq. (1). The effect is largest for short exposures
while the occulter is far from the limb. A pixel of the disc then contains only a few tens of DN.

Two quantities are compared with the fit without an offset. The first is the diffuse weight: the weight of the scatter
kernel per pixel, averaged over rings one pixel wide. It is compared only within the field, because the PSF farther out is
an extrapolation of the formula. The second is the cumulative curve C(R) = 100 (1 - encircled energy) of the scatter kernel,
as in the paper, and also of the total PSF.

| symbol | name | unit |
|---|---|---|
| o | offset_dn | DN |
| t | frame.exposure_s | s |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from psfcore.psf import REACH_GRID_PX, cumulative_curve, radial_profile
from psfcore.scatter.inversion import invert
from psfcore.scatter.reconstruction import Inversion, Progress, labelled
from psfcore.scatter.shapes import Vector
from psfcore.scatter.total_psf import TotalPsf
from psfcore.transit.transit import Transit

OFFSETS_DN = (-5.0, -3.0, 3.0, 5.0)
_RADII = 48


@dataclass(frozen=True, eq=False)
class DarkOffset:
    """The fit with one offset, compared with the fit without an offset.

    weight_change_pct: relative change of the diffuse weight per pixel at radii_px, percent. curve_change_points,
    total_curve_change_points: change of C(R) of the scatter kernel and of the total PSF at curve_radii_px, in percentage
    points. images: number of fitted images.
    """

    offset_dn: float
    values: dict[str, float]
    images: int
    converged: bool
    weight_change_pct: Vector
    curve_change_points: Vector
    total_curve_change_points: Vector


@dataclass(frozen=True, eq=False)
class DarkOffsetStudy:
    """Effects of dark offsets on the PSF of a transit. nominal: the parameters of the fit without an offset."""

    radii_px: Vector
    curve_radii_px: Vector
    nominal: dict[str, float]
    offsets: tuple[DarkOffset, ...]

    def largest(self, change: str) -> float:
        """The largest absolute value of a change, such as "weight_change_pct", at any distance and for any offset."""
        return max(float(np.abs(getattr(offset, change)).max()) for offset in self.offsets)


def dark_offset_study(
    transit: Transit,
    offsets_dn: Sequence[float] = OFFSETS_DN,
    *,
    nominal: Inversion | None = None,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> DarkOffsetStudy:
    """Repeat the fit of a transit with each offset, starting from the fit without an offset.

    nominal: the fit without an offset; its shape is used for all fits. Default: a new fit of the softened power law.
    Raises the errors of `invert`.
    """
    if nominal is None:
        nominal = invert(transit, threads=threads, progress=progress).inversion
    total_psf = TotalPsf(transit.diffraction, nominal.shape, transit.shape, threads=threads)
    farthest = min(max(transit.shape), REACH_GRID_PX // 2) - 1
    radii_px = np.unique(np.geomspace(1, farthest, _RADII).round())
    curve_radii_px = np.concatenate(([0.5], radii_px))

    def weights_and_curves(coordinates: Vector) -> tuple[Vector, Vector, Vector]:
        """The diffuse weight at radii_px, and C(R) of the scatter kernel and the total PSF at curve_radii_px."""
        scatter = nominal.shape.kernel(coordinates, REACH_GRID_PX)
        ring, mean = radial_profile(scatter)
        return (
            mean[np.searchsorted(ring, radii_px)],
            cumulative_curve(scatter, curve_radii_px),
            cumulative_curve(total_psf.kernel(coordinates), curve_radii_px),
        )

    before = weights_and_curves(nominal.coordinates)
    changes = []
    for offset_dn in offsets_dn:
        at = invert(
            with_offset(transit, offset_dn),
            nominal.shape,
            start=nominal.coordinates,
            threads=threads,
            progress=labelled(progress, f"{offset_dn:+g} DN"),
        ).inversion
        weights, diffuse, total = weights_and_curves(at.coordinates)
        changes.append(
            DarkOffset(
                offset_dn=float(offset_dn),
                values=at.values,
                images=len(at.frames),
                converged=at.converged,
                weight_change_pct=100 * (weights / before[0] - 1),
                curve_change_points=diffuse - before[1],
                total_curve_change_points=total - before[2],
            )
        )
    return DarkOffsetStudy(radii_px, curve_radii_px, nominal.values, tuple(changes))


def with_offset(transit: Transit, offset_dn: float) -> Transit:
    """The transit with offset_dn added to every pixel of every readout, Eq. (1)."""
    frames = tuple(
        replace(frame, pixels=frame.pixels + np.float32(offset_dn / frame.exposure_s))
        for frame in transit.frames
    )
    return replace(transit, frames=frames)
