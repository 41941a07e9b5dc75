"""The blocks of the unocculted field: square means, compared between the images of one pointing.

All images of a pointing show the same scene, so differences between their blocks show an effect. First, the light that
the occulter hides is added to each image. Then the level of block b in image n is

    U_nb = mu_b (1 + g_n) + sum over parameters of theta e_nb + noise            Eq. (1)

The scene mu_b is a free parameter of every block. The relative brightness g_n is a free parameter of every image,
because the Sun and the shutter vary by about one percent. e_nb is the change of the block by one unit of the parameter
theta.

g_n has a Gaussian prior. The width of the prior is the spread of g_n among images of the same pointing, gain mode and
exposure; a difference between gain modes can then be separated from g_n.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from psfcore.arrays import Flags, Matrix, Vector, squares
from psfcore.gap.view import View
from psfcore.scatter.reconstruction import Progress
from psfcore.transit.occulter import disc_distance

BLOCK_PX = 32
# Number of blocks along the shorter side: small images get smaller blocks, large ones get larger blocks.
LEAST_BLOCKS, MOST_BLOCKS = 5, 32
FREE_OF_DISC_PX = 20.0  # pixels up to this distance from the edge of the disc are not compared
WIDEST_GAIN = 0.05  # width of the prior of g_n if the images do not show its spread
LEAST_GAIN = 1e-5  # smallest width of the prior of g_n
FLOOR = 5e-4  # relative error of the level of a block, because no template is more exact
LEAST_IMAGES = 3


@dataclass(frozen=True, eq=False)
class UnoccultedBlocks:
    """The blocks of all images. Arrays have the shape (images, blocks) and the unit DN/s, if not stated otherwise.

    Attributes
    ----------
    levels
        The mean of each block, with the hidden light added.
    variance
        The variance of the noise plus the variance of the floor, (DN/s)^2.
    free
        Whether a block is away from the disc and from filled pixels.
    means
        The mean of each block in the mean image of the pointing.
    errors
        The change (columns, images, blocks) by one unit of the parameter of each column.
    pointing
        The number of the pointing of each image, (images,).
    kind
        The kind of each image, (images,): one number for each combination of pointing, gain mode and exposure.
    part
        Whether each image is used, (images,).
    across
        The number of blocks in a row of blocks.
    given_gain_width
        The width of the prior of g_n; None: the spread of g_n in these images.
    """

    levels: Matrix
    variance: Matrix
    free: Flags
    means: Matrix
    errors: Matrix
    pointing: NDArray[np.int64]
    kind: NDArray[np.int64]
    part: Flags
    across: int
    given_gain_width: float | None = None

    @cached_property
    def gain_width(self) -> float:
        """The width of the prior of g_n: `given_gain_width`; if this is None, the rms spread of g_n in images of the
        same kind.
        """
        if self.given_gain_width is not None:
            return self.given_gain_width
        every, spread = self.equations((), width=WIDEST_GAIN).gains, list[float]()
        for kind in np.unique(self.kind[self.part]):
            gains = every[(self.kind == kind) & self.part]
            if gains.size >= LEAST_IMAGES:
                spread.extend((gains - np.median(gains)) ** 2 * gains.size / (gains.size - 1))
        return max(float(np.sqrt(np.mean(spread))), LEAST_GAIN) if spread else WIDEST_GAIN

    @property
    def _weights(self) -> Matrix:
        """1 / variance of each block; 0 if it is not compared with other images (images, blocks)."""
        return np.where(self.free, 1 / self.variance, 0.0)

    def equations(
        self, columns: Sequence[int], images: Sequence[int] | None = None, *, width: float | None = None
    ) -> UnoccultedEquations:
        """The normal equations of these columns.

        Scene and brightness are free parameters.

        Parameters
        ----------
        images
            The images to use; None: all.
        width
            The width of the prior of g_n; None: `gain_width`.
        """
        every = range(len(self.part)) if images is None else images
        chosen = np.array([n for n in every if self.part[n]], dtype=int)
        size, count = len(columns), self.levels.shape[0]
        normal, score, chi2, freedom = np.zeros((size + count,) * 2), np.zeros(size + count), 0.0, 0
        for pointing in np.unique(self.pointing[chosen]):
            here = chosen[self.pointing[chosen] == pointing]
            if here.size < LEAST_IMAGES:
                continue
            weight = self._weights[here]
            weight[:, (weight > 0).sum(axis=0) < LEAST_IMAGES] = 0.0
            total = np.maximum(weight.sum(axis=0), 1e-300)
            design = np.zeros((size + count, here.size, self.levels.shape[1]))
            design[:size] = self.errors[list(columns)][:, here]
            design[size + here, np.arange(here.size)] = self.means[here]
            design -= ((design * weight).sum(axis=1) / total)[:, None]  # mu_b is free
            level = self.levels[here]
            misfit = level - (level * weight).sum(axis=0) / total
            flat = (design * weight).reshape(size + count, -1)
            normal += flat @ design.reshape(size + count, -1).T
            score += flat @ misfit.ravel()
            chi2 += float((weight * misfit**2).sum())
            used = weight > 0
            freedom += int(used.sum() - used.any(axis=0).sum())
        precision = (self.gain_width if width is None else width) ** -2.0
        inverse = np.linalg.inv(normal[size:, size:] + np.eye(count) * precision)
        cross = normal[:size, size:]
        gains = inverse @ score[size:]
        return UnoccultedEquations(
            normal=normal[:size, :size] - cross @ inverse @ cross.T,
            score=score[:size] - cross @ gains,
            chi2=chi2 - float(score[size:] @ gains),
            freedom=max(freedom - chosen.size, 1),
            independent=max(freedom - float(np.sum(normal[size:, size:] * inverse)), 1.0),
            gains=gains,
        )

    def held_out(self, columns: Sequence[int], n: int, fitted: Sequence[int]) -> tuple[Vector, Matrix]:
        """The held-out image n minus the scene of the fitted images (values,), and the Jacobian of this difference
        (columns, values), in units of the noise.

        The two results contain the values of the blocks, followed by the brightness in units of `gain_width`; nothing
        if the scene is not known.

        Parameters
        ----------
        fitted
            The images that give the scene.
        """
        errors = self.errors[list(columns)]
        here = [k for k in fitted if self.pointing[k] == self.pointing[n] and self.part[k]]
        weight = self._weights[here]
        use = self.free[n] & ((weight > 0).sum(axis=0) >= LEAST_IMAGES - 1)
        if not (self.part[n] and use.any()):
            return np.zeros(0), np.zeros((len(columns), 0))
        total, mean = weight.sum(axis=0), self.means[n, use]
        w = 1 / (self.variance[n, use] + 1 / total[use])

        def in_noise(differing: Matrix) -> Matrix:
            along = (w * mean * differing).sum(axis=-1) / ((w * mean**2).sum() + 1 / self.gain_width**2)
            steady = np.sqrt(w) * (differing - along[..., None] * mean)
            return np.concatenate([steady, along[..., None] / self.gain_width], axis=-1)

        scene = (self.levels[here] * weight).sum(axis=0)[use] / total[use]
        changed = (errors[:, here] * weight).sum(axis=1)[:, use] / total[use]
        return in_noise(self.levels[n, use] - scene), in_noise(errors[:, n, use] - changed)


@dataclass(frozen=True, eq=False)
class UnoccultedEquations:
    """Normal equations of some columns, with brightness and scene eliminated.

    Attributes
    ----------
    normal
        The normal matrix of the columns.
    score
        The right-hand side of the equations.
    chi2
        The chi2 after the fit of scene and brightness alone, without the columns.
    freedom
        Degrees of freedom of `chi2`, if the brightness of every image is free.
    independent
        Degrees of freedom of `chi2` with the prior of the brightness, which leaves the brightness less free.
    gains
        The fitted g_n of each image, without the columns.
    """

    normal: Matrix
    score: Vector
    chi2: float
    freedom: int
    independent: float
    gains: Vector


def block_px(shape: tuple[int, int]) -> int:
    """The edge length of a block, px: BLOCK_PX, less in small images, and more in large ones."""
    return max(1, min(BLOCK_PX, min(shape) // LEAST_BLOCKS), min(shape) // MOST_BLOCKS)


def block_means(plane: NDArray[np.floating], edge: int) -> Matrix:
    """The means of a plane [y, x] over squares of `edge` px. Incomplete squares in the last rows and columns are
    dropped.
    """
    return np.asarray(squares(plane, edge).mean(axis=(1, 3), dtype=np.float64))


def blocks(plane: NDArray[np.floating]) -> Vector:
    """The mean of each block of a plane [y, x]: (blocks,)."""
    return block_means(plane, block_px((plane.shape[0], plane.shape[1]))).ravel()


def unocculted_blocks(view: View, columns: int, progress: Progress) -> UnoccultedBlocks:
    """The blocks of all images. `errors` of the result is zero; the caller fills it in.

    Parameters
    ----------
    columns
        The number of columns of `errors`.
    """
    transit, edge = view.solution.transit, block_px(view.solution.transit.shape)
    levels, variance, free, means = [], [], [], []
    for n, (frame, seen) in enumerate(zip(transit.frames, view.solution.sky.found, strict=True)):
        progress("unocculted field", n, len(transit.frames))
        levels.append(blocks(view.unocculted[n]))
        means.append(blocks(view.pointing_means[n]))
        noise = transit.noise.variance(means[-1], frame.exposure_s) / edge**2
        variance.append(noise + (FLOOR * levels[-1]) ** 2)
        near = disc_distance(transit.shape, seen.place) < seen.place.radius_px + FREE_OF_DISC_PX
        if frame.filled is not None:
            near |= frame.filled
        free.append(blocks(near.astype(np.float64)) == 0)
    kinds = [(f.pointing, f.gain_mode, f.exposure_s) for f in transit.frames]
    number = {kind: k for k, kind in enumerate(dict.fromkeys(kinds))}
    return UnoccultedBlocks(
        levels=np.array(levels),
        variance=np.array(variance),
        free=np.array(free),
        means=np.array(means),
        errors=np.zeros((columns, *np.shape(levels))),
        pointing=np.array([f.pointing for f in transit.frames]),
        kind=np.array([number[kind] for kind in kinds]),
        part=np.ones(len(transit.frames), dtype=bool),
        across=transit.shape[1] // edge,
    )
