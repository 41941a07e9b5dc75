"""Fresnel propagation of a wave through a two-mirror telescope, in one transverse dimension.

Hofmeister et al., The point-spread function of HRI_EUV, sections "Fresnel propagation" and "Fraunhofer
propagation"; in one dimension, without the constant phase exp(2 pi i z / lambda):

    E2(x2) = exp(i pi x2^2 / (lambda z)) / sqrt(i lambda z)
             integral of E1(x1) exp(i pi x1^2 / (lambda z)) exp(-2 pi i x1 x2 / (lambda z)) dx1        Eq. (1)
    phase(x) = +- 2 (2 pi / lambda) sag(x), + for a convex mirror and - for a concave one              Eq. (2)
    sag(x) = x^2 / (R (1 + sqrt(1 - (1 + K) x^2 / R^2)))                                               Eq. (3)
    N1 = X1 / dx1,  dx1 = lambda z / X2,  hence N1 = X1 X2 / (lambda z)                                Eq. (4)

Departures from the paper, with reasons:

- Eq. (3): the paper prints sqrt(x^2 + y^2) in the numerator; the sag of a conic has x^2 + y^2 in this position.
- Eq. (4): the paper prints 1 / (lambda z)^2. This is correct for the product of the counts of two axes; the count of
  one axis has 1 / (lambda z). dx1 is divided by SAMPLING_MARGIN, because otherwise light that would land outside X2
  would fold back into X2.
- Each plane has the step that Eq. (4) requires. With a plain FFT, the step of one plane would determine the step of the
  next, and the planes would be too narrow for short distances. A chirp transform computes the same sum with any steps.
- If a wire or a rim covers a part of a sample, the field of the sample is multiplied by the open share of its length.
  So the positions of wires and rims are not rounded to the grid.

Eq. (1) is paraxial, and in this approximation a pair of parabolas (K = -1) focuses perfectly. The conic constant of the
secondary differs from -1. This leaves about 0.1 wave of spherical aberration at the rim of the beam; refocusing
compensates most of the aberration.

| symbol | name | unit |
|---|---|---|
| lambda, z | wavelength_mm, distance_mm | mm |
| X, dx, N | width_mm, step_mm, samples of a Grid | mm, mm, - |
| R, K | radius_mm, conic | mm, - |
| E | field; the light is the sum of abs(E)^2 times the step | mm^-1/2 |
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from psfcore.arrays import Vector
from psfcore.convolution.convolver import ChirpTransform
from psfcore.errors import DataError
from psfcore.instruments.model import MM_PER_UM, Mesh, Mirror

SAMPLING_MARGIN = 1.5
MOST_SAMPLES = 8_000_000

Wave = NDArray[np.complex128]


@dataclass(frozen=True)
class Grid:
    """Samples of one plane at equal steps, symmetric about the axis, for light of one wavelength."""

    plane: str
    samples: int
    step_mm: float
    wavelength_mm: float

    @property
    def width_mm(self) -> float:
        return self.samples * self.step_mm

    @property
    def x_mm(self) -> Vector:
        """The positions of the samples, (samples,)."""
        return np.asarray((np.arange(self.samples) - (self.samples - 1) / 2) * self.step_mm)

    @property
    def edges_mm(self) -> Vector:
        """The borders between the samples, (samples + 1,)."""
        return np.asarray((np.arange(self.samples + 1) - self.samples / 2) * self.step_mm)

    def light(self, field: Wave) -> float:
        """The light of a field on this grid: sum of abs(E)^2 times the step."""
        return float(np.vdot(field, field).real) * self.step_mm


def grid_for(
    plane: str, wavelength_mm: float, width_mm: float, next_width_mm: float, distance_mm: float
) -> Grid:
    """The grid of a plane. Its step is so small that the light reaches the full width of the next plane.

    Raises DataError "too-many-samples" if the distance is too short.

    Parameters
    ----------
    next_width_mm, distance_mm
        Width of the next plane, and the distance to it.
    """
    step_mm = wavelength_mm * distance_mm / (SAMPLING_MARGIN * next_width_mm)  # Eq. (4), with the margin
    samples = math.ceil(width_mm / step_mm)
    if samples > MOST_SAMPLES:
        raise DataError(
            "too-many-samples",
            f"{plane}: expected a distance to the next plane that needs at most {MOST_SAMPLES} samples; "
            f"got {distance_mm:g} mm, which needs {samples}: make this distance longer",
        )
    return Grid(plane, samples, step_mm, wavelength_mm)


class FresnelStep:
    """Propagation through free space between two grids, Eq. (1): prepared once, then applied to any number of
    fields.
    """

    def __init__(self, source: Grid, target: Grid, distance_mm: float) -> None:
        reach_mm2 = source.wavelength_mm * distance_mm
        self._transform = ChirpTransform(
            source.step_mm * target.step_mm / reach_mm2, source.samples, target.samples
        )
        self._before = np.exp(1j * np.pi / reach_mm2 * source.x_mm**2)
        self._after = np.exp(1j * np.pi / reach_mm2 * target.x_mm**2)
        self._after *= source.step_mm / np.sqrt(1j * reach_mm2)

    def apply(self, field: Wave) -> Wave:
        """The field at the target, (target.samples,), computed from the field at the source."""
        return np.asarray(self._after * self._transform.apply(field * self._before))  # Eq. (1)


def conic_sag_mm(x_mm: ArrayLike, *, radius_mm: float, conic: float) -> Vector:
    """The depth of a conic mirror at x from its vertex, Eq. (3); NaN outside the conic."""
    square = np.square(np.asarray(x_mm, dtype=np.float64))
    root = 1 - (1 + conic) * square / radius_mm**2
    depth = np.sqrt(root, where=root >= 0, out=np.full_like(square, np.nan))
    return np.asarray(square / (radius_mm * (1 + depth)))  # Eq. (3)


def mirror_transmission(mirror: Mirror, grid: Grid) -> Wave:
    """The factor by which a mirror multiplies a field: the phase of Eq. (2), and 0 outside the rim, (samples,)."""
    sign = 1.0 if mirror.figure == "convex" else -1.0
    radius_mm = mirror.diameter_mm / 2
    inside = open_share(grid, np.array([[-radius_mm, radius_mm]]))
    x_mm = np.clip(grid.x_mm, -radius_mm, radius_mm)
    sag_mm = conic_sag_mm(x_mm, radius_mm=mirror.radius_mm, conic=mirror.conic)
    return np.asarray(inside * np.exp(1j * sign * 4 * np.pi / grid.wavelength_mm * sag_mm))  # Eq. (2)


def mesh_openings_mm(mesh: Mesh, phase: float, width_mm: float) -> Vector:
    """Windows of a mesh over at least `width_mm`, rows of (begin, end).

    Parameters
    ----------
    phase
        Shift of the mesh divided by the pitch. At 0 a window is centred on the axis; at 0.5 a wire is centred on it.
    """
    pitch_mm, wire_mm = mesh.pitch_um * MM_PER_UM, mesh.wire_um * MM_PER_UM
    reach = math.ceil(width_mm / pitch_mm / 2) + 1
    centres_mm = (np.arange(-reach, reach + 1) + phase) * pitch_mm
    half_mm = (pitch_mm - wire_mm) / 2
    return np.stack([centres_mm - half_mm, centres_mm + half_mm], axis=1)


def common_openings_mm(first: Vector, second: Vector) -> Vector:
    """The intersection of two lists of openings, rows of (begin, end) in order."""
    begin = np.maximum(first[:, None, 0], second[None, :, 0]).ravel()
    end = np.minimum(first[:, None, 1], second[None, :, 1]).ravel()
    both = np.stack([begin, end], axis=1)[end > begin]
    return np.asarray(both[np.argsort(both[:, 0])])


def open_share(grid: Grid, openings_mm: Vector) -> Vector:
    """The share of each sample's length that is open, 0 to 1, (samples,)."""
    lengths_mm = np.diff(openings_mm, axis=1).ravel()
    open_before_mm = np.stack([np.cumsum(lengths_mm) - lengths_mm, np.cumsum(lengths_mm)], axis=1)
    open_mm = np.interp(grid.edges_mm, openings_mm.ravel(), open_before_mm.ravel())
    return np.diff(open_mm) / grid.step_mm


