"""What the lit parts say: images of one pointing show one scene, so blocks of them are compared with each other.

The light that the occulter hides is put back. In block b of image n

    U_nb = mu_b (1 + g_n) + sum over parameters of theta e_nb + noise            Eq. (1)

mu_b, the scene, is free in every block, and g_n, the brightness of an image, in every image: the Sun and the shutter
are not steady to a percent. g_n has a prior, of the width that images of one pointing, gain mode and exposure show among
themselves, so that a difference between modes can be told from it. A bright block that differs between images far more
than the others do is the Sun's own, a brightening that flickers: where it is asked what is left, its variance is what it shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from psfcore.gap.effect import View
from psfcore.scatter.inversion import Progress, Solution
from psfcore.transit.occulter import disc_distance

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]

BLOCK_PX = 32
LEAST_BLOCKS = 5  # along the shorter side; smaller images have smaller blocks
FREE_OF_DISC_PX = 20.0  # beyond its edge
WIDEST_GAIN = 0.05
LEAST_GAIN = 1e-5
FLOOR = 5e-4  # of a block's level: no template is more exact
LEAST_IMAGES = 3
RESTLESS = 4.0  # times the median block's chi2 a degree of freedom


@dataclass(frozen=True, eq=False)
class LitBlocks:
    """Blocks of all images: (images, blocks) in DN/s.

    levels: means, the hidden light put back. variance: of noise, and of a floor. free: which are away from disc and
    filled pixels. means: of the pointing's mean image. errors: (columns, images, blocks), what a unit of each column
    does. fov: pointing of each image. kind: images of one pointing, gain mode and exposure have one number. part: images
    that are used at all.
    """

    levels: Matrix
    variance: Matrix
    free: NDArray[np.bool_]
    means: Matrix
    errors: NDArray[np.float64]
    fov: NDArray[np.int64]
    kind: NDArray[np.int64]
    part: NDArray[np.bool_]

    def with_restless_blocks(self) -> LitBlocks:
        """The same with the variance of restless blocks raised to what they show."""
        variance = self.variance.copy()
        gains = self._equations(np.flatnonzero(self.part), np.zeros(0, int), WIDEST_GAIN).gains
        steady = self.levels / (1 + gains[:, None])
        for fov in np.unique(self.fov):
            here = np.flatnonzero((self.fov == fov) & self.part)
            weight = np.where(self.free[here], 1 / self.variance[here], 0.0)
            images = (weight > 0).sum(axis=0)
            used = images >= LEAST_IMAGES
            if not used.any():
                continue
            mean = (steady[here] * weight).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-300)
            spread = (weight * (steady[here] - mean) ** 2).sum(axis=0) / np.maximum(images - 1, 1)
            usual = max(float(np.median(spread[used])), 1.0)
            # What the detector does to faint signals shows in faint blocks: those are left alone.
            bright = used & (mean > float(np.median(mean[used])))
            variance[here] *= np.where(bright & (spread > RESTLESS * usual), spread / usual, 1.0)
        return replace(self, variance=variance)

    @cached_property
    def gain_width(self) -> float:
        """How much the brightness of images of one kind spreads, a share."""
        free = self._equations(np.flatnonzero(self.part), np.zeros(0, int), WIDEST_GAIN).gains
        spread: list[float] = []
        for kind in np.unique(self.kind[self.part]):
            here = (self.kind == kind) & self.part
            if here.sum() >= LEAST_IMAGES:
                spread.extend((free[here] - np.median(free[here])) ** 2 * here.sum() / (here.sum() - 1))
        return max(float(np.sqrt(np.mean(spread))), LEAST_GAIN) if spread else WIDEST_GAIN

    def equations(self, columns: Sequence[int], images: Sequence[int] | None = None) -> LitEquations:
        """Normal equations of these columns from some images (none: all), scene and brightness free."""
        chosen = (
            np.flatnonzero(self.part) if images is None else np.array([n for n in images if self.part[n]])
        )
        return self._equations(chosen, np.asarray(columns, dtype=int), self.gain_width)

    def _equations(self, images: NDArray[np.intp], columns: NDArray[np.intp], width: float) -> LitEquations:
        size = columns.size
        count = self.levels.shape[0]
        normal, score, chi2, freedom = np.zeros((size + count,) * 2), np.zeros(size + count), 0.0, 0
        for fov in np.unique(self.fov[images]) if images.size else []:
            here = images[self.fov[images] == fov]
            if here.size < LEAST_IMAGES:
                continue
            weight = np.where(self.free[here], 1 / self.variance[here], 0.0)
            weight[:, (weight > 0).sum(axis=0) < LEAST_IMAGES] = 0.0
            total = np.maximum(weight.sum(axis=0), 1e-300)
            design = np.zeros((size + count, here.size, self.levels.shape[1]))
            design[:size] = self.errors[columns][:, here]
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
        return _without_gains(normal, score, chi2, freedom, size, width, used_images=int(images.size))

    def held_out(
        self, columns: Sequence[int], images: Sequence[int], fitted: Sequence[int]
    ) -> tuple[Vector, Matrix]:
        """Images against the scene of others, in units of the noise, and what a unit of each column takes from that.

        (n,) and (columns, n): the blocks of each image, and its brightness in units of how much this spreads.
        """
        errors = self.errors[list(columns)]
        residuals, answered = [np.zeros(0)], [np.zeros((len(columns), 0))]
        for n in images:
            others = [k for k in fitted if self.fov[k] == self.fov[n] and self.part[k]]
            if not self.part[n] or len(others) < LEAST_IMAGES - 1:
                continue
            here = np.array(others)
            weight = np.where(self.free[here], 1 / self.variance[here], 0.0)
            total = weight.sum(axis=0)
            use = self.free[n] & ((weight > 0).sum(axis=0) >= LEAST_IMAGES - 1)
            if not use.any():
                continue
            w = 1 / (self.variance[n, use] + 1 / total[use])
            mean = self.means[n, use]

            def in_noise(differing: Matrix, w: Vector = w, mean: Vector = mean) -> Matrix:
                along = (w * mean * differing).sum(axis=-1) / ((w * mean**2).sum() + 1 / self.gain_width**2)
                steady = np.sqrt(w) * (differing - along[..., None] * mean)
                return np.concatenate([steady, along[..., None] / self.gain_width], axis=-1)

            scene = (self.levels[here] * weight).sum(axis=0)[use] / total[use]
            residuals.append(in_noise(self.levels[n, use] - scene))
            answered.append(
                in_noise(errors[:, n, use] - (errors[:, here] * weight).sum(axis=1)[:, use] / total[use])
            )
        return np.concatenate(residuals), np.concatenate(answered, axis=1)


@dataclass(frozen=True, eq=False)
class LitEquations:
    """Normal equations of some columns, brightness and scene taken out; chi2 where none acts; degrees of freedom.

    gains: brightness of each image, where none acts.
    """

    normal: Matrix
    score: Vector
    chi2: float
    freedom: int
    gains: Vector


def _without_gains(
    normal: Matrix, score: Vector, chi2: float, freedom: int, size: int, width: float, *, used_images: int
) -> LitEquations:
    of_gains = normal[size:, size:]
    inverse = np.linalg.inv(of_gains + np.eye(of_gains.shape[0]) / width**2)
    cross = normal[:size, size:]
    gains = inverse @ score[size:]
    return LitEquations(
        normal=normal[:size, :size] - cross @ inverse @ cross.T,
        score=score[:size] - cross @ gains,
        chi2=chi2 - float(score[size:] @ gains),
        freedom=max(freedom - used_images, 1),
        gains=gains,
    )


def block_px(shape: tuple[int, int]) -> int:
    """Edge of a block: BLOCK_PX, less in small images."""
    return max(1, min(BLOCK_PX, min(shape) // LEAST_BLOCKS))


def blocks(plane: NDArray[np.floating]) -> Vector:
    """Means of a plane's blocks; what is left at the far edges is dropped."""
    edge = block_px((plane.shape[0], plane.shape[1]))
    rows, columns = (n // edge for n in plane.shape)
    cut = plane[: rows * edge, : columns * edge]
    return np.asarray(cut.reshape(rows, edge, columns, edge).mean(axis=(1, 3), dtype=np.float64).ravel())


def not_compared(solution: Solution, n: int) -> NDArray[np.bool_]:
    """Which pixels [y, x] of image n do not show what its pointing's other images do: round its disc, and filled in."""
    place, filled = solution.sky.found[n].place, solution.transit.frames[n].filled
    near = disc_distance(solution.transit.shape, place) < place.radius_px + FREE_OF_DISC_PX
    return near if filled is None else near | filled


def lit_blocks(view: View, columns: int, progress: Progress) -> LitBlocks:
    """Blocks of all images, with room for the errors of some columns; the caller fills those in."""
    solution = view.solution
    transit = solution.transit
    levels, variance, free, means = [], [], [], []
    for n, frame in enumerate(transit.frames):
        progress("lit parts", n, len(transit.frames))
        levels.append(blocks(view.unocculted[n]))
        means.append(blocks(view.lit[n]))
        pixels = block_px(transit.shape) ** 2
        noise = transit.noise.variance(means[-1], frame.exposure_s) / pixels
        variance.append(noise + (FLOOR * levels[-1]) ** 2)
        free.append(blocks(not_compared(solution, n).astype(np.float64)) == 0)
    kinds = [(f.pointing, f.gain_mode, f.exposure_s) for f in transit.frames]
    number = {kind: k for k, kind in enumerate(dict.fromkeys(kinds))}
    shape = np.shape(levels)
    return LitBlocks(
        levels=np.array(levels),
        variance=np.array(variance),
        free=np.array(free),
        means=np.array(means),
        errors=np.zeros((columns, *shape)),
        fov=np.array([f.pointing for f in transit.frames]),
        kind=np.array([number[kind] for kind in kinds]),
        part=np.ones(len(transit.frames), dtype=bool),
    )
