"""Two tests of a fitted PSF: wrong dark levels, and other shapes of scatter on held-out images.

Source: Hofmeister et al., The point-spread function of HRI_EUV, section "Accuracy and robustness".

Its last experiment repeats the fit with an offset added to every readout, as a wrong dark level would add it. An offset
of o DN adds o / t DN/s to an image with exposure time t, Eq. (1). The effect is largest for short exposures while the
occulter is far from the limb. A pixel of the disc then contains only a few tens of DN.

Two quantities are compared with the fit without an offset. The first is the diffuse weight: the weight of the scatter
kernel per pixel, averaged over rings one pixel wide. It is compared only within the field, because the PSF farther out
is an extrapolation of the formula. The second is the cumulative curve C(R) = 100 (1 - encircled energy) of the scatter
kernel, as in the paper, and also of the total PSF.

The shapes are compared with the fitted shape on held-out images. Every shape is the softened power law with one or two
additional parameters. If these are zero, the shape equals the power law. Near the solution, the model is nearly linear
in the parameters. One pass over the images therefore gives the normal equations of all shapes. The fit of a fold, and
its gain on held-out images, follow from sums of these equations. The gain is the decrease of chi2 (to first order):

    q_f = q + A_f^-1 v_f,   A_f, v_f summed over the fitted frames of fold f             Eq. (2)
    gain = sum over folds f of (2 d . v_h - d . A_h d),   d = q_f - q                        Eq. (3)

The reported gain is the gain of the shape minus the gain of the softened power law, which is refitted in the same
folds. The reported gain can be negative: a parameter that fits noise makes the prediction of held-out images worse.

| symbol | name |
|---|---|
| o | offset_dn, DN |
| t | frame.exposure_s, s |
| A_f, v_f | matrix (normal) and right-hand side (score) of the normal equations, summed over the fitted images |
| A_h, v_h | the same matrix and right-hand side, summed over the held-out images |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from psfcore.arrays import Matrix, Vector
from psfcore.errors import DataError
from psfcore.psf import REACH_GRID_PX, cumulative_curve, radial_profile
from psfcore.scatter.inversion import invert
from psfcore.scatter.reconstruction import Inversion, Progress, Solution, labelled, on_threads
from psfcore.scatter.shapes import SHAPES, SOFTENED_POWER_LAW, Shape
from psfcore.scatter.total_psf import Blur, TotalPsf
from psfcore.transit.transit import Transit, folds

OFFSETS_DN = (-5.0, -3.0, 3.0, 5.0)
_RADII = 48
TOGETHER = (
    4  # parameters whose derivatives are computed in one pass over the images: each needs the memory of a PSF
)
BASE = len(SOFTENED_POWER_LAW.parameters)


@dataclass(frozen=True, eq=False)
class DarkOffset:
    """The fit with one offset, compared with the fit without an offset.

    Attributes
    ----------
    weight_change_pct
        Relative change of the diffuse weight per pixel at radii_px, percent.
    curve_change_points, total_curve_change_points
        Changes of C(R) of the scatter kernel and of the total PSF at curve_radii_px, in percentage points.
    images
        Number of fitted images.
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
    """Effects of dark offsets on the PSF of a transit.

    Attributes
    ----------
    nominal
        The parameters of the fit without an offset.
    """

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

    Raises the errors of `invert`.

    Parameters
    ----------
    nominal
        The fit without an offset; its shape is used for all fits. Default: a new fit of the softened power law.
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


@dataclass(frozen=True)
class ComparedShape:
    """The improvement of the fit by one shape, compared with the softened power law, to first order.

    Attributes
    ----------
    added
        Value and standard error of each additional parameter.
    gain
        Decrease of chi2 for all images.
    held_out_gain
        Decrease of chi2 for held-out images; None if there are too few images for folds.
    """

    name: str
    added: dict[str, tuple[float, float]]
    gain: float
    held_out_gain: float | None


