"""What discs and lit parts say of every effect at once: normal equations, from which all questions are answered.

Discs. About the solution the residual of the dark pixels is linear in the PSF's coordinates and in every effect's
parameters, so one look at each frame gives A_n = J W J^T and v_n = J W r for all of them together.

Lit parts. Images of one pointing show one scene, so blocks of 32 px are compared between them, the light that the
occulter hides put back:

    U_nb = mu_b (1 + g_n) + sum over parameters of theta e_nb + noise            Eq. (1)

mu_b, the scene, is free in every block, and g_n, the brightness of an image, in every image: the Sun and the shutter
are not steady to a percent. g_n has a prior, of the width that images of one gain mode and exposure show among
themselves, so that a difference between modes can be told from it.

A floor that is common to a disc, f times its expected mean, stands for what no effect knows (Sherman and Morrison):

    A_n -> A_n - c a a^T, v_n -> v_n - c a b,   c = f^2 / (1 + f^2 e W e), a = J W e, b = r W e    Eq. (2)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.gap.effect import Effect, Template, View
from psfcore.scatter.inversion import Progress, Solution
from psfcore.scatter.optics import Blur
from psfcore.transit.occulter import disc_distance
from psfcore.transit.transit import Frame

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]

BLOCK_PX = 32
FREE_OF_DISC_PX = 20.0  # beyond its edge
WIDEST_GAIN = 0.05
LIT_FLOOR = 5e-4
LEAST_IMAGES = 3


@dataclass(frozen=True, eq=False)
class DiscEvidence:
    """One frame's discs: normal equations and what their means say. Columns: PSF coordinates, then parameters.

    observed, expected, noise: of the disc's mean, DN/s. answer: how the expected mean changes with each column.
    a, ee, b: a, e W e and b of Eq. (2).
    """

    index: int
    normal: Matrix
    score: Vector
    a: Vector
    ee: float
    b: float
    answer: Vector
    observed: float
    expected: float
    noise: float


@dataclass(frozen=True, eq=False)
class LitEvidence:
    """The lit parts: normal equations of the effects' parameters, chi2 where none acts, degrees of freedom."""

    normal: Matrix
    score: Vector
    chi2: float
    freedom: int
    gains: Vector


@dataclass(frozen=True, eq=False)
class Evidence:
    """All that a diagnosis goes by."""

    solution: Solution
    effects: tuple[Effect, ...]
    columns: dict[str, tuple[int, ...]]
    base: tuple[int, ...]
    discs: tuple[DiscEvidence, ...]
    lit: LitEvidence | None
    untestable: dict[str, str]

    def summed(self, floor: float, frames: Sequence[int] | None = None) -> tuple[Matrix, Vector]:
        """Normal matrix and score of the discs of some frames (positions in `discs`; none: all), Eq. (2)."""
        size = self.discs[0].score.size
        normal, score = np.zeros((size, size)), np.zeros(size)
        for k in range(len(self.discs)) if frames is None else frames:
            disc = self.discs[k]
            c = floor**2 / (1 + floor**2 * disc.ee)
            normal += disc.normal - c * np.outer(disc.a, disc.a)
            score += disc.score - c * disc.a * disc.b
        return normal, score


def gather(
    solution: Solution,
    library: Sequence[Effect],
    *,
    progress: Progress = lambda stage, step, steps: None,
) -> Evidence:
    """The evidence of a solution on all effects of a library that these data can show."""
    view = View(solution)
    untestable: dict[str, str] = {}
    templates: list[Template] = []
    columns: dict[str, tuple[int, ...]] = {}
    base = tuple(range(solution.inversion.coordinates.size))
    tried = []
    for effect in library:
        reason = effect.why_not(view)
        if reason is not None:
            untestable[effect.name] = reason
            continue
        first = len(base) + len(templates)
        templates.extend(effect.templates(view))
        columns[effect.name] = tuple(range(first, len(base) + len(templates)))
        tried.append(effect)
    slopes = [
        Blur(slope, solution.transit.shape, threads=solution.threads)
        for slope in solution.total.slopes(solution.inversion.coordinates)
    ]
    discs = []
    for k, n in enumerate(solution.part):
        progress("effects in the discs", k, len(solution.part))
        discs.append(_disc(view, k, n, slopes, templates))
    lit = _lit(view, templates, progress)
    for effect in tried:
        here = list(columns[effect.name])
        seen = sum(disc.normal[here, here].sum() for disc in discs)
        if lit is not None:
            seen += float(np.diag(lit.normal)[[c - len(base) for c in here]].sum())
        if not seen > 0:
            untestable[effect.name] = "no image of this transit answers to it"
            del columns[effect.name]
    return Evidence(
        solution=solution,
        effects=tuple(effect for effect in tried if effect.name in columns),
        columns=columns,
        base=base,
        discs=tuple(discs),
        lit=lit,
        untestable=untestable,
    )


