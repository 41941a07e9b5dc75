"""The diagnosis of a transit: noise, fit, expected gap, evidence, verdict, full refits, location and closure of the gap.

The steps, in this order:

1. Measure the noise of the images.
2. Fit the PSF.
3. Simulate the transit from this fit, fit the simulation, and keep its residuals: the expected gap.
4. Compute how the discs and the unocculted field respond to every effect.
5. Compute the posterior of all hypotheses about the cause, with full refits where the linear model is not exact enough.
6. Read the verdict off the posterior. The effects that the verdict names are called "the named effects" here
   (`Judgement.answer`, "answer" in the report).
7. Make a full refit with the named effects in the model. Each refit is made only once. If the verdict is a tie, the best of the
   tied hypotheses is refitted.
8. Locate the gap, and compute gap and closure on held-out images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from psfcore.errors import DataError
from psfcore.gap.effect import Effect
from psfcore.gap.evidence.effect_fits import EffectFit, fit_effects, p_value_of_gap
from psfcore.gap.evidence.evidence import Evidence
from psfcore.gap.evidence.expected_gap import ExpectedGap, linear_model_of
from psfcore.gap.evidence.fields import UNKNOWN, Field, FieldColumns, fields_of
from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.gap.evidence.measured_noise import MeasuredNoise, measured_noise
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.library.scene import MOST_POINTINGS
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
from psfcore.gap.verdict.correction import Corrected
from psfcore.gap.verdict.limits import Limits, limits
from psfcore.gap.verdict.posterior import NONE, Form, posterior
from psfcore.gap.verdict.refits import Refits, linear_start, settled_posterior
from psfcore.gap.verdict.unknown import UnknownField, bounds, unknown_fields
from psfcore.gap.verdict.verdict import LEAST_IMAGES, Judgement, earned, verdict_of
from psfcore.gap.verdict.where import Axis, where
from psfcore.gap.view import View
from psfcore.psf import Psf
from psfcore.scatter.inversion import Inverter, solution_of
from psfcore.scatter.reconstruction import Progress, Solution
from psfcore.scatter.shapes import SOFTENED_POWER_LAW, Shape, Vector, shape_named
from psfcore.transit.transit import Transit


@dataclass(frozen=True, eq=False)
class Shrinking:
    """How far an effect closes the gap.

    closure: the closure if blocks of time are held out. closure_by_pointing: the closure if one pointing at a time is held
    out. Both are None if there is no gap. held_out_fall: `closure.fall` for the blocks of time.
    """

    closure: Interval | None
    closure_by_pointing: Interval | None
    held_out_fall: float | None


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The diagnosis of one transit.

    Three values of the gap: before_refit, with the PSF that was fitted together with the named effects, but without these
    effects; rms, with the PSF refitted without any effect; after, with the named effects in the model. fits: the linear
    fits, by form: of all single effects, the most probable first; then of the hypotheses that are best or decide the verdict, and of
    the fields of an unknown cause. p_value:
    the p-value of the gap. limits: the limits of all effects. shrinking: how far the effects close the gap, by
    form. corrected: the full refits with the named effects that were made; the refit with the best effects comes first.
    with_field: for the verdict `unknown`, the full refit with the most probable field, if it was made. unknown: the
    fields of an unknown cause, if it is in the answer set. bounds: the bound of each field (`unknown.bounds`). residual,
    residual_after: the residuals of held-out images without and with the best effects. cautions: sentences on
    everything that weakens the result.
    """

    judgement: Judgement
    calibration: Calibration
    fits: Mapping[Form, EffectFit]
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
    shrinking: Mapping[Form, Shrinking]
    corrected: tuple[Corrected, ...]
    with_field: Corrected | None
    unknown: tuple[UnknownField, ...]
    bounds: Mapping[Field, tuple[float, str]]
    residual: HeldOut | None
    residual_after: HeldOut | None
    cautions: tuple[str, ...]

    @property
    def evidence(self) -> Evidence:
        """The discs, blocks and Jacobians that the diagnosis uses."""
        return self.model.evidence

    @property
    def correctable(self) -> Corrected | None:
        """The full refit whose PSF is the corrected PSF: with the named effects, or with a field that does not change the PSF."""
        if self.corrected:
            return self.corrected[0]
        field = self.with_field
        return None if field is None or field.effects[-1].stage == "optics" else field

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The named effects."""
        return tuple(e for e in self.evidence.effects if e.name in self.judgement.answer)


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

    start: the coordinates of the shape from which the fit starts (None: the default start of the shape). refit:
    whether to make full refits with the named effects in the model. seed: seeds the simulation and the bootstrap of
    the intervals. solution: an existing solution of this transit, shape and start, or a function that makes it; None:
    `invert` makes it. If the noise measured in the images differs from the noise that the transit states, the solution
    must be made with the measured noise. Raises the errors of `psfcore.scatter.inversion.solution_of` and `invert`,
    DataError "bad-library" if the library is empty, "bad-coverage", and "bad-effects" if an added effect fails.
    """
    if not library:
        raise DataError("bad-library", "expected a library with at least one effect; got none: add an effect")
    calibration = calibration or shipped_calibration()
    calibration.threshold(coverage)  # refuses a coverage before the long fit
    noise = measured_noise(transit)
    if noise is not None and not noise.agrees:
        transit = replace(transit, noise=noise.noise)
    solution = solution_of(transit, shape, solution, start=start, threads=threads, progress=progress)
    view = View(solution)
    model, expected = linear_model_of(view, library, seed=seed, progress=progress)
    refits = Refits(view, model, progress)
    settled = posterior(model, refits.columns)
    if refit:
        settled = settled_posterior(settled, refits.weighed)
    rng = np.random.default_rng(seed)
    judged = verdict_of(settled, calibration, images=len(model.evidence.discs), coverage=coverage)
    told = (
        unknown_fields(model, refits.columns, settled)
        if any(UNKNOWN in names for names in judged.members)
        else ()
    )
    fits = linear_fits(refits, model, judged, told)
    best = next((form for form in fits if judged.best and form == judged.form(judged.best)), None)
    named = judged.verdict in ("attributed", "tie")
    corrected = refits.of([judged.form(names) for names in judged.named]) if refit and named else ()
    with_field = None
    if refit and judged.verdict == "unknown" and told and told[0].form.refittable:
        with_field = next(iter(refits.of([told[0].form])), None)
    held_out = [hold_out(model, (), scheme) for scheme in (time_blocks(model), pointings(model))]
    shrinking, after = _shrinking(model, judged, fits, refits, held_out, rng)
    judged = earned(judged, None if best is None else shrinking[best].closure)
    if judged.verdict == "inconclusive":  # a name that closes too little has no corrected PSF
        corrected = ()
    before, gone = held_out[0], None if best is None else after[best]
    explained = fits[best] if best is not None and judged.answer else None
    named = judged.verdict in ("attributed", "tie") and gone is not None
    rms = gap(before.residual_pct, before.noise_pct, rng) if before is not None else Interval(0.0, 0.0, 0.0)
    cautions = [*cautions_of(solution, noise, model.evidence), *refits.failures]
    if named and best is not None and gone is not None and rms.low > 0:  # the discs show the gap
        error_pct = float(np.sqrt(np.mean(gone.noise_pct**2)))
        cautions += caution_of_closure(fits[best].label, rms.value, error_pct)
    return Diagnosis(
        judgement=judged,
        calibration=calibration,
        fits=fits,
        p_value=p_value_of_gap(model),
        limits=_limits(model, refits.columns, calibration, coverage, corrected),
        solution=solution,
        model=model,
        expected=expected,
        noise=noise,
        where=where(
            model if explained is None else explained.model,
            rng,
            _favoured(judged, explained, told),
            None if explained is None else explained.step,
        ),
        before_refit=_before_refit(explained, rng) if named and explained is not None else rms,
        rms=rms,
        after=gap(gone.residual_pct, gone.noise_pct, rng) if named and gone is not None else rms,
        noise_pct=float(np.sqrt(np.mean(before.noise_pct**2)))
        if before is not None
        else _noise_pct(model.evidence),
        shrinking=shrinking,
        corrected=corrected,
        with_field=with_field,
        unknown=told,
        bounds=bounds(model, refits.columns, fields_of(model.evidence)),
        residual=before,
        residual_after=gone if named else None,
        cautions=tuple(cautions),
    )


