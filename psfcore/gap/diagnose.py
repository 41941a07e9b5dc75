"""The diagnosis of a transit: noise, fit, expected gap, evidence, verdict, full refits, location and closure of the gap.

The steps, in this order:

1. Measure the noise of the images.
2. Fit the PSF.
3. Simulate the transit from this fit, fit the simulation, and keep its residuals: the expected gap.
4. Compute how the discs and the unocculted field respond to every effect.
5. Judge which effect causes the gap. The effects that the verdict names are called "the named effects" here
   (`Judgement.answer`, "answer" in the report).
6. Make full refits with the named effects in the model. For a tie, refit with each tied effect, at most MOST_REFITS
   fits. The verdict may also request refits; each refit is made only once.
7. Locate the gap, and compute gap and closure on held-out images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from psfcore.errors import DataError
from psfcore.gap.effect import Effect
from psfcore.gap.evidence.evidence import Evidence, gather
from psfcore.gap.evidence.expected_gap import ExpectedGap, expected_gap
from psfcore.gap.evidence.linear_model import FLOOR, LinearModel
from psfcore.gap.evidence.measured_noise import MeasuredNoise, measured_noise
from psfcore.gap.library.registry import LIBRARY
from psfcore.gap.library.scene import MOST_POINTINGS
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
from psfcore.gap.verdict.correction import Corrected, add_to_model, beyond
from psfcore.gap.verdict.judge import LEAST_IMAGES, Judgement, Tried, judge
from psfcore.gap.verdict.where import Axis, where
from psfcore.gap.view import View
from psfcore.psf import Psf
from psfcore.scatter.inversion import Inverter, Progress, Solution, solution_of
from psfcore.scatter.shapes import SOFTENED_POWER_LAW, Shape, Vector, shape_named
from psfcore.transit.blocks import Fold
from psfcore.transit.transit import Transit

MOST_REFITS = 3
SMALLEST_SCALE, LARGEST_SCALE = 1.0, 3.0


@dataclass(frozen=True, eq=False)
class Shrinking:
    """How far an effect closes the gap. closure: with blocks of time held out. closure_by_pointing: with one pointing at a time
    held out. Both are None if there is no gap. held_out_fall: `closure.fall` of the blocks of time.
    """

    closure: Interval | None
    closure_by_pointing: Interval | None
    held_out_fall: float | None


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """The diagnosis of one transit.

    Three values of the gap: before_refit, with the PSF that was fitted together with the named effects, but without these
    effects; rms, with the PSF refitted without any effect; after, with the named effects in the model. shrinking: by the
    label of the effects. corrected: the full refits; the refit with the best effects comes first. residual, residual_after: held-out
    images without and with the best effects. cautions: sentences on everything that weakens the result.
    """

    judgement: Judgement
    solution: Solution
    model: LinearModel
    expected: ExpectedGap
    noise: MeasuredNoise | None
    where: tuple[Axis, ...]
    before_refit: Interval
    rms: Interval
    after: Interval
    noise_pct: float
    shrinking: dict[str, Shrinking]
    corrected: tuple[Corrected, ...]
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
        return tuple(e for e in self.evidence.effects if e.name in self.judgement.answer)


def diagnose(
    transit: Transit,
    *,
    library: Sequence[Effect] = LIBRARY,
    shape: Shape = SOFTENED_POWER_LAW,
    start: Vector | None = None,
    seed: int = 1,
    refit: bool = True,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
    solution: Solution | Inverter | None = None,
) -> Diagnosis:
    """Fit a transit and diagnose the residuals of the fit.

    start: the coordinates of the shape from which the fit starts (None: the default start of the shape). refit: whether to
    make full refits with the named effects in the model. seed: seeds the simulation and the bootstrap of the intervals.
    solution: a solution of this transit, shape and start that was made before, or a function that makes it; None: `invert`.
    If the images show other noise than the transit states, it must be the solution with the noise that they show. Raises
    the errors of `psfcore.scatter.inversion.solution_of` and `invert`, DataError "bad-library" if the library contains only
    probes, and "bad-effects" if an added effect fails.
    """
    if not any(effect.named for effect in library):
        raise DataError(
            "bad-library",
            "expected a library with at least one effect that is not a probe; got only probes: add an effect",
        )
    noise = measured_noise(transit)
    if noise is not None and not noise.agrees:
        transit = replace(transit, noise=noise.noise)
    made = solution_of(transit, shape, solution, start=start, threads=threads, progress=progress)
    return diagnose_solution(made, noise=noise, library=library, seed=seed, refit=refit, progress=progress)


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


def diagnose_solution(
    solution: Solution,
    *,
    noise: MeasuredNoise | None,
    library: Sequence[Effect] = LIBRARY,
    seed: int = 1,
    refit: bool = True,
    progress: Progress = lambda stage, step, steps: None,
) -> Diagnosis:
    """Diagnose an existing fit. noise: the measured noise, if any. The other arguments and the errors are those of `diagnose`."""
    view = View(solution)
    model, expected = linear_model_of(view, library, seed=seed, progress=progress)
    evidence = model.evidence
    refits = _Refits(view, model, progress)
    found = judge(model, refits.model, refits.beyond) if refit else judge(model)
    fits = refits.of(found) if refit else ()
    rng = np.random.default_rng(seed)
    shrinking, before, after = _shrinking(model, found, refits.made, rng)
    favoured = [axis for effect in evidence.effects if effect.name in _likely(found) for axis in effect.axes]
    nothing = Interval(0.0, 0.0, 0.0)
    rms = gap(before, rng) if before is not None else nothing
    gone = found.verdict in ("attributed", "tie") and after is not None
    return Diagnosis(
        judgement=found,
        solution=solution,
        model=model,
        expected=expected,
        noise=noise,
        where=where(model, rng, favoured, found.best.step if found.answer and found.best else None),
        before_refit=_before_refit(model, found, rng) or rms,
        rms=rms,
        after=gap(after, rng) if gone and after is not None else rms,
        noise_pct=float(np.sqrt(np.mean(before.noise_pct**2)))
        if before is not None
        else _noise_pct(evidence),
        shrinking=shrinking,
        corrected=fits,
        residual=before,
        residual_after=after if gone else None,
        cautions=(*_cautions(solution, noise, evidence), *refits.failures, *_rejected(found)),
    )


def linear_model_of(
    view: View,
    library: Sequence[Effect],
    *,
    seed: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> tuple[LinearModel, ExpectedGap]:
    """The linear model of a fit with a library of effects, and the expected gap. seed: of the simulation.

    Raises the errors of `expected_gap` and `gather`.
    """
    expected = expected_gap(view, seed=seed, floor=FLOOR, progress=progress)
    evidence = gather(view.solution, library, view=view, progress=progress)
    model = LinearModel(
        evidence,
        FLOOR,
        disc_scale=float(np.clip(expected.disc_scale, SMALLEST_SCALE, LARGEST_SCALE)),
        unocculted_scale=float(np.clip(expected.unocculted_scale, SMALLEST_SCALE, LARGEST_SCALE)),
        scale_error=expected.scale_error,
    )
    return model, expected


def _likely(found: Judgement) -> tuple[str, ...]:
    """The effects that explain most of the gap; for a tie, the best of the tied effects."""
    return () if found.verdict == "none" or found.best is None else found.best.names


def _shrinking(
    model: LinearModel, found: Judgement, fits: Sequence[Corrected], rng: np.random.Generator
) -> tuple[dict[str, Shrinking], HeldOut | None, HeldOut | None]:
    """Three results: the closure of every fit in `found.tried`; held-out residuals without any effect; those with the best effect.

    If an effect has a full refit, its closure is computed with the model of that refit.
    """
    schemes = (time_blocks(model), pointings(model))
    before = [hold_out(model, (), scheme) for scheme in schemes]
    real = {fit.label: fit.model for fit in fits}  # including refits that the verdict rejected
    out: dict[str, Shrinking] = {}
    best: HeldOut | None = None
    base = len(model.evidence.base)
    for tried in found.tried:
        after = [hold_out(model, tried.step.columns[base:], scheme) for scheme in schemes]
        if tried.label in real:
            after = [
                _better_known(_held_out_by(real[tried.label], scheme), linear)
                for scheme, linear in zip(schemes, after, strict=True)
            ]
        if found.best is not None and tried.label == found.best.label:
            best = after[0]
        closures = [
            closure(b, a, rng, model.scale_error)
            if found.verdict != "none" and b is not None and a is not None
            else None
            for b, a in zip(before, after, strict=True)
        ]
        falls = fall(before[0], after[0]) if before[0] is not None and after[0] is not None else None
        out[tried.label] = Shrinking(closures[0], closures[1], falls)
    return out, before[0], best


def _held_out_by(model: LinearModel, scheme: Sequence[Fold]) -> HeldOut | None:
    """Hold out images with the model of a full refit; all effects of that refit are fitted."""
    return hold_out(model, model.evidence.of_effects, scheme)


def _better_known(real: HeldOut | None, linear: HeldOut | None) -> HeldOut | None:
    """The result of the full refit if it covers the same images as the linear model; otherwise that of the linear model."""
    same = real is not None and linear is not None and real.images == linear.images
    return real if same else linear


class _Refits:
    """Full refits with effects in the model. Each refit is made only once."""

    def __init__(self, view: View, model: LinearModel, progress: Progress) -> None:
        self._view, self._model, self._progress = view, model, progress
        self._made: dict[str, Corrected | None] = {}
        self.failures: list[str] = []

    def model(self, tried: Tried) -> LinearModel | None:
        """The linear model at the full refit with these effects; None if the refit failed."""
        made = self._fit(tried)
        return None if made is None else made.model

    def beyond(self, tried: Tried) -> LinearModel | None:
        """The linear model at the same refit, with the rest of the library added; None if the refit failed."""
        made = self._fit(tried)
        if made is None:
            return None

        def say(stage: str, step: int, steps: int) -> None:
            self._progress(f"further effects beside {tried.label}: {stage}", step, steps)

        return beyond(made, self._model.evidence.effects, self._model, progress=say)

    @property
    def made(self) -> tuple[Corrected, ...]:
        """All refits that succeeded."""
        return tuple(fit for fit in self._made.values() if fit is not None)

    def of(self, found: Judgement) -> tuple[Corrected, ...]:
        """The refits with the named effects, the best first; at most MOST_REFITS.

        For a tie: one refit with each tied effect, together with the certain effects if there are any.
        """
        if found.verdict not in ("attributed", "tie") or found.best is None:
            return ()
        chosen: list[Tried] = [found.best]
        if found.verdict == "tie":
            count = len(found.best.names)
            chosen += [
                t
                for t in found.tried
                if len(t.names) == count and set(t.names) <= set(found.answer) and t is not found.best
            ]
        fits = (self._fit(tried) for tried in chosen[:MOST_REFITS])
        return tuple(fit for fit in fits if fit is not None)

    def _fit(self, tried: Tried) -> Corrected | None:
        if tried.label in self._made:
            return self._made[tried.label]

        def say(stage: str, step: int, steps: int) -> None:
            self._progress(f"full refit with {tried.label}: {stage}", step, steps)

        effects = {effect.name: effect for effect in self._model.evidence.effects}
        chosen = [effects[name] for name in tried.names]
        made: Corrected | None = None
        try:
            made = add_to_model(
                self._view.solution, chosen, tried, self._model, view=self._view, progress=say
            )
        except DataError as error:  # the fit may fail if the subtracted effect is not in the images
            self.failures.append(f"The full refit with {tried.label} in the model failed: {error}")
        self._made[tried.label] = made
        return made


def _before_refit(model: LinearModel, found: Judgement, rng: np.random.Generator) -> Interval | None:
    """The gap with the PSF that was fitted together with the best effects, but without these effects.

    A refit of the PSF without the effects absorbs a part of this gap. None if the verdict names no effect.
    """
    if found.best is None or found.verdict not in ("attributed", "tie"):
        return None
    step = found.best.step
    base = list(model.evidence.base)
    rows = []
    for disc in model.evidence.discs:
        mean = float(disc.share @ (disc.residual - disc.jacobian[base].T @ step.values[: len(base)]))
        rows.append((-100 * mean / disc.level, 100 * disc.mean_noise / disc.level))
    residual, noise = np.array(rows).T
    nothing = np.zeros_like(residual)
    return gap(HeldOut((), nothing, nothing, nothing, nothing, residual, noise), rng)


def _noise_pct(evidence: Evidence) -> float:
    return float(np.sqrt(np.mean([(100 * d.mean_noise / d.level) ** 2 for d in evidence.discs])))


def _rejected(found: Judgement) -> tuple[str, ...]:
    return tuple(
        f"In the linear model {label.replace('_', ' ')} explains much of the gap, but the full refit with this effect explains less than "
        "half of that. The effect was therefore excluded, in spite of its score."
        for label in found.amiss
    )


def _cautions(solution: Solution, noise: MeasuredNoise | None, evidence: Evidence) -> tuple[str, ...]:
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
    left_out = solution.inversion.left_out
    if left_out:
        out.append(
            f"{len(left_out)} images were not used. Examples: "
            + "; ".join(f"{k}: {v}" for k, v in list(left_out.items())[:3])
        )
    unmatched = [
        evidence.image_info[disc.index].file
        for disc in evidence.discs
        if not evidence.image_info[disc.index].described
    ]
    if unmatched:
        out.append(
            f"In {len(unmatched)} images ({', '.join(unmatched[:3])}{', …' if len(unmatched) > 3 else ''}) the scene around the "
            "occulter differs from the scene in the neighbouring images, or no neighbouring image shows it. The fitted position of the "
            "occulter may be wrong in these images, and the wrong position may cause the residuals in their discs."
        )
    images = len(evidence.discs)
    if images < LEAST_IMAGES:
        out.append(
            f"With only {images} images, no image can be held out. Closure and the gap on held-out images are therefore missing."
        )
    aimed = len({taken.pointing for taken in evidence.image_info})
    if aimed > MOST_POINTINGS:
        out.append(
            f"Light from outside the field was tested only in the first {MOST_POINTINGS} of the {aimed} pointings."
        )
    if aimed == 1:
        out.append(
            "All images have the same pointing: effects that differ between pointings cannot be detected, and no pointing can be held out."
        )
    exposures = {taken.exposure_s for taken in evidence.image_info}
    if len(exposures) == 1:
        out.append(
            "All images have the same exposure time: an error of every readout (in DN) and an error of the rate (in DN/s) look the same."
        )
    return tuple(out)
