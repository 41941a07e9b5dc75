"""The model with an effect added: the images as they would be without it, and the PSF fitted anew.

Images minus the effect's change, worked out from the scene and the PSF as they are; a new fit; the change worked out
again from that, and what is left of the effect fitted beside the PSF. Two or three rounds settle it, as a Gauss-Newton
step does, and what was a first-order change is one no more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from psfcore.gap.effect import Effect, View
from psfcore.gap.evidence import Evidence, gather
from psfcore.gap.judge import Tried, fitted, label_of, left_chi2
from psfcore.gap.linear_model import LinearModel
from psfcore.scatter.inversion import Progress, Solution, invert
from psfcore.transit.transit import Transit

Vector = NDArray[np.float64]

ROUNDS = 3
SETTLED = 0.3  # of a parameter's error
WORSE, WORSE_SHARE = (
    9.0,
    0.05,
)  # of chi2, and of the effect's gain: what a round may leave more than the best did


@dataclass(frozen=True, eq=False)
class Corrected:
    """A fit with an effect added. values: its parameters, all rounds together, with errors. model: about that fit."""

    effects: tuple[Effect, ...]
    solution: Solution
    evidence: Evidence
    model: LinearModel
    values: dict[str, tuple[float, float, str]]
    rounds: int

    @property
    def label(self) -> str:
        """The effects' names as a report has them."""
        return label_of([effect.name for effect in self.effects])

    @property
    def covariance(self) -> Vector:
        """Of the PSF's coordinates, the effects' parameters free beside them: (coordinates, coordinates)."""
        columns = tuple(c for effect in self.effects for c in self.evidence.columns[effect.name])
        base = len(self.evidence.base)
        return self.model.fit(columns).covariance[:base, :base]


def corrected(transit: Transit, view: View, effects: Sequence[Effect], theta: Vector) -> Transit:
    """The images of a transit less what the effects with these parameters did to them."""
    changes = [change for effect in effects for change in effect.changes(view)]
    frames = []
    for n, frame in enumerate(transit.frames):
        error = np.zeros(transit.shape)
        for value, change in zip(theta, changes, strict=True):
            if change.disc:  # what the discs do not answer to is part of each image's own scene
                error += value * change.change(n, view.expected)
        frames.append(replace(frame, pixels=(frame.pixels - error).astype(np.float32)))
    return replace(transit, frames=tuple(frames))


def add_to_model(
    solution: Solution,
    effects: Sequence[Effect],
    found: Tried,
    model: LinearModel,
    *,
    progress: Progress = lambda stage, step, steps: None,
) -> Corrected:
    """Fit PSF and effects together, starting from the linear fit `found`. Raises what `invert` raises."""
    transit = solution.transit
    # A form with a place of its own keeps the place that was found: it is looked for once.
    view = View(solution)
    held = [_acting(hold(effect, view), found, len(effects)) for effect in effects]
    values = {name: value for name, (value, _, _) in found.values.items()}
    theta = np.array(list(values.values()))
    current = solution
    in_images = np.array([change.disc for effect in held for change in effect.changes(view)])
    positive = np.array([parameter.positive for effect in held for parameter in effect.parameters])
    units = [unit for _, _, unit in found.values.values()]
    least = np.inf
    best: Corrected | None = None
    for rounds in range(1, 1 + (ROUNDS if in_images.any() else 1)):
        if in_images.any():
            current = invert(
                corrected(transit, View(current), held, theta),
                solution.inversion.shape,
                start=current.inversion.coordinates,
                threads=solution.threads,
                progress=progress,
            )
        evidence = _with_noise_of(model.evidence, gather(current, held, progress=progress))
        again = replace(model, evidence=evidence)
        left = fitted(again, evidence.effects, any_sign=True)
        found_now = np.array([value for value, _, _ in left.values.values()])
        base = len(evidence.base)
        out_already = np.concatenate([np.zeros(base), np.where(in_images, theta, 0.0)])
        found_now -= again.pull_of_prior(left.step, out_already)[base:]
        sigma = np.array([s for _, s, _ in left.values.values()])
        # What was taken out of the images shows what is left of it, the rest shows all of it.
        steps = np.where(in_images, found_now, found_now - theta)
        theta = np.where(positive, np.maximum(theta + steps, 0.0), theta + steps)
        left_over = float(left_chi2(again, left.step).sum())
        if left_over > least + max(WORSE, WORSE_SHARE * found.gain):  # too strong for first-order steps
            break
        least = min(least, left_over)
        best = Corrected(
            effects=tuple(held),
            solution=current,
            evidence=evidence,
            model=again,
            values={
                name: (float(value), float(s), unit)
                for name, value, s, unit in zip(values, theta, sigma, units, strict=True)
            },
            rounds=rounds,
        )
        if float(np.abs(steps / np.maximum(sigma, 1e-300)).max()) < SETTLED:
            break
    assert best is not None
    return best


def beyond(
    added: Corrected,
    library: Sequence[Effect],
    model: LinearModel,
    *,
    progress: Progress = lambda stage, step, steps: None,
) -> LinearModel:
    """The model about a fit with effects in it, which are always fitted, and how it answers to others of a library."""
    names = {effect.name for effect in added.effects}
    others = [effect for effect in library if effect.name not in names]
    evidence = gather(added.solution, (*added.effects, *others), progress=progress)
    evidence = _with_noise_of(model.evidence, evidence)
    base = len(evidence.base) + sum(len(evidence.columns.get(name, ())) for name in names)
    effects = tuple(effect for effect in evidence.effects if effect.name not in names)
    return replace(model, evidence=replace(evidence, base=tuple(range(base)), effects=effects))


def hold(effect: Effect, view: View) -> Effect:
    """The effect with whatever it searches for, as a place, held as these images give it."""
    return effect if effect.held is None else effect.held(view)


def _with_noise_of(before: Evidence, after: Evidence) -> Evidence:
    """The evidence after an effect was taken out, with the noise of before: the light that is gone left its noise. So
    are the means that percents are of."""
    were = {disc.index: disc for disc in before.discs}
    discs = []
    for disc in after.discs:
        was = were.get(disc.index)
        if was is not None:
            same = was.covariance.shape == disc.covariance.shape
            disc = replace(disc, covariance=was.covariance if same else disc.covariance, untouched=was.level)
        discs.append(disc)
    return replace(after, discs=tuple(discs), lit=replace(after.lit, variance=before.lit.variance))


def _acting(effect: Effect, found: Tried, effects: int) -> Effect:
    """The effect with those of its parameters alone that take part in a fit."""
    labels = [p.name if effects == 1 else f"{effect.name}.{p.name}" for p in effect.parameters]
    part = [k for k, label in enumerate(labels) if label in found.values]
    if len(part) == len(labels):
        return effect
    return replace(
        effect,
        parameters=tuple(effect.parameters[k] for k in part),
        changes=lambda view: [effect.changes(view)[k] for k in part],
    )
