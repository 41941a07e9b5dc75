"""The ideal observer: what noise-free images of a transit could tell about the cause of a gap.

An ideal observer knows the noise and the form of every effect, but not the PSF, the scene, the brightness of the images and
the strength of the effect. Let d be the gap of noise-free images: the residuals in the cells of the discs and the levels of
the unocculted blocks, with the effect minus without it. J_h are the responses to the PSF and to the parameters of the effects
of hypothesis h. With the covariance C of photon and read noise, hypothesis h leaves

    chi2_h = min over theta of (d - J_h theta)^T C^-1 (d - J_h theta)                    Eq. (1)

of the gap. This is the distance of h from the truth: over many noise realisations, chi2 of h exceeds chi2 of the truth by
chi2_h on average, with a standard deviation of 2 sqrt(chi2_h). For the hypothesis without any effect, chi2_h is the
noncentrality: what remains of the gap after the PSF is refitted. Scene and brightness are eliminated from the blocks as in
`unocculted_blocks`; a parameter that cannot be negative is not negative here.

The residuals without the effect are what the sampling on pixels causes. They are subtracted, because the ideal observer knows
them; they come from a fit of their own. All discs are where the images without the effect show them: an effect that moves the
found places of the occulters, such as a changing Sun, does not change what is compared.

Two kinds of effect adapt to the data. A random field has many parameters, and the template of a changing Sun is measured in the
images. They pay for this freedom on average

    cost = sum of [ln(1 + l) - l / (1 + l)] + (MEASURED - 1) n                            Eq. (2)

with l of `linear_model`, Eq. (3), and n the numbers that were measured to build the template (`likelihood`).

The effects are used to first order, at the PSF that was fitted to the images with the effect.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.gap.effect import Effect
from psfcore.gap.evidence.cells import cells_of
from psfcore.gap.evidence.evidence import Evidence, gather
from psfcore.gap.evidence.likelihood import MEASURED
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.evidence.unocculted_blocks import UnoccultedBlocks, unocculted_blocks
from psfcore.gap.view import View
from psfcore.scatter.inversion import Progress, Solution, dark_pixels, invert
from psfcore.transit.transit import Transit

Vector = NDArray[np.float64]

SCHEMA = "gap-ideal/1"


@dataclass(frozen=True)
class Left:
    """What one hypothesis leaves. effects: that act together; empty: no effect. chi2: Eq. (1). cost: Eq. (2)."""

    effects: tuple[str, ...]
    chi2: float
    cost: float


@dataclass(frozen=True)
class IdealObserver:
    """What noise-free images of a transit could tell.

    left: of every hypothesis: no effect, one effect of the library, or two. left_after_refit_pct: the residual that the effect
    leaves in the discs, percent, rms over images. sampling_chi2: chi2 of the residuals that the sampling causes in the discs,
    after the PSF is refitted; they are not part of `left`. untestable: why an effect of the library is in no hypothesis, by
    name.
    """

    left: tuple[Left, ...]
    left_after_refit_pct: float
    sampling_chi2: float
    untestable: dict[str, str]

    @property
    def noncentrality(self) -> float:
        """What remains of the gap after the PSF is refitted."""
        return self.left[0].chi2

    def to_json(self) -> dict[str, Any]:
        """Values for JSON, schema gap-ideal/1."""
        return {
            "schema": SCHEMA,
            "noncentrality": self.noncentrality,
            "left_after_refit_pct": self.left_after_refit_pct,
            "sampling_chi2": self.sampling_chi2,
            "hypotheses": [
                {"effects": list(one.effects), "chi2": one.chi2, "cost": one.cost} for one in self.left
            ],
            "untestable": self.untestable,
        }


def ideal_observer(
    with_effects: Transit,
    without_effects: Transit,
    library: Sequence[Effect],
    *,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> IdealObserver:
    """What the ideal observer of a transit could know. Both transits: noise-free images, with the noise that real ones have.

    Raises the errors of `psfcore.scatter.inversion.invert`, and "bad-effects".
    """
    found = invert(with_effects, threads=threads, progress=progress)
    # Not started at the PSF of `found`: a strong effect can move it so far that the way back is lost.
    clean = invert(without_effects, threads=threads, progress=progress)
    solution = _at_places_of(clean, found)
    evidence = gather(solution, library, progress=progress)
    sampling = _sampling_residuals(evidence, solution, clean)
    blocks = _without_sampling(
        evidence.unocculted, unocculted_blocks(View(clean), len(evidence.base), progress)
    )
    discs = tuple(
        replace(disc, residual=disc.residual - residual)
        for disc, residual in zip(evidence.discs, sampling, strict=True)
    )
    model = LinearModel(replace(evidence, discs=discs, unocculted=blocks), floor=0.0)
    return IdealObserver(
        left=left_by_hypotheses(model),
        left_after_refit_pct=float(
            np.sqrt(np.mean([(100 * disc.share @ disc.residual / disc.level) ** 2 for disc in discs]))
        ),
        sampling_chi2=_chi2_in_discs(model, sampling),
        untestable=evidence.untestable,
    )


def left_by_hypotheses(model: LinearModel) -> tuple[Left, ...]:
    """What every hypothesis leaves of the residuals of a model: no effect, every effect, every pair of effects."""
    effects = model.evidence.effects
    single = [(effect,) for effect in effects]
    return tuple(_left(model, some) for some in [(), *single, *itertools.combinations(effects, 2)])


def _left(model: LinearModel, effects: tuple[Effect, ...]) -> Left:
    evidence, base = model.evidence, len(model.evidence.base)
    # An effect that is fitted for each pointing may have fewer or more changes than parameters.
    paired = [
        (column, parameter.positive)
        for effect in effects
        for column, parameter in zip(evidence.columns[effect.name], effect.parameters, strict=False)
    ]
    columns, positive = [column for column, _ in paired], dict(paired)
    while True:
        step = model.fit(columns)
        sigma = np.sqrt(np.maximum(np.diag(step.covariance)[base:], 1e-300))
        below = [
            (value, column)
            for value, column in zip(step.values[base:] / sigma, columns, strict=True)
            if positive[column] and value < 0
        ]
        if not below:
            break
        columns.remove(min(below)[1])
    learned = model.learned(columns)
    cost = float(np.sum(np.log1p(learned) - learned / (1 + learned)))
    cost += (MEASURED - 1) * evidence.numbers_of(columns)
    whole = sum(float(disc.residual @ disc.residual) for disc in model.discs)
    whole += evidence.all_unocculted.chi2 / model.unocculted_scale
    return Left(tuple(effect.name for effect in effects), max(whole - step.fall, 0.0), cost)


def _at_places_of(clean: Solution, solution: Solution) -> Solution:
    """A solution whose occulters are where another solution found them."""
    sky = solution.sky.copy()
    sky.found = list(clean.sky.found)
    frames = solution.transit.frames
    sky.dark = [dark_pixels(frame, place) for frame, place in zip(frames, sky.found, strict=True)]
    return replace(solution, sky=sky)


def _sampling_residuals(evidence: Evidence, solution: Solution, clean: Solution) -> list[Vector]:
    """The residuals without the effect in the cells of every disc (cells,), DN/s."""
    sky = clean.sky.copy()
    sky.dark = solution.sky.dark
    same_pixels = replace(clean, sky=sky)
    out = []
    for disc in evidence.discs:
        place = solution.sky.found[disc.index].place
        cells = cells_of(solution.sky.dark[disc.index], place.x_px, place.y_px)
        out.append(cells.weights @ same_pixels.residual(disc.index)[0])
    return out


def _without_sampling(seen: UnoccultedBlocks, clean: UnoccultedBlocks) -> UnoccultedBlocks:
    """Blocks with an effect, without those differences between images that also exist without the effect.

    The prior of the brightness gets the width that it would have in images with noise: otherwise noise-free images would say
    that the brightness is known exactly, which no observer of real images can know.
    """
    levels = seen.levels.copy()
    for pointing in np.unique(seen.pointing):
        here = seen.pointing == pointing
        levels[here] -= clean.levels[here] - clean.levels[here].mean(axis=0)
    blocks = replace(seen, levels=levels)
    weight = np.where(blocks.free, 1 / blocks.variance, 0.0)
    information = np.maximum((weight * blocks.means**2).sum(axis=1), 1e-300)
    noise = float(np.median(1 / information))
    return replace(blocks, given_gain_width=math.hypot(blocks.gain_width, math.sqrt(noise)))


def _chi2_in_discs(model: LinearModel, residuals: Sequence[Vector]) -> float:
    """chi2 of some residuals in the cells of the discs, after the coordinates of the PSF are refitted to them."""
    base = list(model.evidence.base)
    seen = np.concatenate([disc.white @ one for disc, one in zip(model.discs, residuals, strict=True)])
    jacobian = np.concatenate([disc.jacobian[base].T for disc in model.discs])
    fitted = np.linalg.lstsq(jacobian, seen, rcond=None)[0]
    return float(np.sum((seen - jacobian @ fitted) ** 2))
