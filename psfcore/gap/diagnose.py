"""The diagnosis of a transit: noise, fit, expected gap, evidence, answer, location and closure of the gap.

The steps, in this order:

1. Measure the noise of the images.
2. Fit the PSF.
3. Simulate the transit from this fit, fit the simulation, and keep its residuals: the expected gap.
4. Compute how the discs and the unocculted field respond to every effect and every field.
5. Weigh all hypotheses in closed form, and read the answer off their probabilities (`verdict.answer`).
6. Fit the told causes: the most probable alternative of each cause, without the Sun. If they are effects of the
   library, make one full refit with them in the model; it gives the corrected PSF.
7. Locate the gap, and compute gap and closure on held-out images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from psfcore.arrays import Vector
from psfcore.errors import DataError
from psfcore.gap.effect import Effect
from psfcore.gap.evidence.columns import FieldShape, another, with_effect
from psfcore.gap.evidence.effect_fits import EffectFit, fit_effects, label_of, p_value_of_gap
from psfcore.gap.evidence.expected_gap import ExpectedGap, linear_model_of
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.evidence.measured_noise import MeasuredNoise, measured_noise
from psfcore.gap.evidence.responses import Evidence
from psfcore.gap.library.optics import FIELD_DEPENDENT
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.library.scene import MOST_POINTINGS
from psfcore.gap.verdict.answer import LEAST_IMAGES, Answer, answer_of
from psfcore.gap.verdict.axes import Axis, ranked_axes
from psfcore.gap.verdict.calibration import COVERAGE, Calibration, shipped_calibration
from psfcore.gap.verdict.closure import (
    HeldOut,
    Interval,
    closure,
    fall,
    gap,
    hold_out,
    pointings,
    time_blocks,
)
from psfcore.gap.verdict.correction import Corrected, add_to_model
from psfcore.gap.verdict.limits import Limits, limits
from psfcore.gap.view import View
from psfcore.memory import return_unused_memory
from psfcore.psf import Psf
from psfcore.scatter.inversion import Inverter, solution_of
from psfcore.scatter.reconstruction import Progress, Solution, labelled
from psfcore.scatter.shapes import SOFTENED_POWER_LAW, Shape, shape_named
from psfcore.transit.transit import Fold, Transit

MOST_EXAMPLES = 3  # of images that were not used, in a caution


@dataclass(frozen=True, eq=False)
class Shrinking:
    """How far causes close the gap. Both closures are None if there is no gap.

    Attributes
    ----------
    closure
        The closure if blocks of time are held out.
    closure_by_pointing
        The closure if one pointing at a time is held out.
    held_out_fall
        `closure.fall` for the blocks of time.
    """

    closure: Interval | None
    closure_by_pointing: Interval | None
    held_out_fall: float | None


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The diagnosis of one transit.

    Attributes
    ----------
    before_refit
        The gap with the PSF that was fitted together with the told causes, but without these causes.
    rms
        The gap with the PSF that was fitted without any cause.
    after
        The gap with the told causes in the model.
    fits
        The linear fits of all single effects, by name, the most probable first.
    told
        The linear fit of the told causes together; None if there are none.
    p_value
        The p-value of the gap.
    limits
        The limits of all effects.
    shrinking
        How far each single effect closes the gap, by name.
    shrinking_of_told
        The same for the told causes.
    corrected
        The full refit with the told causes, if they are effects of the library and the refit succeeded.
    shapes
        The shape of each alternative that is another form of its family; the key is the name of the family.
    residual, residual_after
        The residuals of held-out images without and with the told causes.
    cautions
        Sentences on everything that weakens the result.
    """

    answer: Answer
    calibration: Calibration
    fits: Mapping[str, EffectFit]
    told: EffectFit | None
    p_value: float
    limits: Limits
    solution: Solution
    model: LinearModel
    expected: ExpectedGap
    noise: MeasuredNoise | None
    where: tuple[Axis, ...]
    before_refit: Interval
    rms: Interval
    after: Interval
    noise_pct: float
    shrinking: Mapping[str, Shrinking]
    shrinking_of_told: Shrinking | None
    corrected: Corrected | None
    shapes: Mapping[str, FieldShape]
    residual: HeldOut | None
    residual_after: HeldOut | None
    cautions: tuple[str, ...]

    @property
    def evidence(self) -> Evidence:
        """The discs, blocks and Jacobians that the diagnosis uses."""
        return self.model.evidence

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The named effects."""
        return tuple(e for e in self.evidence.effects if e.name in self.answer.named)


STAGES = (
    "fit",
    "model of the gap",
    "hypotheses",
    "full refit",
)  # the last one only if `refit`, and a cause is told


def diagnose(
    transit: Transit,
    *,
    library: Sequence[Effect] = LIBRARY,
    shape: Shape = SOFTENED_POWER_LAW,
    start: Vector | None = None,
    seed: int = 1,
    refit: bool = True,
    coverage: float = COVERAGE,
    calibration: Calibration | None = None,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
    solution: Solution | Inverter | None = None,
) -> Diagnosis:
    """Fit a transit and diagnose the residuals of the fit.

    Raises the errors of `psfcore.scatter.inversion.solution_of` and `invert`, DataError "bad-library" if the library is
    empty, "bad-coverage", and "bad-effects" if an added effect fails.

    Parameters
    ----------
    start
        The coordinates of the shape from which the fit starts (None: the default start of the shape).
    refit
        Whether to make a full refit with the told causes in the model.
    seed
        Seed of the simulation and the bootstrap of the intervals.
    coverage
        The probability with which a group of alternatives contains the true cause.
    solution
        An existing solution of this transit, shape and start, or a function that makes it; None: `invert` makes it. If
        the noise measured in the images differs from the noise that the transit states, the solution must be made with
        the measured noise.
    """
    if not library:
        raise DataError("bad-library", "expected a library with at least one effect; got none: add an effect")
    calibration = calibration or shipped_calibration()
    level = calibration.level(coverage)  # refuses a coverage before the long fit
    noise = measured_noise(transit)
    if noise is not None and not noise.agrees:
        transit = replace(transit, noise=noise.noise)
    of_fit, of_model, of_hypotheses, of_refit = (
        labelled(progress, f"{stage} ({n} of {4 if refit else 3})") for n, stage in enumerate(STAGES, start=1)
    )
    solution = solution_of(transit, shape, solution, start=start, threads=threads, progress=of_fit)
    view = View(solution)
    model, expected = linear_model_of(view, library, seed=seed, progress=of_model)
    of_hypotheses("comparing", 0, 1)
    return_unused_memory()  # of the simulated transit and its fit
    answer = answer_of(model, level)
    rng = np.random.default_rng(seed)
    told, failures = _told(model, answer), list[str]()
    effects = {
        effect.name: effect for effect in model.evidence.effects if model.evidence.columns[effect.name]
    }
    order = [name for (_, name), _ in answer.labels.items() if name in effects]
    fits = {name: fit_effects(model, [effects[name]]) for name in dict.fromkeys([*order, *effects])}
    corrected = None
    if refit and told is not None:
        # Another form of a change over the field is refitted as the effect of the library that has terms.
        names = [FIELD_DEPENDENT if name == another("psf_place") else name for name in told.names]
        settled = answer.verdict in ("attributed", "tie") or FIELD_DEPENDENT in names
        if settled and set(names) <= set(effects):
            fit = told if names == list(told.names) else fit_effects(model, [effects[name] for name in names])
            corrected = _refit(view, model, [effects[name] for name in fit.names], fit, failures, of_refit)
    schemes = (time_blocks(model), pointings(model))
    held_out = [hold_out(model, (), scheme) for scheme in schemes]
    closing = partial(_shrinking, held_out, schemes, rng, bool(answer.causes))
    shrinking = {name: closing(fit)[0] for name, fit in fits.items()}
    of_told, after = (None, None) if told is None else closing(told, _of_fit(told, corrected))
    if told is not None and of_told is not None and told.label in shrinking:
        shrinking[told.label] = of_told
    before = held_out[0]
    rms = gap(before.residual_pct, before.noise_pct, rng) if before is not None else Interval(0.0, 0.0, 0.0)
    cautions = [*cautions_of(solution, noise, model.evidence), *failures]
    if told is not None and after is not None and rms.low > 0:  # the discs show the gap
        cautions += caution_of_closure(told.label, rms.value, float(np.sqrt(np.mean(after.noise_pct**2))))
    axes = [axis for cause in answer.causes[:1] for axis in cause.alternatives[0].family.axes]
    if told is not None:
        axes = [axis for e in told.model.evidence.effects if e.name in told.names for axis in e.axes]
    return Diagnosis(
        answer=answer,
        calibration=calibration,
        fits=fits,
        told=told,
        p_value=p_value_of_gap(model),
        limits=_limits(answer, corrected),
        solution=solution,
        model=model,
        expected=expected,
        noise=noise,
        where=ranked_axes(
            model if told is None else told.model, rng, axes, None if told is None else told.step
        ),
        before_refit=rms if told is None else _before_refit(told, rng),
        rms=rms,
        after=rms if after is None else gap(after.residual_pct, after.noise_pct, rng),
        noise_pct=float(
            np.sqrt(np.mean([(100 * d.mean_noise / d.level) ** 2 for d in model.evidence.discs]))
        ),
        shrinking=shrinking,
        shrinking_of_told=of_told,
        corrected=corrected,
        shapes=_shapes(answer),
        residual=before,
        residual_after=before if after is None else after,
        cautions=tuple(cautions),
    )


def _told(model: LinearModel, answer: Answer) -> EffectFit | None:
    """The linear fit of the most probable alternative of each cause, without the Sun; None if there is nothing to
    fit.
    """
    first = [cause.alternatives[0] for cause in answer.causes]
    evidence, names = model.evidence, []
    for one in first:
        variant = answer.variant((one.family.name, one.effect))
        if variant is None:
            continue
        if variant.form.field is None:
            names.append(str(one.effect))
            continue
        closed, field = answer.closed, variant.form.field
        effect = closed.columns.effect(field, variant.part.tolist(), variant.width.tolist())
        discs, blocks = closed.columns.discs(field), closed.columns.all_blocks(field)
        evidence = with_effect(evidence, effect, discs[..., variant.part], blocks[..., variant.part])
        names.append(effect.name)
    if not names:
        return None
    model = replace(model, evidence=evidence)
    effects = [effect for effect in evidence.effects if effect.name in names]
    fit = fit_effects(model, effects)
    columns = set(fit.step.columns)
    if all(columns.intersection(evidence.columns[effect.name]) for effect in effects):
        return fit
    return fit_effects(model, effects, any_sign=True)


def _shapes(answer: Answer) -> dict[str, FieldShape]:
    """The shape of each alternative that is another form of its family, by the name of the family."""
    found = {}
    for cause in answer.causes:
        for one in cause.alternatives:
            variant = answer.variant((one.family.name, one.effect))
            if variant is not None and variant.form.field is not None:
                others = [other.alternatives[0] for other in answer.causes if one not in other.alternatives]
                beside = [answer.variant((other.family.name, other.effect)) for other in others]
                values, covariance = answer.closed.fitted([variant, *filter(None, beside)])
                own = slice(0, variant.part.size)
                found[one.family.name] = answer.closed.columns.shape(
                    variant.form.field, variant.part.tolist(), values[own], covariance[own, own]
                )
    return found


def _refit(
    view: View,
    model: LinearModel,
    effects: Sequence[Effect],
    fit: EffectFit,
    failures: list[str],
    progress: Progress,
) -> Corrected | None:
    """The full refit with these effects; None, and a sentence in `failures`, if it fails."""
    label = label_of(fit.names)
    try:
        told = labelled(progress, label)
        return add_to_model(view.solution, effects, fit, model, view=view, progress=told)
    except DataError as error:  # the fit may fail if the subtracted effect is not in the images
        failures.append(f"The full refit with {label} in the model failed: {error}")
        return None
    finally:
        return_unused_memory()


def _of_fit(told: EffectFit, refit: Corrected | None) -> Corrected | None:
    """The full refit if it is one of the told causes as they are."""
    return refit if refit is not None and refit.label == told.label else None


def _shrinking(
    before: Sequence[HeldOut | None],
    schemes: Sequence[Sequence[Fold]],
    rng: np.random.Generator,
    exists: bool,
    fit: EffectFit,
    refit: Corrected | None = None,
) -> tuple[Shrinking, HeldOut | None]:
    """How far a fit closes the gap, and the held-out residuals with it.

    Parameters
    ----------
    before
        The held-out residuals without any cause, for each scheme.
    exists
        Whether there is a gap.
    refit
        The full refit of the fit; its results are used where it holds out the same images.
    """
    base = len(fit.model.evidence.base)
    after = [hold_out(fit.model, fit.step.columns[base:], scheme) for scheme in schemes]
    if refit is not None:
        own = range(base, refit.model.evidence.size)
        real = [hold_out(refit.model, own, scheme) for scheme in schemes]
        both = zip(real, after, strict=True)
        after = [one if one and other and one.images == other.images else other for one, other in both]
    closures = [
        closure(b, a, rng, fit.model.scale_error) if exists and b is not None and a is not None else None
        for b, a in zip(before, after, strict=True)
    ]
    first, last = before[0], after[0]
    falls = fall(first, last) if first is not None and last is not None else None
    return Shrinking(closures[0], closures[1], falls), last


def start_of(psf: Psf) -> tuple[Shape, Vector]:
    """The shape with which a PSF was fitted, and the fitted coordinates. `diagnose` can start from these coordinates.

    Raises DataError "psf-not-fitted" if the PSF was not fitted to a transit, "unknown-shape" if its shape is not known
    here.
    """
    if psf.fitted is None:
        raise DataError(
            "psf-not-fitted",
            "expected a PSF that was fitted to a transit, because the fit starts from its shape; "
            f"{psf.name} {psf.version} has no fitted shape: choose another PSF, or start without a PSF",
        )
    return shape_named(psf.fitted.shape), np.array(psf.fitted.coordinates, dtype=np.float64)


def _limits(answer: Answer, refit: Corrected | None) -> Limits:
    """The limits of all effects. excluded_95 of the effects of the full refit comes from this refit."""
    labels = [(cause.alternatives[0].family.name, cause.alternatives[0].effect) for cause in answer.causes]
    beside = [variant for variant in map(answer.variant, labels) if variant is not None]
    found = limits(answer.closed, beside)
    if refit is not None:
        for effect in refit.effects:
            found = found.after_refit(effect, refit.parameters(effect.name))
    return found


def _before_refit(best: EffectFit, rng: np.random.Generator) -> Interval:
    """The gap with the PSF that was fitted together with the best effects, but without these effects.

    A refit of the PSF without the effects absorbs a part of this gap.
    """
    base, discs = list(best.model.evidence.base), best.model.evidence.discs
    left = (disc.residual - disc.jacobian[base].T @ best.step.values[: len(base)] for disc in discs)
    residual = [-100 * float(d.share @ one) / d.level for d, one in zip(discs, left, strict=True)]
    return gap(np.array(residual), np.array([100 * d.mean_noise / d.level for d in discs]), rng)


# --- cautions ---------------------------------------------------------------------------------------------


def cautions_of(solution: Solution, noise: MeasuredNoise | None, evidence: Evidence) -> tuple[str, ...]:
    """Sentences on everything in these data that weakens the verdict."""
    out = []
    if noise is None:
        out.append(
            "The stated noise could not be checked. Either too few consecutive images have the same pointing, gain "
            "mode and exposure, or their differences do not look like noise."
        )
    elif not noise.agrees:
        out.append(
            f"The variance of the noise in the images is {noise.ratio:.2f} times the stated variance. The measured "
            f"noise was used: {noise.noise.photon_gain_dn:.2f} DN per photon, read noise "
            f"{noise.noise.read_noise_dn:.2f} DN."
        )
    left_out = [f"{name}: {why}" for name, why in solution.inversion.left_out.items()]
    infos = [evidence.image_info[disc.index] for disc in evidence.discs]
    unmatched = [info.file for info in infos if not info.described]
    some = f"{', '.join(unmatched[:3])}{', …' if len(unmatched) > 3 else ''}"
    aimed = len({info.pointing for info in evidence.image_info})
    unused = f"{len(left_out)} image{'s were' if len(left_out) > 1 else ' was'} not used"
    examples = ". Examples: " if len(left_out) > MOST_EXAMPLES else ": "
    rows = (
        (left_out, f"{unused}{examples}{'; '.join(left_out[:MOST_EXAMPLES])}"),
        (
            unmatched,
            f"In {len(unmatched)} images ({some}) the scene around the occulter differs from the scene in the "
            "neighbouring images, or no neighbouring image shows it. The fitted position of the occulter may be wrong "
            "in these images, and the wrong position may cause the residuals in their discs.",
        ),
        (
            len(infos) < LEAST_IMAGES,
            f"With only {len(infos)} images, no image can be held out. Closure and the gap on held-out images are "
            "therefore missing.",
        ),
        (
            aimed > MOST_POINTINGS,
            f"Light from outside the field was tested only in the first {MOST_POINTINGS} of the {aimed} pointings.",
        ),
        (
            aimed == 1,
            "All images have the same pointing: effects that differ between pointings cannot be detected, and no "
            "pointing can be held out.",
        ),
        (
            len({info.exposure_s for info in evidence.image_info}) == 1,
            "All images have the same exposure time: an error of every readout (in DN) and an error of the rate (in "
            "DN/s) look the same.",
        ),
    )
    return (*out, *(sentence for holds, sentence in rows if holds))


def caution_of_closure(label: str, gap_pct: float, error_pct: float) -> tuple[str, ...]:
    """A sentence if the closure by some effects says little, because their parameters are too uncertain without the
    held-out images.

    Parameters
    ----------
    label
        Names of the effects, as text.
    gap_pct
        The gap in held-out images, %.
    error_pct
        The rms error of the prediction of these images, %.
    """
    if error_pct <= gap_pct:
        return ()
    return (
        f"The closure by {label} says little: without the held-out images, its parameters are so uncertain that they "
        f"predict the discs of these images only to {error_pct:.1f} %, and the gap is {gap_pct:.1f} %. More images, "
        "or longer exposures, would help.",
    )
