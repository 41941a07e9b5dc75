"""Fit scatter without a formula: fit the light of each shell minus the light that the formula puts in this shell.

Source: Hofmeister et al., The point-spread function of HRI_EUV, section "Results". That section compares a free fit
with the power law for all samples of the cross-validation. Near a fitted PSF, both fits are steps of the same linear
problem, Eq. (4) of `psfcore.scatter.inversion`. That module also defines H, G, D and r; w are the weights 1 /
v of its Eq. (3). The unknown d contains, for each shell, the light of the free fit minus the light of the formula:

    r = D [H D G c d + noise],   c_S = A_S / n_S - B                              Eq. (1)
    minimise over d >= -l   sum w (r - J d)^2 + sum ((d - d_f) / s)^2,   J = D H D G c   Eq. (2)

c_S is the change of the image when light moves from the centre to shell S. A_S and B are computed from the diffracted
scene. Eq. (1) includes the change of the scene, as Eq. (4) of that module does: D [c - H (1 - D) G c] equals D H D G c
if H G = 1. G c consists of ring sums of G B. All shells together therefore need only the ring sums of one image and one
small matrix product. Compared with the exact derivatives, J is accurate to a few percent; for discs near the edge of
the field, it is accurate to a tenth. r is exact.

The normal equations are sums over images: the fit of a bootstrap sample uses the sums of J^T w J and J^T w r over the
images of the sample.

Differences from the paper: all dark pixels are used, with weights from their noise, instead of a thousand pixels
selected by shell. A Gaussian prior of width s about the formula constrains every shell. Near the centre the prior is so
wide that the images determine the shells. Far from the centre the prior is narrow, and the images add little. Without
the prior, the innermost shells cannot be separated from the centre, and the light beyond the field is undetermined.

| symbol | name | unit |
|---|---|---|
| d | step: light of a shell in the free fit minus its light in the formula | fraction of all light |
| d_f | towards: light of a shell in the formula fitted to the sample, minus l | fraction of all light |
| l | law_light: light of the formula in the fitted PSF | fraction of all light |
| A_S | ring sum: sum of the diffracted scene over the pixels of shell S around a pixel | DN/s px^2 |
| B | the diffracted scene: the scene convolved with the diffraction PSF, not with the scatter | DN/s |
| n_S | counts: number of pixels of shell S | px^2 |
| s | looseness: width of the prior | fraction of all light |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.optimize import lsq_linear

from psfcore.arrays import Kernel, Matrix, Vector
from psfcore.convolution.convolver import Convolver
from psfcore.psf import REACH_GRID_PX
from psfcore.scatter.reconstruction import Progress, Reconstruction
from psfcore.scatter.segments import Segments, segment_sums, shells_as_published
from psfcore.scatter.shapes import Shape
from psfcore.scatter.total_psf import Blur, pick

NEAR_PX = 100.0
# Width of the prior divided by the formula's light in the shell: for shells within NEAR_PX, and for shells beyond.
NEAR_LOOSE, FAR_LOOSE = 10.0, 1.0
LEAST_LIGHT = 1e-5  # smallest width of the prior, as a fraction of all light


@dataclass(frozen=True, eq=False)
class FreeLight:
    """A free fit: light in each shell without a formula.

    Attributes
    ----------
    light
        The fitted light in each shell, as a fraction of all light.
    law_light
        The light that the formula puts in each shell.
    covariance
        Covariance matrix of `light`, (shells, shells); it includes the prior.
    """

    light: Vector
    law_light: Vector
    covariance: Matrix


@dataclass(frozen=True, eq=False)
class FreeShares:
    """The contributions of each image to the normal equations of Eq. (2), near one PSF.

    Attributes
    ----------
    normal
        The matrices J^T w J, (images, shells, shells).
    score
        The right-hand sides J^T w r, (images, shells).
    frames
        Indices of the images.
    law_light
        The light that the formula of this PSF puts in each shell.
    """

    frames: tuple[int, ...]
    law_light: Vector
    normal: Matrix
    score: Matrix

    def fit(self, counts: Sequence[int], law_light: Vector) -> FreeLight:
        """Solve Eq. (2).

        Parameters
        ----------
        counts
            The number of times that each image of the transit counts.
        law_light
            Centre of the prior.
        """
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
    """The 50 shells of the paper, on the full reach."""
    return Segments(shells_as_published())


def law_light(shape: Shape, coordinates: Vector) -> Vector:
    """The light that the formula puts in each shell, as a fraction of all light."""
    return shells().mean_of_map(shape.kernel(coordinates, REACH_GRID_PX)) * shells().counts


def looseness_of(light: Vector) -> Vector:
    """The width s of the prior for each shell, from the light that the formula puts in each shell (`light`)."""
    edges = np.array(shells().edges_px)
    near = edges[1:] <= NEAR_PX
    return np.maximum(np.where(near, NEAR_LOOSE, FAR_LOOSE) * light, LEAST_LIGHT)


def free_shares(
    of: Reconstruction,
    coordinates: Vector,
    *,
    progress: Progress = lambda stage, step, steps: None,
) -> FreeShares:
    """Compute FreeShares for the fitted images, near the PSF at these coordinates."""
    diffract = Blur(of.transit.diffraction, of.transit.shape, threads=of.threads)
    kernel = of.total.kernel(coordinates)
    counts = shells().counts
    normals, scores = [], []
    for step, n in enumerate(of.part):
        progress("free shells", step, len(of.part))
        residual, expected = of.residual(n)
        rows, columns = dark = of.sky.dark[n]
        inverted = of.optics.invert_once(diffract.convolve(of.blanked_scene(n)))  # G B
        sums = segment_sums(diffract.field(inverted), np.stack(dark, axis=1), shells(), threads=of.threads)
        middle = kernel.shape[0] // 2
        within = kernel[middle + rows[:, None] - rows[None, :], middle + columns[:, None] - columns[None, :]]
        slopes = within @ (sums / counts - pick(inverted, dark)[:, None])  # Eq. (1)
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
    """The total PSF [y, x] of a free fit, on (size, size).

    In each shell, the formula is scaled so that the shell contains the fitted light.
    """
    ratio = np.divide(free.light, free.law_light, out=np.ones_like(free.light), where=free.law_light > 0)
    label = shells().label_map(size)
    scatter = shape.kernel(coordinates, size) * np.where(label >= 0, ratio[np.maximum(label, 0)], 1.0)
    scatter[size // 2, size // 2] = 1 - free.light.sum()
    diffract = Convolver(diffraction, (size, size), dtype=np.float64, threads=threads)
    return np.asarray(diffract.apply(scatter), dtype=np.float64)