def start_of(psf: Psf) -> tuple[Shape, Vector]:
    """The shape with which a PSF was fitted, and the fitted coordinates. `diagnose` can start from these coordinates.

    Raises DataError "psf-not-fitted" if the PSF was not fitted to a transit, "unknown-shape" if its shape is not known here.
    """
    if psf.fitted is None:
        raise DataError(
            "psf-not-fitted",
            "expected a PSF that was fitted to a transit, because the fit starts from its shape; "
            f"{psf.name} {psf.version} has no fitted shape: choose another PSF, or start without a PSF",
        )
    return shape_named(psf.fitted.shape), np.array(psf.fitted.coordinates, dtype=np.float64)


def _favoured(judged: Judgement, explained: EffectFit | None, told: Sequence[UnknownField]) -> list[str]:
    """The axes along which the effects of the best hypothesis vary, or the most probable field of an unknown cause.

    Empty if the verdict is `none`.
    """
    if judged.verdict == "unknown" and told:
        return list(told[0].field.axes)
    if judged.verdict == "none" or explained is None:
        return []
    return [axis for e in explained.model.evidence.effects if e.name in explained.names for axis in e.axes]


def _limits(
    model: LinearModel,
    fields: FieldColumns,
    calibration: Calibration,
    coverage: float,
    refits: Sequence[Corrected],
) -> Limits:
    """The limits of all effects.

    If full refits contain an effect, its excluded_95 comes from the best of these refits.
    """
    found = limits(
        model,
        threshold=calibration.threshold(coverage),
        temperature=calibration.temperature,
        fields=fields,
    )
    for fit in reversed(refits):
        for effect in fit.effects:
            if effect.name in found.effects:
                found = found.after_refit(effect, fit.parameters(effect.name))
    return found


