"""How far an effect closes the gap, on images that were held out of its fit.

    closure = 1 - (chi2_after - nu) / (chi2_before - nu)                                 Eq. (1)
    nu = cells + trace(J Cov J^T)      noise, and the error of the fit from which the images were held out  Eq. (2)
    gap = sqrt(mean(residual^2 - noise^2))     of the discs' means, in percent                Eq. (3)
    deviance = r^T S^-1 r + ln det S,  S = 1 + J Cov J^T       r in units of the noise          Eq. (4)

Eq. (4), for all images of a fold at once, is -2 ln of their likelihood as predicted by the fit, including the
uncertainty of its own parameters: a fit with large stated errors is not punished for a large deviation.

There are two ways of holding out: blocks of time with a guard, and one pointing at a time. chi2 is that of the discs'
cells. If the unocculted blocks show more of the gap, and the effect explains it (like a gain that differs between
images), their chi2 is added. The intervals are for the closure by the true cause, not only for our estimate of it. They
combine four errors: a bootstrap over the images; the scale of the noise in nu, with the uncertainty from one simulation;
the part of chi2_after that comes from errors of the effect's parameters; and an error FORM_ERROR of its form.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.gap.evidence.linear_model import LinearModel
from psfcore.transit.blocks import Fold, folds

Vector = NDArray[np.float64]

RESAMPLES = 1000
FORM_ERROR = 0.1  # of an effect's amplitude; its square is a fraction of chi2
INTERVAL = (5.0, 95.0)
HIDDEN_SIGMA = 1.645  # 95 % of a normal distribution lies below


@dataclass(frozen=True)
class Interval:
    """A value with its 90 % interval."""

    value: float
    low: float
    high: float

    def to_json(self) -> dict[str, Any]:
        """The value and interval in the form of the gap report."""
        return {"value": self.value, "ci90": [self.low, self.high]}


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Every held-out image with a disc: chi2 of its cells and of its unocculted blocks, their expected values, its residual.

    residual_pct, noise_pct: of the disc's mean, simulated minus observed over observed; the noise includes the error of the
    fit. Images that no fold holds out are missing. deviance: Eq. (4) of each fold, by its held-out images.
    """

    images: tuple[int, ...]
    chi2: Vector
    expected: Vector
    unocculted_chi2: Vector
    unocculted_expected: Vector
    residual_pct: Vector
    noise_pct: Vector
    deviance: Mapping[tuple[int, ...], float] = field(default_factory=dict)

    def of(self, images: Sequence[int]) -> HeldOut:
        """Some of the images, without the deviance of the folds."""
        at = {image: k for k, image in enumerate(self.images)}
        here = [at[image] for image in images]
        return HeldOut(
            tuple(images),
            self.chi2[here],
            self.expected[here],
            self.unocculted_chi2[here],
            self.unocculted_expected[here],
            self.residual_pct[here],
            self.noise_pct[here],
        )


def time_blocks(model: LinearModel) -> tuple[Fold, ...]:
    """Sequential blocks of all images with a guard; empty if there are fewer than six images."""
    return folds(len(model.evidence.image_info))


def pointings(model: LinearModel) -> tuple[Fold, ...]:
    """One fold per pointing; empty if there are fewer than two pointings."""
    fovs = [taken.pointing for taken in model.evidence.image_info]
    if len(set(fovs)) < 2:
        return ()
    every = range(len(fovs))
    return tuple(
        Fold(tuple(n for n in every if fovs[n] == one), tuple(n for n in every if fovs[n] != one))
        for one in sorted(set(fovs))
    )


def hold_out(model: LinearModel, columns: Sequence[int], scheme: Sequence[Fold]) -> HeldOut | None:
    """Predict every image from a fit of the PSF and these columns to the other images; None if no fold can be fitted."""
    evidence = model.evidence
    by_index = {disc.index: k for k, disc in enumerate(evidence.discs)}
    rows: list[tuple[float, ...]] = []
    images: list[int] = []
    deviance: dict[tuple[int, ...], float] = {}
    base = len(evidence.base)
    free = base + len(
        set(columns) - model.of_fields
    )  # the parameters of a random field are constrained by their prior
    unocculted_noise = math.sqrt(model.unocculted_scale)
    for fold in scheme:
        fitted = [n for n in fold.fitted if n in by_index]
        held = [n for n in fold.held_out if n in by_index]
        if len(fitted) <= free or not held:
            continue
        step = model.fit(columns, model.equations(fitted))
        here = list(step.columns)
        everything: list[tuple[Vector, Vector]] = []
        for n in held:
            disc, white = evidence.discs[by_index[n]], model.discs[by_index[n]]
            left = white.residual - white.jacobian[here].T @ step.values
            error = float(
                np.einsum("ki,kl,li->", white.jacobian[here], step.covariance, white.jacobian[here])
            )
            of_blocks, jacobian = evidence.unocculted.held_out(columns, [n], fitted)
            of_blocks = (of_blocks - step.values[base:] @ jacobian) / unocculted_noise
            errors = step.covariance[base:, base:]
            of_unocculted = max(of_blocks.size - 1, 0) + float(
                np.einsum("kb,kl,lb->", jacobian, errors, jacobian)
            )
            of_all = np.zeros((len(here), of_blocks.size))  # the unocculted blocks do not depend on the PSF
            of_all[base:] = jacobian / unocculted_noise
            everything += [(left, white.jacobian[here]), (of_blocks, of_all)]
            answer = disc.jacobian[here] @ disc.share
            mean = float(disc.share @ disc.residual - answer @ step.values)
            noise = math.sqrt(disc.mean_noise**2 + float(answer @ step.covariance @ answer))
            images.append(n)
            rows.append(
                (
                    float(left @ left),
                    left.size + error,
                    float(of_blocks @ of_blocks),
                    of_unocculted,
                    -100 * mean / disc.level,
                    100 * noise / disc.level,
                )
            )
        residuals, jacobians = (np.concatenate(parts, axis=-1) for parts in zip(*everything, strict=True))
        deviance[tuple(held)] = _deviance(residuals, jacobians, step.covariance)
    if not rows:
        return None
    chi2, expected, unocculted_chi2, unocculted_expected, residual, noise_pct = np.array(rows).T
    return HeldOut(
        tuple(images), chi2, expected, unocculted_chi2, unocculted_expected, residual, noise_pct, deviance
    )


