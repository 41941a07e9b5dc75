"""What the cells of the discs say of a form, their means left out: looked at in small patches round the discs.

A core that widens leaves a disc's mean nearly as it is and shows in its outermost cells; so does where exactly a copy of
the image lies. With q_k the sensitivity of cell k (`cells`), worked out in a patch round the disc, a form f of the image
moves the cell by the sum of q_k f over the patch, and a change K of the PSF by

    T_k = sum over displacements of K(d) C_k(d),   C_k(d) = sum over the patch of q_k(x) scene(x - d)    Eq. (1)

How bright the disc is as a whole is taken out of every answer: `search` has that from the whole field. What scatters in
from beyond the patch is nearly even over a disc, and left out.
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

MARGIN_PX = 28  # of a patch round the disc
REACH_PX = 64  # of Eq. (1)


class NearDiscs:
    """The patches of all discs that take part, added one by one."""

    def __init__(self, view: View) -> None:
        solution = self._solution = view.solution
        shape = solution.transit.shape
        radius_px = max(solution.sky.found[n].place.radius_px for n in solution.part)
        wanted = 2 * math.ceil(radius_px + MARGIN_PX) + 1
        self._size = size = (min(wanted, shape[0]), min(wanted, shape[1]))
        # Any two pixels of a patch are joined by it.
        self._optics = Optics(crop_or_pad(view.kernel, 2 * max(size) - 1), size, threads=solution.threads)
        self._corners: dict[int, tuple[int, int]] = {}
        self._planes: dict[int, NDArray[np.float32]] = {}
        self._residuals: list[Vector] = []
        self._to_displacements: list[NDArray[np.floating]] = []

    def add(self, n: int, scene: Field) -> None:
        """The disc of image n. scene: what lights it [y, x], DN/s."""
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
        """What the cells of all discs leave unexplained, over its noise, each disc's mean left out (cells,)."""
        return np.concatenate(self._residuals)

    def of_kernel(self, change: Plane) -> Vector:
        """How a change of the PSF [y, x], its centre at n // 2, moves the cells, Eq. (1), over their noise (cells,)."""
        near = crop_or_pad(change, 2 * REACH_PX + 1).astype(np.float32)
        responses = [np.tensordot(disc, near, axes=2) for disc in self._to_displacements]
        return np.concatenate(responses, dtype=np.float64)

    def of_copies(self, n: int, image: Field, displacements: Sequence[tuple[int, int]]) -> Plane:
        """How an image [y, x] displaced by whole pixels (x, y) moves the cells of disc n, over their noise (cells, k)."""
        (top, left), planes = self._corners[n], self._planes[n]
        copies = [cut(image, top - dy, left - dx, self._size).ravel() for dx, dy in displacements]
        return np.asarray(
            planes.reshape(planes.shape[0], -1) @ np.array(copies, np.float32).T, dtype=np.float64
        )


def _without(covariance: Plane, level: Vector) -> Plane:
    """What makes the noise of some cells one, and takes out of them what goes like a level."""
    white = whitening(covariance)
    along = white @ level
    along /= max(float(np.linalg.norm(along)), 1e-300)
    return np.asarray(white - np.outer(along, along @ white))


def cut(plane: Any, top: int, left: int, size: tuple[int, int]) -> Any:
    """A part of a plane [y, x], dark where the plane does not reach."""
    out = np.zeros(size, plane.dtype)
    low_y, high_y = (min(max(at, 0), plane.shape[0]) for at in (top, top + size[0]))
    low_x, high_x = (min(max(at, 0), plane.shape[1]) for at in (left, left + size[1]))
    if low_y < high_y and low_x < high_x:
        out[low_y - top : high_y - top, low_x - left : high_x - left] = plane[low_y:high_y, low_x:high_x]
    return out
