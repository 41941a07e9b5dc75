"""The diagnosis of a transit: noise, fit, expected gap, evidence, verdict, full refits, location and closure of the gap.

In this order: the noise that the images show; the fit of the PSF; the residuals of the same fit on its own simulation;
the response of discs and unocculted field to every effect; the verdict; full refits with the answer's effects in the
model and, for a tie, with each of the tied effects, at most MOST_REFITS (the verdict may also request refits; each is
made once); closure and gap on held-out images.
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
    """How far an effect closes the gap, by both ways of holding out images; closure is None if there is no gap."""

    closure: Interval | None
    closure_by_pointing: Interval | None
    held_out_fall: float | None


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What a transit shows of the gap between it and the model fitted to it.

    before_refit, rms, after: the gap before the PSF is refitted (with the PSF fitted together with the answer, but without
    the answer's effects), after the refit, and with the answer in the model. cautions: what weakens the result. corrected: the
    full refits, the answer's first.
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
        """The data that it uses."""
        return self.model.evidence

    @property
    def effects(self) -> tuple[Effect, ...]:
        """The answer's effects."""
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

    start: the shape's coordinates from which the fit starts (None: the shape's own start). refit: whether to make full
    refits with the answer's effects in the model. seed: of the simulation and of the intervals. solution: of this transit,
    shape and start, made before, or a function that makes it; None: `invert`. If the images show another noise than the
    transit states, it must be the solution with the noise that they show. Raises DataError as
    `psfcore.scatter.inversion.solution_of` and `invert` do, "bad-library" if no effect of the library can be an answer,
    and "bad-effects" if an added effect fails.
    """
    if not any(effect.named for effect in library):
        raise DataError(
            "bad-library",
            "expected a library with at least one effect that is not a probe; got none: add an effect",
        )
    noise = measured_noise(transit)
    if noise is not None and not noise.agrees:
        transit = replace(transit, noise=noise.noise)
    made = solution_of(transit, shape, solution, start=start, threads=threads, progress=progress)
    return diagnose_solution(made, noise=noise, library=library, seed=seed, refit=refit, progress=progress)


def start_of(psf: Psf) -> tuple[Shape, Vector]:
    """The shape with which a PSF was fitted, and its coordinates, from which `diagnose` may start.

    Raises DataError "psf-not-fitted" if the PSF was not fitted to a transit, "unknown-shape" if its shape is not known here.
    """
    if psf.fitted is None:
        raise DataError(
            "psf-not-fitted",
            "expected a PSF that was fitted to a transit, because the fit starts from its shape; "
            f"{psf.name} {psf.version} has no fitted shape: choose another PSF, or none",
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
    """The diagnosis of an existing fit; arguments and errors as in `diagnose`."""
    view = View(solution)
    expected = expected_gap(view, seed=seed, floor=FLOOR, progress=progress)
    evidence = gather(solution, library, view=view, progress=progress)
    model = LinearModel(
        evidence,
        FLOOR,
        disc_scale=float(np.clip(expected.disc_scale, SMALLEST_SCALE, LARGEST_SCALE)),
        unocculted_scale=float(np.clip(expected.unocculted_scale, SMALLEST_SCALE, LARGEST_SCALE)),
        scale_error=expected.scale_error,
    )
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


def _likely(found: Judgement) -> tuple[str, ...]:
    """The effects that explain most of a gap; for a tie the best of the tied effects."""
    return () if found.verdict == "none" or found.best is None else found.best.names


def _shrinking(
    model: LinearModel, found: Judgement, fits: Sequence[Corrected], rng: np.random.Generator
) -> tuple[dict[str, Shrinking], HeldOut | None, HeldOut | None]:
    """Closure of every effect tried; held-out residuals without an effect, and with the best effect.

    An effect with a full refit is judged by the model of that refit.
    """
    schemes = (time_blocks(model), pointings(model))
    before = [hold_out(model, (), scheme) for scheme in schemes]
    real = {fit.label: fit.model for fit in fits}  # also those that were rejected later
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
    """Hold out images with a model that contains effects; all of them are fitted."""
    return hold_out(model, model.evidence.of_effects, scheme)


def _better_known(real: HeldOut | None, linear: HeldOut | None) -> HeldOut | None:
    """The result of the full refit, unless it does not cover the same images as the linear model."""
    same = real is not None and linear is not None and real.images == linear.images
    return real if same else linear


class _Refits:
    """Full refits with effects in the model, each made once."""

    def __init__(self, view: View, model: LinearModel, progress: Progress) -> None:
        self._view, self._model, self._progress = view, model, progress
        self._made: dict[str, Corrected | None] = {}
        self.failures: list[str] = []

    def model(self, tried: Tried) -> LinearModel | None:
        """The model of the full refit with an effect, or with several; None if this fit failed."""
        made = self._fit(tried)
        return None if made is None else made.model

    def beyond(self, tried: Tried) -> LinearModel | None:
        """The model of the same refit, with the rest of the library added."""
        made = self._fit(tried)
        if made is None:
            return None

        def say(stage: str, step: int, steps: int) -> None:
            self._progress(f"beyond {tried.label}: {stage}", step, steps)

        return beyond(made, self._model.evidence.effects, self._model, progress=say)

    @property
    def made(self) -> tuple[Corrected, ...]:
        """All refits that succeeded."""
        return tuple(fit for fit in self._made.values() if fit is not None)

    def of(self, found: Judgement) -> tuple[Corrected, ...]:
        """The refits of the answer, the best first; for a tie, of each tied effect, with the certain ones if there are any."""
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
            self._progress(f"adding {tried.label}: {stage}", step, steps)

        effects = {effect.name: effect for effect in self._model.evidence.effects}
        chosen = [effects[name] for name in tried.names]
        made: Corrected | None = None
        try:
            made = add_to_model(
                self._view.solution, chosen, tried, self._model, view=self._view, progress=say
            )
        except (
            DataError
        ) as error:  # a fit may fail after an effect is subtracted that the images do not contain
            self.failures.append(f"The full refit with {tried.label} in the model failed: {error}")
        self._made[tried.label] = made
        return made


def _before_refit(model: LinearModel, found: Judgement, rng: np.random.Generator) -> Interval | None:
    """The gap with the PSF of the effect's fit but without the effect: what a refit of the PSF would then partly absorb."""
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
        f"To first order {label.replace('_', ' ')} explains much of the gap, but the full refit explains less than half of that: "
        "it was excluded in spite of its score."
        for label in found.amiss
    )