def linear_fits(
    refits: Refits, model: LinearModel, judged: Judgement, told: Sequence[UnknownField]
) -> dict[Form, EffectFit]:
    """The linear fits of all single effects, the most probable first; then of the best hypothesis and the named ones, in their
    most probable form, and of the fields of an unknown cause."""
    effects = {effect.name: effect for effect in model.evidence.effects}
    ordered = sorted(effects, key=lambda name: -judged.effects.get(name, 0.0))
    fits = {Form((name,)): fit_effects(model, [effects[name]]) for name in ordered}
    hypotheses = [names for names in (judged.best or NONE, *judged.named) if names != NONE]
    forms = [*(judged.form(names) for names in hypotheses), *(one.form for one in told)]
    for form in forms:
        if form in fits or not form.refittable:
            continue
        with_field = refits.model_with(form)
        names = form.names(tuple(effects))
        chosen = [effect for effect in with_field.evidence.effects if effect.name in names]
        fits[form] = linear_start(with_field, chosen) if form.field else fit_effects(with_field, chosen)
    return fits


def _shrinking(
    model: LinearModel,
    judged: Judgement,
    fits: Mapping[Form, EffectFit],
    refits: Refits,
    before: Sequence[HeldOut | None],
    rng: np.random.Generator,
) -> tuple[dict[Form, Shrinking], dict[Form, HeldOut | None]]:
    """Two results for every fit: its closure, and the held-out residuals with its effects.

    before: the held-out residuals without any effect, for the blocks of time and for the pointings. If effects have a full refit,
    their closure is computed with the model of that refit.
    """
    schemes = (time_blocks(model), pointings(model))
    out: dict[Form, Shrinking] = {}
    left: dict[Form, HeldOut | None] = {}
    base = len(model.evidence.base)
    for form, fit in fits.items():
        after = [hold_out(fit.model, fit.step.columns[base:], scheme) for scheme in schemes]
        if form in refits.made:
            real = refits.made[form].model
            after = [
                _better_known(hold_out(real, real.evidence.of_effects, scheme), linear)
                for scheme, linear in zip(schemes, after, strict=True)
            ]
        left[form] = after[0]
        closures = [
            closure(b, a, rng, model.scale_error)
            if judged.verdict != "none" and b is not None and a is not None
            else None
            for b, a in zip(before, after, strict=True)
        ]
        falls = fall(before[0], after[0]) if before[0] is not None and after[0] is not None else None
        out[form] = Shrinking(closures[0], closures[1], falls)
    return out, left