def _deviance(left: Vector, jacobian: Vector, covariance: Vector) -> float:
    """Eq. (4): left (n,) in units of the noise, jacobian (parameters, n), covariance of the parameters."""
    values, vectors = np.linalg.eigh(covariance)
    along = (np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T) @ jacobian
    inner = np.eye(values.size) + along @ along.T
    projected = along @ left
    return float(left @ left - projected @ np.linalg.solve(inner, projected) + np.linalg.slogdet(inner)[1])


def _in_both(before: HeldOut, after: HeldOut) -> tuple[HeldOut, HeldOut] | None:
    """The images that both hold out; None if there are none. With more parameters, folds with few images are dropped."""
    common = sorted(set(before.images) & set(after.images))
    if not common:
        return None
    return before.of(common), after.of(common)


def closure(
    before: HeldOut, after: HeldOut, rng: np.random.Generator, scale_error: float = 0.0
) -> Interval | None:
    """Eq. (1) with its interval; None if there is no gap to close. scale_error: relative error of the noise's variance."""
    both = _in_both(before, after)
    if both is None:
        return None
    before, after = both
    chi2_before, chi2_after, nu, nu_after = before.chi2, after.chi2, before.expected, after.expected
    shown = float((before.unocculted_chi2 - before.unocculted_expected).sum())
    fallen = float((before.unocculted_chi2 - after.unocculted_chi2).sum())
    if shown > (chi2_before - nu).sum() and fallen > shown / 2:
        chi2_before, chi2_after = chi2_before + before.unocculted_chi2, chi2_after + after.unocculted_chi2
        nu, nu_after = nu + before.unocculted_expected, nu_after + after.unocculted_expected
    total = float((chi2_before - nu).sum())
    if total <= 0:
        return None
    chosen = rng.integers(0, nu.size, (RESAMPLES, nu.size))
    scale = np.exp(scale_error * rng.standard_normal(RESAMPLES))
    totals = chi2_before[chosen].sum(axis=1) / scale - nu[chosen].sum(axis=1)
    use = totals > 0
    if use.sum() < RESAMPLES // 2:
        return None
    seen = chi2_after[chosen].sum(axis=1) / scale
    resampled, without_errors = (
        1 - (seen - expected[chosen].sum(axis=1))[use] / totals[use] for expected in (nu, nu_after)
    )
    value = 1 - float((chi2_after - nu).sum()) / total
    low, high = np.percentile(resampled, INTERVAL)
    high = max(high, np.percentile(without_errors, INTERVAL[1]))
    # No cause closes more than the whole gap.
    return Interval(value, float(low) - FORM_ERROR**2, max(value, min(float(high), 1.0)) + FORM_ERROR**2)


def fall(before: HeldOut, after: HeldOut) -> float:
    """The decrease of Eq. (4), for discs and blocks, in the folds of both: how much better `after` predicts the images."""
    return sum(
        before.deviance[one] - after.deviance[one] for one in before.deviance.keys() & after.deviance.keys()
    )


def gap(held_out: HeldOut, rng: np.random.Generator) -> Interval:
    """Eq. (3) with its interval; its upper end is at least the gap that the noise could hide."""
    squares = held_out.residual_pct**2 - held_out.noise_pct**2
    chosen = rng.integers(0, squares.size, (RESAMPLES, squares.size))
    resampled = np.sqrt(np.maximum(squares[chosen].mean(axis=1), 0.0))
    low, high = np.percentile(resampled, INTERVAL)
    hidden = math.sqrt(HIDDEN_SIGMA * math.sqrt(2 * float(np.mean(held_out.noise_pct**4)) / squares.size))
    return Interval(math.sqrt(max(float(squares.mean()), 0.0)), float(low), max(float(high), hidden))
