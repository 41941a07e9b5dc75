"""The ideal observer: how well noise-free images of a transit distinguish the hypotheses about the cause of a gap.

An ideal observer knows the noise and the form of every effect, but not the PSF, the scene, the brightness of the images and
the strength of the effect. Let d be the gap of noise-free images: the residuals in the cells of the discs and the levels of
the unocculted blocks, with the effect minus without it. J_h are the responses to the PSF and to the parameters of the effects
of hypothesis h. C is the covariance of photon and read noise. After
the fit of hypothesis h, the chi2 of the remaining gap is

    chi2_h = min over theta of (d - J_h theta)^T C^-1 (d - J_h theta)          Eq. (1)

This is the distance of h from the truth: over many noise realisations, the chi2 of h exceeds the chi2 of the truth by
chi2_h on average, with a standard deviation of 2 sqrt(chi2_h). For the hypothesis without any effect, chi2_h is the
noncentrality: the chi2 of the gap that remains after the PSF is refitted. Scene and brightness are eliminated from the
blocks as in `unocculted_blocks`. A parameter that cannot be negative is fitted with this limit.

In images without the effect, only the sampling on pixels causes residuals. The ideal observer knows these residuals, so
they are subtracted. A separate fit to the images without the effect gives them. The positions of all discs are also
those of this fit. An effect that shifts the fitted positions, such as a changing Sun, therefore does not change which
pixels are compared.

Two kinds of effect adapt to the data. A random field has many parameters, and the template of a changing Sun is
measured in the images. This freedom has a cost, in units of chi2. Its mean over noise realisations is

    cost = sum of [ln(1 + l) - l / (1 + l)] + (MEASURED - 1) n                            Eq. (2)

where l are the eigenvalues of Eq. (3) in `linear_model`, and n is the number of values that were measured to build the
template (`likelihood`).

The effects are used to first order, at the PSF that was fitted to the images with the effect.

    python -m psfcore.gap.ideal_observer FOLDER FILE.json

FOLDER/with_effects and FOLDER/without_effects are transits of noise-free images (DN, fractions allowed), with the noise figures
that images of this transit have. It is a separate program, so that the code that simulated the transit and the gap
library share nothing.
"""

from __future__ import annotations

import itertools
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.build import known_diffraction
from psfcore.errors import DataError
from psfcore.files import write_whole
from psfcore.fits.blocks import LIMITS
from psfcore.gap.effect import Effect
from psfcore.gap.evidence.cells import cells_of
from psfcore.gap.evidence.evidence import Evidence, gather
from psfcore.gap.evidence.likelihood import MEASURED
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.evidence.unocculted_blocks import UnoccultedBlocks, unocculted_blocks
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.view import View
from psfcore.scatter.inversion import invert
from psfcore.scatter.reconstruction import Solution, dark_pixels
from psfcore.transit.folder import read_transit
from psfcore.transit.transit import Transit

Vector = NDArray[np.float64]

SCHEMA = "gap-ideal/1"


@dataclass(frozen=True)
class Left:
    """One hypothesis: the effects that act together (empty: no effect), chi2 of Eq. (1), and cost of Eq. (2)."""

    effects: tuple[str, ...]
    chi2: float
    cost: float


@dataclass(frozen=True)
class IdealObserver:
    """What an ideal observer could know about a transit.

    left: one entry for every hypothesis: no effect, one effect of the library, or two. left_after_refit_pct: the
    residual that the effect leaves in the discs, percent, rms over images. sampling_chi2: chi2 of the residuals that
    the sampling causes in the discs, after the PSF is refitted; they are not part of `left`. untestable: the reasons
    why effects of the library are in no hypothesis, by name.
    """

    left: tuple[Left, ...]
    left_after_refit_pct: float
    sampling_chi2: float
    untestable: dict[str, str]

    @property
    def noncentrality(self) -> float:
        """The chi2 of the gap that remains after the PSF is refitted, without any effect in the model."""
        return self.left[0].chi2

    def to_json(self) -> dict[str, Any]:
        """Values for JSON, schema gap-ideal/1."""
        return {
            "schema": SCHEMA,
            "noncentrality": self.noncentrality,
            "left_after_refit_pct": self.left_after_refit_pct,
            "sampling_chi2": self.sampling_chi2,
            "hypotheses": [asdict(one) for one in self.left],
            "untestable": self.untestable,
        }