def _better_known(real: HeldOut | None, linear: HeldOut | None) -> HeldOut | None:
    """The result of the full refit (`real`) if it holds out the same images as the linear model; otherwise `linear`."""
    same = real is not None and linear is not None and real.images == linear.images
    return real if same else linear


def _before_refit(best: EffectFit, rng: np.random.Generator) -> Interval:
    """The gap with the PSF that was fitted together with the best effects, but without these effects.

    A refit of the PSF without the effects absorbs a part of this gap.
    """
    base = list(best.model.evidence.base)
    rows = []
    for disc in best.model.evidence.discs:
        mean = float(disc.share @ (disc.residual - disc.jacobian[base].T @ best.step.values[: len(base)]))
        rows.append((-100 * mean / disc.level, 100 * disc.mean_noise / disc.level))
    residual, noise = np.array(rows).T
    return gap(residual, noise, rng)


def _noise_pct(evidence: Evidence) -> float:
    return float(np.sqrt(np.mean([(100 * d.mean_noise / d.level) ** 2 for d in evidence.discs])))


# --- cautions ---------------------------------------------------------------------------------------------


def cautions_of(solution: Solution, noise: MeasuredNoise | None, evidence: Evidence) -> tuple[str, ...]:
    """Sentences on everything in these data that weakens the verdict."""
    out = []
    if noise is None:
        out.append(
            "The stated noise could not be checked. Either too few consecutive images have the same pointing, gain mode and "
            "exposure, or their differences do not look like noise."
        )
    elif not noise.agrees:
        out.append(
            f"The variance of the noise in the images is {noise.ratio:.2f} times the stated variance. The measured noise was used: "
            f"{noise.noise.photon_gain_dn:.2f} DN per photon, read noise {noise.noise.read_noise_dn:.2f} DN."
        )
    left_out = [f"{name}: {why}" for name, why in solution.inversion.left_out.items()]
    if left_out:
        out.append(f"{len(left_out)} images were not used. Examples: {'; '.join(left_out[:3])}")
    infos = [evidence.image_info[disc.index] for disc in evidence.discs]
    unmatched = [info.file for info in infos if not info.described]
    if unmatched:
        out.append(
            f"In {len(unmatched)} images ({', '.join(unmatched[:3])}{', …' if len(unmatched) > 3 else ''}) the scene around the "
            "occulter differs from the scene in the neighbouring images, or no neighbouring image shows it. The fitted position of the "
            "occulter may be wrong in these images, and the wrong position may cause the residuals in their discs."
        )
    if len(infos) < LEAST_IMAGES:
        out.append(
            f"With only {len(infos)} images, no image can be held out. Closure and the gap on held-out images are therefore missing."
        )
    aimed = len({info.pointing for info in evidence.image_info})
    if aimed > MOST_POINTINGS:
        out.append(
            f"Light from outside the field was tested only in the first {MOST_POINTINGS} of the {aimed} pointings."
        )
    if aimed == 1:
        out.append(
            "All images have the same pointing: effects that differ between pointings cannot be detected, and no pointing can be held out."
        )
    if len({info.exposure_s for info in evidence.image_info}) == 1:
        out.append(
            "All images have the same exposure time: an error of every readout (in DN) and an error of the rate (in DN/s) look the same."
        )
    return tuple(out)


def caution_of_closure(label: str, gap_pct: float, error_pct: float) -> tuple[str, ...]:
    """A sentence if the closure by some effects says little, because their parameters are too uncertain without the held-out images.

    label: the effects. gap_pct: the gap in held-out images, %. error_pct: the error of their prediction, %, rms.
    """
    if error_pct <= gap_pct:
        return ()
    return (
        f"The closure by {label} says little: without the held-out images, its parameters are so uncertain that they predict the "
        f"discs of these images only to {error_pct:.1f} %, and the gap is {gap_pct:.1f} %. More images, or longer exposures, would help.",
    )