def compare_shapes(
    solution: Solution, *, progress: Progress = lambda stage, step, steps: None
) -> tuple[ComparedShape, ...]:
    """Compare all other shapes with the softened power law.

    Raises DataError "unknown-shape" if `solution` is not a fit of the softened power law.
    """
    base = solution.inversion.shape
    if base.name != SOFTENED_POWER_LAW.name:
        raise DataError("unknown-shape", f"expected a fit of {SOFTENED_POWER_LAW.name}; got {base.name}")
    shapes = [shape for shape in SHAPES.values() if shape.name != base.name]
    names = list(dict.fromkeys(name for shape in shapes for name in shape.names[BASE:]))
    jacobians = [[frame.jacobian] for frame in solution.inversion.frames]
    for first in range(0, len(names), TOGETHER):
        found = _measured(solution, names[first : first + TOGETHER], progress)
        for of_frame, (_, _, jacobian) in zip(jacobians, found, strict=True):
            of_frame.append(jacobian)
    normals, scores = [], []
    for n, of_frame, (residual, expected, _) in zip(solution.part, jacobians, found, strict=True):
        jacobian = np.concatenate(of_frame)
        weighted = jacobian * solution.weight(n, expected)
        normals.append(weighted @ jacobian.T)
        scores.append(weighted @ residual)
    normal, score = np.array(normals), np.array(scores)
    added = [[BASE + names.index(name) for name in shape.names[BASE:]] for shape in shapes]
    return tuple(_compared(shape, of, normal, score) for shape, of in zip(shapes, added, strict=True))


def _measured(
    solution: Solution, names: Sequence[str], progress: Progress
) -> list[tuple[Vector, Vector, Matrix]]:
    """For every image: residual, expected intensity, and derivatives with respect to parameters that the power law does
    not have.
    """

    def slope_of(name: str) -> Blur:
        shape = next(shape for shape in SHAPES.values() if name in shape.names)
        at = shape.coordinates(solution.inversion.values)
        slope = solution.total.of(shape).slope(at, shape.names.index(name))
        return Blur(slope, solution.transit.shape, threads=solution.threads)

    blurs, count = [slope_of(name) for name in names], len(solution.part)
    return on_threads(
        lambda solution, n: solution.residual_with_jacobian(n, blurs),
        solution.part,
        solution.twins(),
        lambda step: progress("comparing shapes", step, count),
    )


def _compared(shape: Shape, extra: list[int], normal: Matrix, score: Matrix) -> ComparedShape:
    whole, alone = [*range(BASE), *extra], list(range(BASE))

    def gain(fitted: list[int], held: list[int]) -> float:
        """The gain of the shape minus that of the power law, on held-out images."""
        return _gain(normal, score, whole, fitted, held) - _gain(normal, score, alone, fitted, held)

    everything = list(range(len(normal)))
    covariance = np.linalg.inv(normal[:, whole][:, :, whole].sum(axis=0))
    step, sigma = covariance @ score[:, whole].sum(axis=0), np.sqrt(np.diag(covariance))
    gains = [gain(list(fold.fitted), list(fold.held_out)) for fold in folds(len(normal))]
    return ComparedShape(
        name=shape.name,
        added={
            name: (float(step[k]), float(sigma[k])) for k, name in enumerate(shape.names[BASE:], start=BASE)
        },
        gain=gain(everything, everything),
        held_out_gain=float(np.sum(gains)) if gains else None,
    )


def _gain(normal: Matrix, score: Matrix, columns: list[int], fitted: list[int], held: list[int]) -> float:
    """The gain of some parameters (columns) on held-out images, from Eq. (2) and (3)."""
    normal, score = normal[:, columns][:, :, columns], score[:, columns]
    step = np.linalg.solve(normal[fitted].sum(axis=0), score[fitted].sum(axis=0))
    return float(2 * step @ score[held].sum(axis=0) - step @ normal[held].sum(axis=0) @ step)
