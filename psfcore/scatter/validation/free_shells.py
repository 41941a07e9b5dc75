"""Scatter without a formula, beside the formula that was fitted: what every shell holds more or less than it.

Hofmeister et al., The point-spread function of HRI_EUV, section "Results": a free fit beside the power law's, for all
draws of a cross-validation. About a fitted PSF both are steps of one and the same problem, Eq. (4) of `inversion`.
With d the light of each shell beyond that of the formula, and H, G, D and r as there,

    r = D [H D G c d + noise],   c_S = A_S / n_S - B                              Eq. (1)
    minimise over d >= -l   sum w (r - J d)^2 + sum ((d - d_f) / s)^2,   J = D H D G c   Eq. (2)

c_S, what light that goes from the centre to shell S changes in the image, with A_S and B of the diffracted scene.
Eq. (1) has the scene answer too, as Eq. (4) there: its D [c - H (1 - D) G c] is D H D G c where H G = 1, and G c are
ring sums of G B. So all shells cost the ring sums of one image, and one small product. Beside the slopes themselves J
is good to a few percent, and to a tenth for discs near the field's edge; r is exact.

Images add up: a draw's fit is made of the sums of its images' J^T w J and J^T w r.

Departures: all dark pixels count by their noise, not a thousand drawn ones by their shell; every shell is held to the
formula, by s. Near it is held so looseness_of that the images decide, far out so that they hardly can. Without a hold the
innermost shells and the centre cannot be told apart, and the light beyond the field is anything.

| symbol | name | unit |
|---|---|---|
| d | step: light of a shell beyond that of the formula | of all light |
| d_f, l | towards, law_light: the formula's after and before the draw's own step | of all light |
| A_S, B, n_S | ring sums, unscattered, counts | DN/s, DN/s, px |
| s | looseness | of all light |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from psfcore.convolution.convolver import Convolver
from psfcore.psf import REACH_GRID_PX
from psfcore.scatter.as_published.ring_sums import segment_sums
from psfcore.scatter.as_published.segments import Segments, shells_as_published
from psfcore.scatter.inversion import Progress, Reconstruction
from psfcore.scatter.optics import Blur, pick
from psfcore.scatter.shapes import Shape, Vector
from psfcore.scatter.total_psf import Kernel

Matrix = NDArray[np.float64]

NEAR_PX = 100.0
NEAR_LOOSE, FAR_LOOSE = (
    10.0,
    1.0,
)  # times the formula's light of a shell: one sigma of what it may hold beyond
LEAST_LIGHT = 1e-5  # that a shell may hold beyond the formula at one sigma, however little that gives it


@dataclass(frozen=True, eq=False)
class FreeLight:
    """A free fit: light of each shell, of all light, and its covariance (shells, shells), the hold's part included.

    law_light: the formula's.
    """

    light: Vector
    law_light: Vector
    covariance: Matrix


@dataclass(frozen=True, eq=False)
class FreeShares:
    """What each image says of the shells about one PSF: J^T w J (images, shells, shells) and J^T w r, Eq. (2).

    frames: the images' indices. law_light: of the PSF's formula.
    """

    frames: tuple[int, ...]
    law_light: Vector
    normal: Matrix
    score: Matrix

    def fit(self, counts: Sequence[int], law_light: Vector) -> FreeLight:
        """Eq. (2) with each image as often as counts (of all images by index) says, held to law_light."""
        times = np.array([counts[n] for n in self.frames], dtype=np.float64)
        looseness = looseness_of(self.law_light)
        towards = law_light - self.law_light
        normal = np.einsum("n,nij->ij", times, self.normal) + np.diag(looseness**-2)
        score = times @ self.score + towards / looseness**2
        triangle = np.linalg.cholesky(normal).T
        target = np.linalg.solve(triangle.T, score)
        step = lsq_linear(triangle, target, bounds=(-self.law_light, np.inf), method="trf").x
        return FreeLight(self.law_light + step, law_light, np.linalg.inv(normal))


@cache
def shells() -> Segments:
    """The paper's 50 shells, on the full reach."""
    return Segments(tuple(shells_as_published()))


def law_light(shape: Shape, coordinates: Vector) -> Vector:
    """Light of each shell by the formula, of all light."""
    return shells().mean_of_map(shape.kernel(coordinates, REACH_GRID_PX)) * shells().counts


def looseness_of(light: Vector) -> Vector:
    """By how much each shell may differ from the formula, at one sigma of the hold."""
    edges = np.array(shells().edges_px)
    near = edges[1:] <= NEAR_PX
    return np.maximum(np.where(near, NEAR_LOOSE, FAR_LOOSE) * light, LEAST_LIGHT)


def free_shares(
    of: Reconstruction,
    coordinates: Vector,
    *,
    progress: Progress = lambda stage, step, steps: None,
) -> FreeShares:
    """What the images that took part say of the shells, about the PSF at these coordinates of its formula."""
    diffract = Blur(of.transit.diffraction, of.transit.shape, threads=of.threads)
    kernel = of.total.kernel(coordinates)
    counts = shells().counts
    normals, scores = [], []
    for step, n in enumerate(of.part):
        progress("free shells", step, len(of.part))
        residual, expected = of.residual(n)
        rows, columns = dark = of.sky.dark[n]
        undone = of.optics.invert_once(diffract.convolve(of.blanked_scene(n)))  # G B
        sums = segment_sums(diffract.field(undone), np.stack(dark, axis=1), shells(), threads=of.threads)
        middle = kernel.shape[0] // 2
        within = kernel[middle + rows[:, None] - rows[None, :], middle + columns[:, None] - columns[None, :]]
        slopes = within @ (sums / counts - pick(undone, dark)[:, None])  # Eq. (1)
        weighted = slopes.T * of.weight(n, expected)
        normals.append(weighted @ slopes)
        scores.append(weighted @ residual)
    return FreeShares(
        frames=of.part,
        law_light=law_light(of.total.shape, coordinates),
        normal=np.array(normals),
        score=np.array(scores),
    )


def free_kernel(
    free: FreeLight, shape: Shape, coordinates: Vector, diffraction: Kernel, size: int, *, threads: int = 1
) -> Kernel:
    """The total PSF [y, x] of a free fit on (size, size): the formula, scaled in each shell to the light found there."""
    ratio = np.divide(free.light, free.law_light, out=np.ones_like(free.light), where=free.law_light > 0)
    label = shells().label_map(size)
    scatter = shape.kernel(coordinates, size) * np.where(label >= 0, ratio[np.maximum(label, 0)], 1.0)
    scatter[size // 2, size // 2] = 1 - free.light.sum()
    diffract = Convolver(diffraction, (size, size), dtype=np.float64, threads=threads)
    return np.asarray(diffract.apply(scatter), dtype=np.float64)
