"""A full refit: fit the PSF again to images from which the change by an effect was subtracted.

Each round computes the change of the images by the effect, from the current scene and PSF. It subtracts this change
from the images and fits the PSF again. Then it fits what remains of the effect together with the PSF. Two or three
rounds converge, and the result is then more than a first-order approximation. A round is rejected if it leaves clearly
more chi2 than an earlier round.

The rounds use the Jacobian of the linear model from before the refit, because a new Jacobian takes most of the time of
a round. The residuals are those of the current round, so the rounds converge to images without the effect all the same.
After the last round, the Jacobian is computed once at the refit, and the remaining part is fitted with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from psfcore.arrays import Flags, Vector
from psfcore.errors import DataError
from psfcore.gap.effect import Effect
from psfcore.gap.evidence.effect_fits import EffectFit, fit_effects, label_of, left_chi2
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.evidence.responses import Evidence, gather, residuals_at
from psfcore.gap.view import View
from psfcore.memory import return_unused_memory
from psfcore.scatter.inversion import invert, solution_at
from psfcore.scatter.reconstruction import Progress, Solution
from psfcore.transit.transit import Transit

ROUNDS = 6
SETTLED = 0.3  # the rounds end when the remaining step is less than this fraction of the errors, rms
LONGEST = 3.0  # longest step of the PSF in one round (`Shape.length`)
# A round may leave more chi2 than the best round by WORSE or, if larger, by WORSE_SHARE times the gain of the effect.
WORSE = 9.0
WORSE_SHARE = 0.05


@dataclass(frozen=True, eq=False)
class Corrected:
    """A full refit with effects in the model.

    Attributes
    ----------
    values
        Value, error and unit of each parameter of the effects; the value is summed over all rounds.
    model
        The linear model at the refit.
    rounds
        Number of rounds that were made.
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
        """Covariance of the coordinates of the PSF, with the parameters of the effects free (coordinates,
        coordinates).
        """
        evidence = self.model.evidence
        columns = tuple(c for effect in self.effects for c in evidence.columns[effect.name])
        base = len(evidence.base)
        return self.model.fit(columns).covariance[:base, :base]


def images_without(transit: Transit, view: View, effects: Sequence[Effect], theta: Vector) -> Transit:
    """The transit, with the changes by these effects subtracted from its images; `theta` holds the parameters of the
    effects, in order.
    """
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
    """Fit the PSF and effects together with Gauss-Newton steps. The first step is the linear fit `found` in the linear
    model `model`.

    A step that changes the PSF too much is shortened as a whole.

    Raises the errors of `invert` if the first round fails, DataError "effect-unseen" if the images do not constrain the
    effects, and "bad-effects" if an added effect fails.

    Parameters
    ----------
    view
        The view of the solution, if it exists already.
    """
    transit, shape = solution.transit, solution.inversion.shape
    # An effect that searches for a position keeps the position that it found first.
    view = view or View(solution)
    held = []
    for effect in effects:
        still = effect if effect.held is None else effect.held(view)
        labels = [p.name if len(effects) == 1 else f"{still.name}.{p.name}" for p in still.parameters]
        held.append(_with_part(still, [k for k, label in enumerate(labels) if label in found.values]))
    wanted = np.array([value for value, _, _ in found.values.values()])
    base = len(model.evidence.base)
    here, at, theta = view, solution.inversion.coordinates, np.zeros(wanted.size)
    move, least, settled = found.step.values[:base], np.inf, False
    # The accepted round: its solution (not its view, which keeps many planes), what was subtracted, and its number.
    taken: tuple[Solution, Vector, int] | None = None
    for rounds in range(1, 1 + ROUNDS):
        try:
            share = min(1.0, LONGEST / max(shape.length(move), 1e-9))
            at, theta = at + share * move, theta + share * (wanted - theta)
            images = images_without(transit, here, held, theta)
            fit = solution_at(images, solution.total, at, threads=solution.threads, progress=progress)
            here = View(fit)
            return_unused_memory()  # the planes of the view before
            left, wanted = _fit_remaining(_with_old_jacobian(model, here, held), held, theta)
        except DataError:
            if taken is None:
                raise
            break  # the step was too long: the fit failed, or the images no longer constrain the effect
        move = left.step.values[:base]
        # A parameter that must be positive is dropped if its fitted value is not positive.
        positive = np.array([parameter.positive for effect in held for parameter in effect.parameters])
        acts = ~(positive & (wanted <= 0))
        if not acts.all() and rounds < ROUNDS:
            held = _those_that_act(held, acts)
            theta, wanted = theta[acts], wanted[acts]
            taken, least = None, np.inf
            continue
        left_over = float(left_chi2(left.model, left.step).sum())
        # The effect is too strong for first-order steps.
        if left_over > least + max(WORSE, WORSE_SHARE * found.gain):
            break
        least, taken = min(least, left_over), (here.solution, theta, rounds)
        sigmas = np.maximum(np.sqrt(np.diag(left.step.covariance)), 1e-300)
        settled = float(np.sqrt(np.mean((np.append(move, wanted - theta) / sigmas) ** 2))) < SETTLED
        if settled:
            break
    assert taken is not None
    fit, theta, rounds = taken
    del here  # its planes, before those of another view are made
    return_unused_memory()
    if settled:  # the steps weigh cells; the PSF is fitted to pixels, as without effects
        fit = invert(fit.transit, shape, start=at, near=True, threads=solution.threads, progress=progress)
    evidence = _with_noise_of(model.evidence, gather(fit, held, progress=progress))
    left, values = _fit_remaining(replace(model, evidence=evidence), held, theta)
    fitted = zip(left.values.items(), values, strict=True)
    return Corrected(
        effects=tuple(held),
        solution=fit,
        model=left.model,
        values={name: (float(value), sigma, unit) for (name, (_, sigma, unit)), value in fitted},
        rounds=rounds,
    )