def fraunhofer_field(openings_mm: Vector, grid: Grid, focal_length_mm: float) -> Wave:
    """The field in focus of an evenly illuminated pupil: the sum of the transforms of the openings, (samples,).

    An opening of width w around c gives w sinc(pi w u) exp(-2 pi i c u), with u = x / (lambda f).
    """
    reach_mm2 = grid.wavelength_mm * focal_length_mm
    u = grid.x_mm / reach_mm2
    field = np.zeros(grid.samples, dtype=np.complex128)
    for begin_mm, end_mm in openings_mm:
        width_mm, centre_mm = end_mm - begin_mm, (begin_mm + end_mm) / 2
        # np.sinc(t) is sin(pi t) / (pi t)
        field += width_mm * np.sinc(width_mm * u) * np.exp(-2j * np.pi * centre_mm * u)
    return np.asarray(field / np.sqrt(1j * reach_mm2))


def binned_light(field: Wave, grid: Grid, samples_per_pixel: int) -> Vector:
    """The light in each pixel: the sum of abs(E)^2 over the samples of the pixel, times the step."""
    return np.asarray((np.abs(field) ** 2).reshape(-1, samples_per_pixel).sum(axis=1) * grid.step_mm)


def line_light_beyond(line: Vector, radii_px: Sequence[int] | NDArray[np.integer]) -> Vector:
    """1 - encircled energy in one dimension: the share of a line's light farther than each radius (px).

    The centre of the line is at [n // 2]; only pixels farther than the radius count.
    """
    offset = np.abs(np.arange(line.size) - line.size // 2)
    at = np.bincount(offset, weights=line)
    beyond = np.append(np.cumsum(at[::-1])[::-1][1:], 0.0)
    return np.asarray(beyond[np.asarray(radii_px)] / line.sum())