def _disc(
    view: View, position: int, n: int, slopes: Sequence[Blur], templates: Sequence[Template]
) -> DiscEvidence:
    solution = view.solution
    residual, expected = solution.residual(n)
    weight = solution.weight(n, expected)
    answers = np.array(
        [solution.answer(n, slope) for slope in slopes] + [template.disc(n) for template in templates]
    )
    weighted = answers * weight
    frame = solution.inversion.frames[position]
    return DiscEvidence(
        index=n,
        normal=weighted @ answers.T,
        score=weighted @ residual,
        a=weighted @ expected,
        ee=float(expected @ (weight * expected)),
        b=float(residual @ (weight * expected)),
        answer=answers.mean(axis=1),
        observed=frame.observed,
        expected=frame.expected,
        noise=frame.noise,
    )


def _lit(view: View, templates: Sequence[Template], progress: Progress) -> LitEvidence | None:
    """Eq. (1) over all pointings; None where no pointing has three images."""
    solution = view.solution
    frames = solution.transit.frames
    fov = np.array([frame.fov for frame in frames])
    pointings = [np.flatnonzero(fov == one) for one in np.unique(fov)]
    pointings = [images for images in pointings if images.size >= LEAST_IMAGES]
    if not pointings:
        return None
    count = len(frames)
    levels, variance, free = _blocks_of_images(view, progress)
    errors = np.zeros((len(templates), count, levels.shape[1]))
    for k, template in enumerate(templates):
        if template.image is not None:
            for n in range(count):
                errors[k, n] = _blocks(np.asarray(template.image(n), dtype=np.float64))
    means = np.array([_blocks(view.lit[n].astype(np.float64)) for n in range(count)])
    size = count + len(templates)
    normal, score, chi2, freedom = np.zeros((size, size)), np.zeros(size), 0.0, 0
    for images in pointings:
        for block in range(levels.shape[1]):
            here = images[free[images, block]]
            if here.size < LEAST_IMAGES:
                continue
            level = levels[here, block]
            w = 1 / (variance[here, block] + (LIT_FLOOR * level) ** 2)
            columns = np.zeros((size, here.size))
            columns[here, np.arange(here.size)] = means[here, block]
            columns[count:] = errors[:, here, block]
            columns -= ((columns @ w) / w.sum())[:, None]  # mu_b is free
            misfit = level - float(level @ w) / w.sum()
            normal += (columns * w) @ columns.T
            score += (columns * w) @ misfit
            chi2 += float(w @ misfit**2)
            freedom += here.size - 1
    return _without_gains(normal, score, chi2, freedom, frames)


def _without_gains(
    normal: Matrix, score: Vector, chi2: float, freedom: int, frames: Sequence[Frame]
) -> LitEvidence:
    """The gains of single images taken out, with a prior as wide as they spread within their own kind."""
    count = len(frames)
    gains_normal = normal[:count, :count]
    free = np.linalg.solve(gains_normal + np.eye(count) / WIDEST_GAIN**2, score[:count])
    kinds = [(f.fov, f.gain_mode, f.exposure_s) for f in frames]
    spread: list[float] = []
    for kind in set(kinds):
        here = np.array([k == kind for k in kinds])
        if here.sum() >= LEAST_IMAGES:
            spread.extend((free[here] - np.median(free[here])) ** 2 * here.sum() / (here.sum() - 1))
    width = float(np.sqrt(np.mean(spread))) if spread else WIDEST_GAIN
    inverse = np.linalg.inv(gains_normal + np.eye(count) / max(width, 1e-5) ** 2)
    cross = normal[count:, :count]
    gains = inverse @ score[:count]
    return LitEvidence(
        normal=normal[count:, count:] - cross @ inverse @ cross.T,
        score=score[count:] - cross @ gains,
        chi2=chi2 - float(score[:count] @ gains),
        freedom=freedom - count,
        gains=gains,
    )


def _blocks_of_images(view: View, progress: Progress) -> tuple[Matrix, Matrix, NDArray[np.bool_]]:
    """Means of blocks with the occulter's light put back, their variance, and which are away from the disc."""
    solution = view.solution
    transit = solution.transit
    places = [found.place for found in solution.sky.found]
    levels, variance, free = [], [], []
    for n, frame in enumerate(transit.frames):
        progress("effects in the lit parts", n, len(transit.frames))
        seen = view.unocculted[n].astype(np.float64)
        level = _blocks(seen)
        levels.append(level)
        variance.append(transit.noise.variance(level, frame.exposure_s) / BLOCK_PX**2)
        near = disc_distance(transit.shape, places[n]) < places[n].radius_px + FREE_OF_DISC_PX
        if frame.filled is not None:
            near = near | frame.filled
        free.append(_blocks(near.astype(np.float64)) == 0)
    return np.array(levels), np.array(variance), np.array(free)


def _blocks(plane: Matrix) -> Vector:
    """Means of blocks of BLOCK_PX; what is left at the far edges is dropped."""
    rows, columns = (n // BLOCK_PX for n in plane.shape)
    cut = plane[: rows * BLOCK_PX, : columns * BLOCK_PX]
    return np.asarray(cut.reshape(rows, BLOCK_PX, columns, BLOCK_PX).mean(axis=(1, 3)).ravel())
