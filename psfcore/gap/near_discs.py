"""What the cells of the discs say of a form, their means left out: looked at in small patches round the discs.

A core that widens leaves a disc's mean nearly as it is and shows in its outermost cells; so does where exactly a copy of
the image lies. With q_k the sensitivity of cell k (`cells`), worked out in a patch round the disc, a form f of the image
moves the cell by the sum of q_k f over the patch, and a change K of the PSF by

    T_k = sum over displacements of K(d) C_k(d),   C_k(d) = sum over the patch of q_k(x) scene(x - d)    Eq. (1)

How bright the disc is as a whole is taken out of every answer: `search` has that from the whole field.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from psfcore.fourier import correlations
from psfcore.gap.cells import cells_of, sensitivities
from psfcore.gap.effect import Field, View
from psfcore.psf import crop_or_pad
from psfcore.scatter.optics import Optics

Plane = NDArray[np.float64]
Vector = NDArray[np.float64]

MARGIN_PX = 28  # of a patch round the disc
REACH_PX = 64  # of Eq. (1)


class NearDiscs:
    """residual: what the cells of all discs leave unexplained, over its noise, each disc's mean left out (cells,)."""

    def __init__(self, view: View) -> None:
        solution = view.solution
        shape = solution.transit.shape
        radius_px = max(found.place.radius_px for found in solution.sky.found)
        size = self._size = min(2 * math.ceil(radius_px + MARGIN_PX) + 1, *shape)
        optics = Optics(crop_or_pad(view.kernel, size - 1 + size % 2), (size, size), threads=solution.threads)
        self._corners: dict[int, tuple[int, int]] = {}
        self._planes: dict[int, NDArray[np.float32]] = {}
        residuals, to_displacements = [], []
        for n in solution.part:
            place, (rows, columns) = solution.sky.found[n].place, solution.sky.dark[n]
            top, left = self._corners[n] = (
                int(np.clip(round(place.y_px) - size // 2, 0, shape[0] - size)),
                int(np.clip(round(place.x_px) - size // 2, 0, shape[1] - size)),
            )
            cells = cells_of((rows, columns), place.x_px, place.y_px)
            planes = sensitivities(optics, (rows - top, columns - left), cells.weights)
            frame = solution.transit.frames[n]
            observed = frame.pixels[top : top + size, left : left + size].astype(np.float64)
            variance = solution.transit.noise.variance(observed, frame.exposure_s)
            flat = planes.reshape(planes.shape[0], -1).astype(np.float64)
            residual, expected = solution.residual(n)
            white = _without((flat * variance.ravel()) @ flat.T, cells.weights @ expected)
            residuals.append(white @ (cells.weights @ residual))
            self._planes[n] = (white @ flat).astype(np.float32).reshape(planes.shape)
            scene = solution.optics.field(view.lit_scene(n))
            around = _cut(scene, top - REACH_PX, left - REACH_PX, size + 2 * REACH_PX)
            to_displacements.append(correlations(self._planes[n], around, REACH_PX))
        self.residual: Vector = np.concatenate(residuals)
        self._to_displacements = np.concatenate(to_displacements)

    def of_kernel(self, change: Plane) -> Vector:
        """How a change of the PSF [y, x], its centre at n // 2, moves the cells, Eq. (1), over their noise (cells,)."""
        near = crop_or_pad(change, 2 * REACH_PX + 1).astype(np.float32)
        return np.asarray(np.tensordot(self._to_displacements, near, axes=2), dtype=np.float64)

    def of_copies(self, n: int, image: Field, displacements: Sequence[tuple[int, int]]) -> Plane:
        """How an image [y, x] displaced by whole pixels (x, y) moves the cells of disc n, over their noise (cells, k)."""
        (top, left), planes = self._corners[n], self._planes[n]
        copies = [_cut(image, top - dy, left - dx, self._size).ravel() for dx, dy in displacements]
        return np.asarray(
            planes.reshape(planes.shape[0], -1) @ np.array(copies, np.float32).T, dtype=np.float64
        )


def _without(covariance: Plane, level: Vector) -> Plane:
    """What makes the noise of some cells one, and takes out of them what goes like a level."""
    white = np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
    along = white @ level
    along /= np.linalg.norm(along)
    return np.asarray(white - np.outer(along, along @ white))


def _cut(plane: Field, top: int, left: int, size: int) -> Field:
    """A square of a plane [y, x], dark where the plane does not reach."""
    out = np.zeros((size, size), plane.dtype)
    ny, nx = plane.shape
    low_y, high_y, low_x, high_x = max(top, 0), min(top + size, ny), max(left, 0), min(left + size, nx)
    if low_y < high_y and low_x < high_x:
        out[low_y - top : high_y - top, low_x - left : high_x - left] = plane[low_y:high_y, low_x:high_x]
    return out