def ideal_observer(
    with_effects: Transit, without_effects: Transit, library: Sequence[Effect]
) -> IdealObserver:
    """What the ideal observer of a transit could know. Both transits: noise-free images that state the noise of real ones.

    Raises the errors of `psfcore.scatter.inversion.invert`, and "bad-effects".
    """
    found = invert(with_effects)
    # This fit does not start at the PSF of `found`: a strong effect can change that PSF so much that the fit would fail.
    clean = invert(without_effects)
    solution = _at_places_of(clean, found)
    evidence = gather(solution, library)
    sampling = _sampling_residuals(evidence, solution, clean)
    blocks = _without_sampling(
        evidence.unocculted,
        unocculted_blocks(View(clean), len(evidence.base), lambda stage, step, steps: None),
    )
    discs = tuple(
        replace(disc, residual=disc.residual - residual)
        for disc, residual in zip(evidence.discs, sampling, strict=True)
    )
    model = LinearModel(replace(evidence, discs=discs, unocculted=blocks), floor=0.0)
    percents = [100 * disc.share @ disc.residual / disc.level for disc in discs]
    return IdealObserver(
        left=left_by_hypotheses(model),
        left_after_refit_pct=float(np.sqrt(np.mean(np.square(percents)))),
        sampling_chi2=_chi2_in_discs(model, sampling),
        untestable=evidence.untestable,
    )


def left_by_hypotheses(model: LinearModel) -> tuple[Left, ...]:
    """chi2 and cost of every hypothesis for the residuals of a model: no effect, every effect, every pair of effects."""
    effects = model.evidence.effects
    every = itertools.chain(*(itertools.combinations(effects, count) for count in range(3)))
    return tuple(_left(model, some) for some in every)


def _left(model: LinearModel, effects: tuple[Effect, ...]) -> Left:
    evidence, base = model.evidence, len(model.evidence.base)
    columns = [column for effect in effects for column in evidence.columns_of(effect.name).values()]
    while True:
        step = model.fit(columns)
        sigma = np.sqrt(np.maximum(np.diag(step.covariance)[base:], 1e-300))
        below = [
            (value, column)
            for value, column in zip(step.values[base:] / sigma, columns, strict=True)
            if evidence.prior.positive[column] and value < 0
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
    """A copy of `solution` in which every occulter is at the position that the solution `clean` found."""
    sky = solution.sky.copy()
    sky.found = list(clean.sky.found)
    frames = solution.transit.frames
    sky.dark = [dark_pixels(frame, place) for frame, place in zip(frames, sky.found, strict=True)]
    return replace(solution, sky=sky)


def _sampling_residuals(evidence: Evidence, solution: Solution, clean: Solution) -> list[Vector]:
    """For every disc: the residuals of the image without the effect, in the same cells as with the effect (cells,),
    DN/s."""
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
    """Blocks of images with an effect, minus the differences between images that also exist without the effect.

    The prior of the brightness gets the width that it would have in images with noise. Otherwise the brightness would
    be known exactly from the noise-free images; from real images it is never known exactly.
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
    """chi2 of these residuals in the cells of the discs, after the coordinates of the PSF are refitted to the residuals."""
    base = list(model.evidence.base)
    seen = np.concatenate([disc.white @ one for disc, one in zip(model.discs, residuals, strict=True)])
    jacobian = np.concatenate([disc.jacobian[base].T for disc in model.discs])
    fitted = np.linalg.lstsq(jacobian, seen, rcond=None)[0]
    return float(np.sum((seen - jacobian @ fitted) ** 2))


def main(arguments: Sequence[str]) -> int:
    """Run the program. Returns the exit status."""
    if len(arguments) != 2:
        print(f"expected two arguments, a folder and a JSON file; got {len(arguments)}", file=sys.stderr)
        return 2
    folder, file = (Path(one) for one in arguments)
    try:
        found = ideal_observer(_read(folder / "with_effects"), _read(folder / "without_effects"), LIBRARY)
    except DataError as error:
        print(f"{error.code}: {error.message}", file=sys.stderr)
        return 1
    write_whole(file, json.dumps(found.to_json(), allow_nan=False))
    return 0


def _read(folder: Path) -> Transit:
    return read_transit(folder, LIMITS, diffraction=lambda name, _: known_diffraction(name, threads=1))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