def _cautions(solution: Solution, noise: MeasuredNoise | None, evidence: Evidence) -> tuple[str, ...]:
    """What a reader should know before trusting a verdict."""
    out = []
    if noise is None:
        out.append(
            "The stated noise could not be checked: too few consecutive images have the same pointing, gain mode and "
            "exposure, or their differences do not look like noise."
        )
    elif not noise.agrees:
        out.append(
            f"The images are {noise.ratio:.2f} times as noisy (in variance) as stated. The measured noise was used: "
            f"{noise.noise.photon_gain_dn:.2f} DN per photon, read noise {noise.noise.read_noise_dn:.2f} DN."
        )
    left_out = solution.inversion.left_out
    if left_out:
        out.append(
            f"{len(left_out)} images were not used: "
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
            "occulter differs from that in the neighbouring images, or no neighbour shows it. The occulter's position may be wrong there, and this "
            "may cause the residuals in these discs."
        )
    images = len(evidence.discs)
    if images < LEAST_IMAGES:
        out.append(
            f"With only {images} images none can be held out, so closure and the held-out gap are not given."
        )
    aimed = len({taken.pointing for taken in evidence.image_info})
    if aimed > MOST_POINTINGS:
        out.append(
            f"Light from outside the field was tested only in the first {MOST_POINTINGS} of {aimed} pointings."
        )
    if aimed == 1:
        out.append(
            "There is only one pointing: effects that differ between pointings cannot be detected, and no pointing can be held out."
        )
    exposures = {taken.exposure_s for taken in evidence.image_info}
    if len(exposures) == 1:
        out.append(
            "There is only one exposure time: an error per readout and an error per second look the same."
        )
    return tuple(out)