def _with_old_jacobian(model: LinearModel, view: View, held: Sequence[Effect]) -> LinearModel:
    """The linear model at another PSF: its residuals and its Jacobian of the PSF, with the Jacobian of the effects and
    the noise of `model`.
    """
    before, first = model.evidence, len(model.evidence.base)
    every = {effect.name: effect.parameters for effect in before.effects}
    numbers, columns = list[int](), dict[str, tuple[int, ...]]()
    for effect in held:
        names = {parameter.name for parameter in effect.parameters}
        pairs = zip(every[effect.name], before.columns[effect.name], strict=False)
        own = [column for parameter, column in pairs if parameter.name in names]
        columns[effect.name] = tuple(range(first + len(numbers), first + len(numbers) + len(own)))
        numbers += own
    changes = [change for effect in held for change in effect.changes(view)]
    evidence = residuals_at(view, before, numbers, changes)
    evidence = replace(evidence, effects=tuple(held), columns=columns)
    return replace(model, evidence=_with_noise_of(before, evidence))


def _fit_remaining(model: LinearModel, held: Sequence[Effect], out: Vector) -> tuple[EffectFit, Vector]:
    """The fit of effects to images from which a part of these effects was subtracted; and the parameters: both parts
    together.

    Parameters
    ----------
    model
        The linear model of these images.
    out
        The parameters of the part that was subtracted.
    """
    left = fit_effects(model, model.evidence.effects, any_sign=True)
    found = np.array([value for value, _, _ in left.values.values()])
    if found.size != out.size:
        raise DataError(
            "effect-unseen",
            f"expected the images to constrain all {out.size} parameters of {label_of([e.name for e in held])} after "
            f"this effect was subtracted; the images constrain {found.size} of them: they may not contain this effect",
        )
    base = len(model.evidence.base)
    found -= model.pull_of_prior(left.step, np.concatenate([np.zeros(base), out]))[base:]
    return left, out + found


def _those_that_act(effects: Sequence[Effect], acts: Flags) -> list[Effect]:
    """The effects, each with only those parameters for which `acts` is true.

    Raises DataError "effect-unseen" if an effect keeps no parameter.
    """
    out, left = [], iter(acts)
    for effect in effects:
        part = [k for k in range(len(effect.parameters)) if next(left)]
        if not part:
            raise DataError(
                "effect-unseen",
                f"expected {effect.name} to add light; its fit would remove light: the images do not contain this "
                "effect",
            )
        out.append(_with_part(effect, part))
    return out


def _with_noise_of(before: Evidence, after: Evidence) -> Evidence:
    """The evidence `after`, in which an effect is subtracted, with the noise of cells and blocks of the evidence
    `before`.

    The subtraction removes the light of the effect from the images, but not the photon noise of this light. The
    reference level of percentages is also taken from `before`.
    """
    were = {disc.index: disc for disc in before.discs}
    discs = []
    for disc in after.discs:
        was = were.get(disc.index, disc)
        source = was if was.covariance.shape == disc.covariance.shape else disc
        discs.append(replace(disc, covariance=source.covariance, level_before=was.level))
    return replace(
        after, discs=tuple(discs), unocculted=replace(after.unocculted, variance=before.unocculted.variance)
    )


def _with_part(effect: Effect, part: Sequence[int]) -> Effect:
    """The effect with only these of its parameters."""
    if len(part) == len(effect.parameters):
        return effect
    return replace(
        effect,
        parameters=tuple(effect.parameters[k] for k in part),
        changes=lambda view: [effect.changes(view)[k] for k in part],
    )
