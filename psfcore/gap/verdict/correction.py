"""A full refit: fit the PSF again to images from which the change by an effect was subtracted.

Each round computes the change of the images by the effect, from the current scene and PSF. It subtracts this change from
the images and fits the PSF again. Then it fits what remains of the effect together with the PSF. Two or three rounds
converge, and the result is then more than a first-order approximation. A round is rejected if it leaves clearly more chi2 than an
earlier round.

The rounds use the Jacobian of the linear model from before the refit, because a new Jacobian takes most of the time of a round. The
residuals are those of the current round, so the rounds converge to images without the effect all the same. After the
last round, the Jacobian is computed once at the refit, and the remaining part is fitted with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.gap.effect import Effect
from psfcore.gap.evidence.effect_fits import EffectFit, fit_effects, label_of, left_chi2
from psfcore.gap.evidence.evidence import Evidence, gather, residuals_at
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.view import View, return_unused_memory
from psfcore.scatter.inversion import invert, solution_at
from psfcore.scatter.reconstruction import Progress, Solution
from psfcore.transit.transit import Transit

Vector = NDArray[np.float64]

ROUNDS = 6
SETTLED = 0.3  # the rounds end when the remaining step is less than this fraction of the errors, rms
LONGEST = 3.0  # longest step of the PSF in one round (`Shape.length`)
# A round may leave more chi2 than the best round by WORSE or, if larger, by WORSE_SHARE times the gain of the effect.
WORSE = 9.0
WORSE_SHARE = 0.05


@dataclass(frozen=True, eq=False)
class Corrected:
    """A full refit with effects in the model.

    values: value, error and unit of each parameter of the effects; the value is summed over all rounds. model: the linear
    model at the refit. rounds: number of rounds made.
    """

    effects: tuple[Effect, ...]
    solution: Solution
    model: LinearModel
    values: dict[str, tuple[float, float, str]]
    rounds: int

    @property
    def label(self) -> str:
        """The names of the effects, as the report writes them."""
        return label_of([effect.name for effect in self.effects])

    def parameters(self, effect: str) -> dict[str, tuple[float, float]]:
        """Value and error of each parameter of an effect."""
        alone = len(self.effects) == 1
        return {
            label if alone else label.removeprefix(f"{effect}."): (value, sigma)
            for label, (value, sigma, _) in self.values.items()
            if alone or label.startswith(f"{effect}.")
        }

    @property
    def covariance(self) -> Vector:
        """Covariance of the coordinates of the PSF, with the parameters of the effects free (coordinates, coordinates)."""
        evidence = self.model.evidence
        columns = tuple(c for effect in self.effects for c in evidence.columns[effect.name])
        base = len(evidence.base)
        return self.model.fit(columns).covariance[:base, :base]


def images_without(transit: Transit, view: View, effects: Sequence[Effect], theta: Vector) -> Transit:
    """The transit, with the changes by these effects subtracted from its images. theta: the parameters, in order."""
    changes = [change for effect in effects for change in effect.changes(view)]
    frames = []
    for n, frame in enumerate(transit.frames):
        error = np.zeros(transit.shape)
        for value, change in zip(theta, changes, strict=True):
            error += value * change.change(n, view.expected)
        frames.append(replace(frame, pixels=(frame.pixels - error).astype(np.float32)))
    return replace(transit, frames=tuple(frames))


def add_to_model(
    solution: Solution,
    effects: Sequence[Effect],
    found: EffectFit,
    model: LinearModel,
    *,
    view: View | None = None,
    progress: Progress = lambda stage, step, steps: None,
) -> Corrected:
    """Fit the PSF and effects together with Gauss-Newton steps. The first step is the linear fit `found` in the linear model `model`.

    A step that changes the PSF too much is shortened as a whole.

    view: the view of the solution, if it exists already. Raises the errors of `invert` if the first round fails, DataError "effect-unseen" if the images do not constrain the
    effects, and "bad-effects" if an added effect fails.
    """
    transit, shape = solution.transit, solution.inversion.shape
    # An effect that searches for a position keeps the position that it found first.
    view = view or View(solution)
    held = [_acting(hold(effect, view), found, len(effects)) for effect in effects]
    wanted = np.array([value for value, _, _ in found.values.values()])
    base = len(model.evidence.base)
    here, at, theta = view, solution.inversion.coordinates, np.zeros(wanted.size)
    move = found.step.values[:base]
    least, settled = np.inf, False
    taken: _Round | None = None
    for rounds in range(1, 1 + ROUNDS):
        try:
            share = min(1.0, LONGEST / max(shape.length(move), 1e-9))
            at, theta = at + share * move, theta + share * (wanted - theta)
            images = images_without(transit, here, held, theta)
            fit = solution_at(images, solution.total, at, threads=solution.threads, progress=progress)
            here = View(fit)
            return_unused_memory()  # the planes of the view before
            seen = _fit_remaining(_with_old_jacobian(model, here, held), held, theta)
        except DataError:
            if taken is None:
                raise
            break  # the step was too long: the fit failed, or the images no longer constrain the effect
        wanted, move = seen.theta, seen.left.step.values[:base]
        # A parameter that must be positive is dropped if its fitted value is not positive.
        positive = np.array([parameter.positive for effect in held for parameter in effect.parameters])
        acts = ~(positive & (wanted <= 0))
        if not acts.all() and rounds < ROUNDS:
            held = _those_that_act(held, acts)
            theta, wanted = theta[acts], wanted[acts]
            taken, least = None, np.inf
            continue
        left_over = float(left_chi2(seen.model, seen.left.step).sum())
        if left_over > least + max(
            WORSE, WORSE_SHARE * found.gain
        ):  # the effect is too strong for first-order steps
            break
        least = min(least, left_over)
        taken = _Round(here.solution, theta, rounds)
        steps = np.append(move, wanted - theta)
        settled = float(np.sqrt(np.mean((steps / np.maximum(seen.sigmas, 1e-300)) ** 2))) < SETTLED
        if settled:
            break
    assert taken is not None
    del here  # its planes, before those of another view are made
    return_unused_memory()
    if settled:  # the steps weigh cells; the PSF is fitted to pixels, as without effects
        images, threads = taken.solution.transit, solution.threads
        fit = invert(images, shape, start=at, near=True, threads=threads, progress=progress)
        taken = replace(taken, solution=fit)
    return _corrected(taken, held, model, progress)


@dataclass(frozen=True, eq=False)
class _Round:
    """An accepted round. theta: the parameters that were subtracted from the images. rounds: its number, from 1.

    A view keeps many planes for each image, so the round keeps only the solution.
    """

    solution: Solution
    theta: Vector
    rounds: int


def _corrected(
    taken: _Round,
    held: Sequence[Effect],
    model: LinearModel,
    progress: Progress,
) -> Corrected:
    """The refit after its last round, with the Jacobian computed there."""
    evidence = gather(taken.solution, held, progress=progress)
    own = replace(model, evidence=_with_noise_of(model.evidence, evidence))
    seen = _fit_remaining(own, held, taken.theta)
    fitted = zip(seen.left.values.items(), seen.theta, strict=True)
    return Corrected(
        effects=tuple(held),
        solution=taken.solution,
        model=own,
        values={name: (float(value), sigma, unit) for (name, (_, sigma, unit)), value in fitted},
        rounds=taken.rounds,
    )


def _with_old_jacobian(model: LinearModel, view: View, held: Sequence[Effect]) -> LinearModel:
    """The linear model at another PSF: its residuals and its Jacobian of the PSF, with the Jacobian of the effects and the noise of `model`."""
    before = model.evidence
    base, kept = len(before.base), list[int]()
    columns: dict[str, tuple[int, ...]] = {}
    for effect in held:
        at = before.columns_of(effect.name)
        own = [at[parameter.name] for parameter in effect.parameters if parameter.name in at]
        columns[effect.name] = tuple(range(base + len(kept), base + len(kept) + len(own)))
        kept += own
    changes = [change for effect in held for change in effect.changes(view)]
    evidence = residuals_at(view, before, kept, changes)
    evidence = replace(evidence, effects=tuple(held), columns=columns)
    return replace(model, evidence=_with_noise_of(before, evidence))


@dataclass(frozen=True, eq=False)
class _Remaining:
    """A fit to images from which a part of the effects was subtracted.

    model: the linear model at this fit. left: the linear fit of the remaining part of the effects. theta: the
    parameters: the subtracted part plus the remaining part.
    """

    model: LinearModel
    left: EffectFit
    theta: Vector

    @property
    def sigmas(self) -> Vector:
        """Errors of the coordinates of the PSF, then of theta."""
        return np.sqrt(np.diag(self.left.step.covariance))


def _fit_remaining(model: LinearModel, held: Sequence[Effect], out: Vector) -> _Remaining:
    """Fit the effects to images from which these effects were already subtracted.

    model: the linear model of these images. out: the current parameters.
    """
    left = fit_effects(model, model.evidence.effects, any_sign=True)
    found = np.array([value for value, _, _ in left.values.values()])
    if found.size != out.size:
        raise DataError(
            "effect-unseen",
            f"expected the images to constrain all {out.size} parameters of {label_of([e.name for e in held])} after this effect "
            f"was subtracted; the images constrain {found.size} of them: they may not contain this effect",
        )
    base = len(model.evidence.base)
    out_already = np.concatenate([np.zeros(base), out])
    found -= model.pull_of_prior(left.step, out_already)[base:]
    return _Remaining(model, left, out + found)


def _those_that_act(effects: Sequence[Effect], acts: NDArray[np.bool_]) -> list[Effect]:
    """The effects, each with only those parameters for which `acts` is true.

    Raises DataError "effect-unseen" if an effect keeps no parameter.
    """
    out, first = [], 0
    for effect in effects:
        count = len(effect.parameters)
        part = [k for k in range(count) if acts[first + k]]
        first += count
        if not part:
            raise DataError(
                "effect-unseen",
                f"expected {effect.name} to add light; its fit would remove light: the images do not contain this effect",
            )
        out.append(_with_part(effect, part))
    return out


def hold(effect: Effect, view: View) -> Effect:
    """The effect without its search: the result of the search, for example a position, is fixed for these images."""
    return effect if effect.held is None else effect.held(view)


def _with_noise_of(before: Evidence, after: Evidence) -> Evidence:
    """The evidence `after`, in which an effect is subtracted, with the noise of cells and blocks of the evidence `before`.

    The subtraction removes the light of the effect from the images, but not the photon noise of this light. The
    reference level of percentages is also taken from `before`.
    """
    were = {disc.index: disc for disc in before.discs}
    discs = []
    for disc in after.discs:
        was = were.get(disc.index)
        if was is not None:
            same = was.covariance.shape == disc.covariance.shape
            disc = replace(
                disc, covariance=was.covariance if same else disc.covariance, level_before=was.level
            )
        discs.append(disc)
    return replace(
        after, discs=tuple(discs), unocculted=replace(after.unocculted, variance=before.unocculted.variance)
    )


def _acting(effect: Effect, found: EffectFit, effects: int) -> Effect:
    """The effect with only the parameters that the fit `found` contains. effects: the number of effects in the fit."""
    labels = [p.name if effects == 1 else f"{effect.name}.{p.name}" for p in effect.parameters]
    return _with_part(effect, [k for k, label in enumerate(labels) if label in found.values])


def _with_part(effect: Effect, part: Sequence[int]) -> Effect:
    if len(part) == len(effect.parameters):
        return effect
    return replace(
        effect,
        parameters=tuple(effect.parameters[k] for k in part),
        changes=lambda view: [effect.changes(view)[k] for k in part],
    )
