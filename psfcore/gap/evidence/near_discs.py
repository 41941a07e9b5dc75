"""The response of the cells of the discs to a template, computed in small patches around the discs.

A wider core hardly changes the mean of a disc, but it changes the outermost cells. The exact displacement of a copy of
the image also shows mainly there. Let q_k be the sensitivity of cell k (`cells`), computed in a patch around the disc. A
template f changes the cell by the sum of q_k f over the patch. A change K of the PSF changes the cell by

    T_k = sum over displacements of K(d) C_k(d),   C_k(d) = sum over the patch of q_k(x) scene(x - d)    Eq. (1)

The mean brightness of the disc is removed from every response, because `search` computes it from the whole field. Light
that scatters into the disc from outside the patch is nearly uniform over the disc, so this module neglects it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.convolver import correlations
from psfcore.gap.evidence.cells import cells_of, sensitivities, whitening
from psfcore.gap.view import Field, View
from psfcore.psf import crop_or_pad
from psfcore.scatter.optics import Optics

Plane = NDArray[np.float64]
Vector = NDArray[np.float64]

MARGIN_PX = 28  # distance from the edge of the disc to the edge of its patch
REACH_PX = 64  # largest displacement in Eq. (1), along each axis


class NearDiscs:
    """The patches around the discs. The caller adds one disc at a time."""

    def __init__(self, view: View) -> None:
        solution = self._solution = view.solution
        shape = solution.transit.shape
        radius_px = max(solution.sky.found[n].place.radius_px for n in solution.part)
        wanted = 2 * math.ceil(radius_px + MARGIN_PX) + 1
        self._size = size = (min(wanted, shape[0]), min(wanted, shape[1]))
        # This kernel is large enough to connect any two pixels of a patch.
        self._optics = Optics(crop_or_pad(view.kernel, 2 * max(size) - 1), size, threads=solution.threads)
        self._corners: dict[int, tuple[int, int]] = {}
        self._planes: dict[int, NDArray[np.float32]] = {}
        self._residuals: list[Vector] = []
        self._to_displacements: list[NDArray[np.floating]] = []

    def add(self, n: int, scene: Field) -> None:
        """Add the disc of image n. scene: the scene of the image with the occulter in front [y, x], DN/s."""
        solution, size = self._solution, self._size
        place, (rows, columns) = solution.sky.found[n].place, solution.sky.dark[n]
        ny, nx = solution.transit.shape
        top = int(np.clip(round(place.y_px) - size[0] // 2, 0, ny - size[0]))
        left = int(np.clip(round(place.x_px) - size[1] // 2, 0, nx - size[1]))
        cells = cells_of((rows, columns), place.x_px, place.y_px)
        planes = sensitivities(self._optics, (rows - top, columns - left), cells.weights)
        frame = solution.transit.frames[n]
        observed = frame.pixels[top : top + size[0], left : left + size[1]].astype(np.float64)
        variance = solution.transit.noise.variance(observed, frame.exposure_s)
        flat = planes.reshape(planes.shape[0], -1).astype(np.float64)
        residual, expected = solution.residual(n)
        white = _without((flat * variance.ravel()) @ flat.T, cells.weights @ expected)
        self._corners[n] = top, left
        self._planes[n] = (white @ flat).astype(np.float32).reshape(planes.shape)
        self._residuals.append(white @ (cells.weights @ residual))
        wide = size[0] + 2 * REACH_PX, size[1] + 2 * REACH_PX
        around = cut(scene, top - REACH_PX, left - REACH_PX, wide)
        self._to_displacements.append(correlations(self._planes[n], around, REACH_PX))

    @property
    def residual(self) -> Vector:
        """The residuals of the cells of all discs (cells,), in units of their noise, without the mean of each disc."""
        return np.concatenate(self._residuals)

    def of_kernel(self, change: Plane) -> Vector:
        """T of Eq. (1) for all cells (cells,), in units of their noise.

        change: the change of the PSF [y, x]; the centre of the PSF is at [n // 2, n // 2].
        """
        near = crop_or_pad(change, 2 * REACH_PX + 1).astype(np.float32)
        responses = [np.tensordot(disc, near, axes=2) for disc in self._to_displacements]
        return np.concatenate(responses, dtype=np.float64)

    def of_copies(self, n: int, image: Field, displacements: Sequence[tuple[int, int]]) -> Plane:
        """The response of the cells of disc n to copies of an image [y, x], in units of their noise (cells, copies).

        displacements: the displacement of each copy, in whole pixels (x, y).
        """
        (top, left), planes = self._corners[n], self._planes[n]
        copies = [cut(image, top - dy, left - dx, self._size).ravel() for dx, dy in displacements]
        return np.asarray(
            planes.reshape(planes.shape[0], -1) @ np.array(copies, np.float32).T, dtype=np.float64
        )


def _without(covariance: Plane, level: Vector) -> Plane:
    """The matrix that whitens cells with this covariance and removes the component proportional to `level` (cells,)."""
    white = whitening(covariance)
    along = white @ level
    along /= max(float(np.linalg.norm(along)), 1e-300)
    return np.asarray(white - np.outer(along, along @ white))


def cut(plane: Any, top: int, left: int, size: tuple[int, int]) -> Any:
    """A window of a plane [y, x]; its pixels outside the plane are 0."""
    out = np.zeros(size, plane.dtype)
    low_y, high_y = (min(max(at, 0), plane.shape[0]) for at in (top, top + size[0]))
    low_x, high_x = (min(max(at, 0), plane.shape[1]) for at in (left, left + size[1]))
    if low_y < high_y and low_x < high_x:
        out[low_y - top : high_y - top, low_x - left : high_x - left] = plane[low_y:high_y, low_x:high_x]
    return out
