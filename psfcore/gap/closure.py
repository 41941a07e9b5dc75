"""How far a gap shrinks once an effect is added, on images that took no part in its fit.

    closure = 1 - (chi2_after - nu) / (chi2_before - nu)                                 Eq. (1)
    nu = cells + trace(J Cov J^T)      noise, and the error of the fit that they were held out of      Eq. (2)
    gap = sqrt(mean(residual^2 - noise^2))     of the discs' means, in percent                Eq. (3)

Two schemes: blocks of time with a guard, and one pointing left out. chi2 is that of the discs' cells; where these hardly
show a gap, as with a gain that differs between images, the lit blocks' is added. Intervals: images drawn again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from psfcore.gap.linear_model import LinearModel
from psfcore.transit.blocks import Fold, folds

Vector = NDArray[np.float64]

DRAWS = 1000
SHOWN = 3.0  # sigmas of chi2 by which the discs must show a gap, for them to be judged alone
INTERVAL = (5.0, 95.0)
HIDDEN_SIGMA = 1.645  # 95 % of a normal distribution lies below


@dataclass(frozen=True)
class Interval:
    """A value with its 90 % interval."""

    value: float
    low: float
    high: float

    def to_json(self) -> dict[str, Any]:
        """As a gap report has it."""
        return {"value": self.value, "ci90": [self.low, self.high]}


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Every image with a disc, held out: its cells' chi2, the lit blocks', what is expected of both, its residual.

    residual_pct, noise_pct: of the disc's mean, simulated minus observed over observed; noise with the fit's error.
    Images that no fold holds out are not among them.
    """

    images: tuple[int, ...]
    chi2: Vector
    expected: Vector
    lit_chi2: Vector
    lit_expected: Vector
    residual_pct: Vector
    noise_pct: Vector

    def of(self, images: Sequence[int]) -> HeldOut:
        """Some of the images."""
        at = {image: k for k, image in enumerate(self.images)}
        here = [at[image] for image in images]
        return HeldOut(
            tuple(images),
            self.chi2[here],
            self.expected[here],
            self.lit_chi2[here],
            self.lit_expected[here],
            self.residual_pct[here],
            self.noise_pct[here],
        )


def time_blocks(model: LinearModel) -> tuple[Fold, ...]:
    """Sequential blocks of all images with a guard; none where there are fewer than six."""
    return folds(len(model.evidence.taken))


def pointings(model: LinearModel) -> tuple[Fold, ...]:
    """One fold a pointing; none where there are fewer than two."""
    fovs = [taken.fov for taken in model.evidence.taken]
    if len(set(fovs)) < 2:
        return ()
    every = range(len(fovs))
    return tuple(
        Fold(tuple(n for n in every if fovs[n] == one), tuple(n for n in every if fovs[n] != one))
        for one in sorted(set(fovs))
    )


def hold_out(model: LinearModel, columns: Sequence[int], scheme: Sequence[Fold]) -> HeldOut | None:
    """Every image by a fit, of the PSF and these columns, to images apart from it; none where there is no fold."""
    evidence = model.evidence
    by_index = {disc.index: k for k, disc in enumerate(evidence.discs)}
    rows: list[tuple[float, ...]] = []
    images: list[int] = []
    base = len(evidence.base)
    for fold in scheme:
        fitted = [n for n in fold.fitted if n in by_index]
        held = [n for n in fold.held_out if n in by_index]
        if len(fitted) <= base + len(columns) or not held:
            continue
        step = model.fit(columns, model.equations(fitted))
        here = list(step.columns)
        for n in held:
            disc, white = evidence.discs[by_index[n]], model.discs[by_index[n]]
            left = white.residual - white.answers[here].T @ step.values
            error = float(np.einsum("ki,kl,li->", white.answers[here], step.covariance, white.answers[here]))
            lit, freedom = evidence.lit.held_out_chi2(columns, step.values[base:], [n], fitted)
            answer = disc.answers[here] @ disc.share
            mean = float(disc.share @ disc.residual - answer @ step.values)
            noise = math.sqrt(disc.mean_noise**2 + float(answer @ step.covariance @ answer))
            images.append(n)
            rows.append(
                (
                    float(left @ left),
                    left.size + error,
                    lit / model.lit_scale,
                    float(freedom),
                    -100 * mean / disc.observed,
                    100 * noise / disc.observed,
                )
            )
    if not rows:
        return None
    chi2, expected, lit_chi2, lit_expected, residual, noise_pct = np.array(rows).T
    return HeldOut(tuple(images), chi2, expected, lit_chi2, lit_expected, residual, noise_pct)


def _in_both(before: HeldOut, after: HeldOut) -> tuple[HeldOut, HeldOut] | None:
    """The images that both hold out: with more to fit, folds with few images drop out. None where there are none."""
    common = sorted(set(before.images) & set(after.images))
    if not common:
        return None
    return before.of(common), after.of(common)


def closure(before: HeldOut, after: HeldOut, rng: np.random.Generator) -> Interval | None:
    """Eq. (1) with its interval; none where there is nothing to close."""
    both = _in_both(before, after)
    if both is None:
        return None
    before, after = both
    excess = before.chi2 - before.expected
    left = after.chi2 - before.expected
    if excess.sum() < SHOWN * math.sqrt(2 * float(before.expected.sum())):
        excess = excess + before.lit_chi2 - before.lit_expected
        left = left + after.lit_chi2 - before.lit_expected
    total = float(excess.sum())
    if total <= 0:
        return None
    chosen = rng.integers(0, excess.size, (DRAWS, excess.size))
    totals = excess[chosen].sum(axis=1)
    drawn = 1 - left[chosen].sum(axis=1)[totals > 0] / totals[totals > 0]
    if drawn.size < DRAWS // 2:
        return None
    low, high = np.percentile(drawn, INTERVAL)
    return Interval(1 - float(left.sum()) / total, float(low), float(high))


def fall(before: HeldOut, after: HeldOut) -> float:
    """How far chi2 of discs and lit blocks falls, held out, in the images that both hold out."""
    both = _in_both(before, after)
    if both is None:
        return 0.0
    before, after = both
    return float((before.chi2 - after.chi2 + before.lit_chi2 - after.lit_chi2).sum())


def gap(held_out: HeldOut, rng: np.random.Generator) -> Interval:
    """Eq. (3) with its interval, whose upper end is not below what noise alone would hide."""
    squares = held_out.residual_pct**2 - held_out.noise_pct**2
    chosen = rng.integers(0, squares.size, (DRAWS, squares.size))
    drawn = np.sqrt(np.maximum(squares[chosen].mean(axis=1), 0.0))
    low, high = np.percentile(drawn, INTERVAL)
    hidden = math.sqrt(HIDDEN_SIGMA * math.sqrt(2 * float(np.mean(held_out.noise_pct**4)) / squares.size))
    return Interval(math.sqrt(max(float(squares.mean()), 0.0)), float(low), max(float(high), hidden))
