"""How well a fit is known, from the images themselves: blocks held out, images drawn again.

Hofmeister et al., The point-spread function of HRI_EUV, section "Results": ten sequential blocks, each held out once
with a guard on both sides; in every other block images are drawn again with repetition; ten runs: 100 PSFs.

Two schemes. Shared: about the solution of all images a fold differs by a small step, which the images' shares of the
normal equations give at once,

    q_f = q + (sum over images of k_i A_i)^-1 sum over images of k_i v_i        Eq. (1)

with k_i how often image i was drawn. It shares every reconstruction and costs nothing; the difference is second order.
Exact: every fold is a fit of its own. It begins where Eq. (1) ends, with the scenes of all images' solution, so that
it settles in a round or two; its occulters are looked for again, and its scenes iterated on until it has settled.

Where the scatter is a formula of distance, every draw has a free fit too (`free_shells`), and both stand side by side:

    excess within R = sum over shells within R of (free - formula)              Eq. (2)

An excess has two errors. Draws spread by noise in the images; but where a weight cannot go below zero they spread by
less, and what holds a shell that no image decides does not spread at all. So its error is the larger of the spread of
the draws and the covariance of the fit of Eq. (2) there, without bounds and with the hold.

| symbol | name |
|---|---|
| A_i, v_i | FrameFit.normal, FrameFit.score |
| k_i | FoldSample.counts |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from psfcore.errors import DataError
from psfcore.psf import cumulative_curve
from psfcore.scatter.inversion import Progress, Solution, refit
from psfcore.scatter.shapes import Shape, Vector
from psfcore.scatter.total_psf import TotalPsf
from psfcore.scatter.validation.free_shells import FreeLight, FreeShares, free_shares, law_light, shells
from psfcore.transit.blocks import Fold, folds

RUNS = 10
# Percentiles of a Gaussian's one and two standard deviations below and above its mean.
ONE_SIGMA: tuple[float, float] = (100 * float(ndtr(-1)), 100 * float(ndtr(1)))
TWO_SIGMA: tuple[float, float] = (100 * float(ndtr(-2)), 100 * float(ndtr(2)))
LIMITS = (TWO_SIGMA[0], ONE_SIGMA[0], 50.0, ONE_SIGMA[1], TWO_SIGMA[1])
LIMIT_NAMES = ("minus_2_sigma", "minus_1_sigma", "median", "plus_1_sigma", "plus_2_sigma")
RESOLVE_STEPS = 5
SETTLE_STEPS = 1
NEAR_CENTRE_PX = 3.0  # where the paper's free fit and power law part
PARTING_SIGMAS = 3.0


@dataclass(frozen=True)
class FoldSample:
    """One fold of one run: how often each image counts, and which are held out."""

    run: int
    fold: int
    counts: tuple[int, ...]
    held_out: tuple[int, ...]


@dataclass(frozen=True)
class FoldShells:
    """Diffuse light of each shell in one sample, of all light: of the free fit and of the formula.

    excess_sigma: error of the excess within each shell's outer edge by the fit's covariance.
    """

    free: tuple[float, ...]
    law: tuple[float, ...]
    excess_sigma: tuple[float, ...]

    @staticmethod
    def of(fitted: FreeLight) -> FoldShells:
        """Those of a free fit."""
        within = np.cumsum(np.cumsum(fitted.covariance, axis=0), axis=1)
        return FoldShells(
            free=tuple(fitted.light.tolist()),
            law=tuple(fitted.law_light.tolist()),
            excess_sigma=tuple(np.sqrt(np.diag(within)).tolist()),
        )


@dataclass(frozen=True)
class FoldFit:
    """The PSF of one sample: coordinates, values by name, cumulative curve (percent), and residuals of images held out
    (percent of their observed mean, by index). shells: none where the formula is not one of distance alone."""

    run: int
    fold: int
    coordinates: tuple[float, ...]
    values: dict[str, float]
    curve_pct: tuple[float, ...]
    held_out_pct: dict[int, float]
    shells: FoldShells | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            **vars(self),
            "held_out_pct": {str(k): v for k, v in self.held_out_pct.items()},
            "shells": None if self.shells is None else dict(vars(self.shells)),
        }

    @staticmethod
    def from_json(content: dict[str, Any]) -> FoldFit:
        """What to_json gave."""
        held_out = {int(k): float(v) for k, v in content["held_out_pct"].items()}
        of_shells = content.get("shells")
        return FoldFit(
            run=int(content["run"]),
            fold=int(content["fold"]),
            coordinates=tuple(content["coordinates"]),
            values=dict(content["values"]),
            curve_pct=tuple(content["curve_pct"]),
            held_out_pct=held_out,
            shells=None
            if of_shells is None
            else FoldShells(**{name: tuple(values) for name, values in of_shells.items()}),
        )


@dataclass(frozen=True, eq=False)
class ShellBands:
    """Free fit and formula side by side, over all draws; limits as those of `Bands`, (5, shells).

    edges_px: (shells + 1,). free_weight, law_weight: of a pixel of each shell. free_beyond_pct, law_beyond_pct:
    diffuse light beyond each shell's inner edge. excess_pct: light of the free fit less that of the formula, within
    each shell's outer edge, Eq. (2), percent of all light, with its error excess_sigma (shells,).
    law_within_pct: median light of the formula there.
    """

    edges_px: Vector
    free_weight: NDArray[np.float64]
    law_weight: NDArray[np.float64]
    free_beyond_pct: NDArray[np.float64]
    law_beyond_pct: NDArray[np.float64]
    excess_pct: NDArray[np.float64]
    excess_sigma: Vector
    law_within_pct: Vector

    def excess(self, shell: int) -> Excess:
        """The excess within the outer edge of a shell."""
        return Excess(
            within_px=float(self.edges_px[shell + 1]),
            points=float(self.excess_pct[2, shell]),
            sigma=float(self.excess_sigma[shell]),
            of_formula_pct=100 * float(self.excess_pct[2, shell] / self.law_within_pct[shell]),
        )

    @property
    def near_centre(self) -> Excess:
        """Within NEAR_CENTRE_PX: shells whose outer edge lies below the next distance of pixels."""
        beyond = np.sqrt(NEAR_CENTRE_PX**2 + 1)
        return self.excess(int(np.flatnonzero(self.edges_px[1:] < beyond)[-1]))

    @property
    def largest(self) -> Excess:
        """Where free fit and formula are farthest apart, in errors."""
        return self.excess(int(np.argmax(np.abs(self.excess_pct[2] / self.excess_sigma))))

    def to_json(self) -> dict[str, Any]:
        """Plain values."""

        def named(limits: NDArray[np.float64]) -> dict[str, list[float]]:
            return dict(zip(LIMIT_NAMES, limits.tolist(), strict=True))

        return {
            "edges_px": self.edges_px.tolist(),
            "weight": {"free": named(self.free_weight), "formula": named(self.law_weight)},
            "diffuse_light_beyond_inner_edge_pct": {
                "free": named(self.free_beyond_pct),
                "formula": named(self.law_beyond_pct),
            },
            "excess_within_outer_edge_points": named(self.excess_pct) | {"sigma": self.excess_sigma.tolist()},
            "excess_near_centre": vars(self.near_centre),
            "largest_excess": vars(self.largest) | {"parts": self.largest.parts},
        }


@dataclass(frozen=True)
class Excess:
    """Light of the free fit less that of the formula within a distance: points of all light, with its error.

    of_formula_pct: the same in percent of the formula's light there.
    """

    within_px: float
    points: float
    sigma: float
    of_formula_pct: float

    @property
    def parts(self) -> bool:
        """Whether free fit and formula part here, by PARTING_SIGMAS errors."""
        return abs(self.points) > PARTING_SIGMAS * self.sigma


@dataclass(frozen=True, eq=False)
class Bands:
    """Median and bands over all draws: at radii_px the curve's 1 and 2 sigma limits, (5, radii): -2, -1, 0, 1, 2.

    shells: none where the formula is not one of distance alone.
    """

    radii_px: Vector
    curve_pct: NDArray[np.float64]
    values: dict[str, Vector]
    totals: Vector
    held_out_pct: dict[int, float]
    shells: ShellBands | None

    @property
    def held_out(self) -> dict[str, float]:
        """Mean, rms and largest of the held-out residuals, percent; each image's mean over the draws counts once."""
        found = np.array(list(self.held_out_pct.values()))
        if found.size == 0:
            return {}
        return {
            "mean_pct": float(found.mean()),
            "rms_pct": float(np.sqrt((found**2).mean())),
            "largest_pct": float(np.abs(found).max()),
        }

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "radii_px": self.radii_px.tolist(),
            "light_beyond_pct": dict(zip(LIMIT_NAMES, self.curve_pct.tolist(), strict=True)),
            "parameters": {
                name: dict(zip(LIMIT_NAMES, limits.tolist(), strict=True))
                for name, limits in self.values.items()
            },
            "shells": None if self.shells is None else self.shells.to_json(),
            "totals": self.totals.tolist(),
            "held_out": self.held_out,
            "held_out_pct": {str(image): value for image, value in self.held_out_pct.items()},
        }


def bootstrap_samples(images: int, *, runs: int = RUNS, seed: int = 1) -> tuple[FoldSample, ...]:
    """All draws of all runs. Raises DataError "too-few-images" where there are not two blocks."""
    blocks = folds(images)
    if not blocks:
        raise DataError("too-few-images", f"expected at least 6 images to hold blocks out; got {images}")
    rng = np.random.default_rng(seed)
    return tuple(
        _bootstrap_sample(run, fold, blocks, images, rng)
        for run in range(runs)
        for fold in range(len(blocks))
    )


def _bootstrap_sample(
    run: int, fold: int, blocks: tuple[Fold, ...], images: int, rng: np.random.Generator
) -> FoldSample:
    """Every block but the one held out gives as many images as it has left, drawn with repetition."""
    counts = np.zeros(images, dtype=np.int64)
    fitted = set(blocks[fold].fitted)
    for k, block in enumerate(blocks):
        left = [image for image in block.held_out if image in fitted]
        if k != fold and left:
            np.add.at(counts, rng.choice(left, len(left)), 1)
    return FoldSample(run, fold, tuple(int(c) for c in counts), blocks[fold].held_out)


def shared_fits(
    solution: Solution,
    wanted: tuple[FoldSample, ...],
    *,
    progress: Progress = lambda stage, step, steps: None,
) -> tuple[FoldFit, ...]:
    """The PSFs of all draws by Eq. (1), from the solution of all images.

    Images left out of the solution are left out of every sample. Raises DataError "transit-says-too-little" where
    a draw leaves a parameter open.
    """
    inversion = solution.inversion
    shape, at = inversion.shape, inversion.coordinates
    frames = dict(zip(solution.part, inversion.frames, strict=True))
    shares = free_shares(solution, at, progress=progress) if shape.isotropic else None
    out = []
    for step, sample in enumerate(wanted):
        progress("folds", step, len(wanted))
        move = shared_step(solution, sample)
        held_out = {
            n: 100
            * (frames[n].expected + float(frames[n].mean_jacobian @ move) - frames[n].observed)
            / frames[n].observed
            for n in sample.held_out
            if n in frames
        }
        free = None if shares is None else _fold_shells(shares, shape, sample, at + move)
        out.append(_fold_fit(sample, shape, solution.total, at + move, held_out, free))
    return tuple(out)


def shared_step(solution: Solution, sample: FoldSample) -> Vector:
    """Eq. (1): from the solution of all images to that of a sample, in coordinates. Raises DataError as `shared_fits`."""
    counts = [sample.counts[n] for n in solution.part]
    drawn = [(k, frame) for k, frame in zip(counts, solution.inversion.frames, strict=True) if k]
    normal = np.sum([k * frame.normal for k, frame in drawn], axis=0)
    if not drawn or np.linalg.cond(normal) > 1e12:
        raise DataError(
            "transit-says-too-little",
            f"run {sample.run}, fold {sample.fold}: expected images that fix all parameters; got too few",
        )
    return np.asarray(np.linalg.solve(normal, np.sum([k * f.score for k, f in drawn], axis=0)))  # Eq. (1)


def exact_fit(
    solution: Solution, sample: FoldSample, *, progress: Progress = lambda stage, step, steps: None
) -> FoldFit:
    """The PSF of one draw by a fit of its own; images held out are looked at with that PSF afterwards.

    solution: of all images. progress is called before each image that is looked at, so that who does the fold can say
    that it is alive, and stop. Raises DataError as `shared_fits` and `inversion.invert`.
    """
    shape = solution.inversion.shape
    start = solution.inversion.coordinates + shared_step(solution, sample)
    found = refit(solution, sample.counts, start, progress=progress)
    sky, at = found.sky, found.coordinates
    held_out = {}
    for step, n in enumerate(sample.held_out):
        progress("images held out", step, len(sample.held_out))
        if solution.transit.frames[n].file in found.left_out:
            continue
        sky.scenes[n] = found.optics.invert(sky.observed[n], sky.scenes[n], steps=RESOLVE_STEPS)
        residual, expected = found.residual(n)
        held_out[n] = float(-100 * residual.mean() / (expected + residual).mean())
    free = None
    if shape.isotropic:
        # The last step of the fit moved the PSF by less than shows, and not the scenes.
        for step, n in enumerate(found.part):
            progress("settling", step, len(found.part))
            sky.scenes[n] = found.optics.invert(sky.observed[n], sky.scenes[n], steps=SETTLE_STEPS)
        free = _fold_shells(free_shares(found, at, progress=progress), shape, sample, at)
    return _fold_fit(sample, shape, solution.total, at, held_out, free)


def _fold_shells(shares: FreeShares, shape: Shape, sample: FoldSample, at: Vector) -> FoldShells:
    return FoldShells.of(shares.fit(sample.counts, law_light(shape, at)))


def _fold_fit(
    sample: FoldSample,
    shape: Shape,
    total: TotalPsf,
    at: Vector,
    held_out: dict[int, float],
    free: FoldShells | None,
) -> FoldFit:
    return FoldFit(
        run=sample.run,
        fold=sample.fold,
        coordinates=tuple(float(q) for q in at),
        values=shape.values(at),
        curve_pct=tuple(float(c) for c in cumulative_curve(total.kernel(at), total.radii_px)),
        held_out_pct=held_out,
        shells=free,
    )


def bands(fits: tuple[FoldFit, ...], radii_px: Vector) -> Bands:
    """Medians and percentiles over the draws."""
    held_out: dict[int, list[float]] = {}
    for fit in fits:
        for image, residual in fit.held_out_pct.items():
            held_out.setdefault(image, []).append(residual)
    with_shells = [fit.shells for fit in fits if fit.shells is not None]
    return Bands(
        radii_px=radii_px,
        curve_pct=np.percentile([fit.curve_pct for fit in fits], LIMITS, axis=0),
        values={name: np.percentile([fit.values[name] for fit in fits], LIMITS) for name in fits[0].values},
        totals=np.array([fit.values["total"] for fit in fits]),
        held_out_pct={image: float(np.mean(found)) for image, found in sorted(held_out.items())},
        shells=shell_bands(with_shells) if len(with_shells) == len(fits) else None,
    )


def shell_bands(folds: Sequence[FoldShells]) -> ShellBands:
    """Medians and percentiles over the draws, shell by shell."""
    free, law = np.array([fold.free for fold in folds]), np.array([fold.law for fold in folds])
    counts = shells().counts
    excess = 100 * np.cumsum(free - law, axis=1)  # Eq. (2)
    spread = np.subtract(*np.percentile(excess, ONE_SIGMA[::-1], axis=0)) / 2
    expected = 100 * np.median([fold.excess_sigma for fold in folds], axis=0)

    def beyond_pct(light: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.percentile(100 * np.cumsum(light[:, ::-1], axis=1)[:, ::-1], LIMITS, axis=0))

    return ShellBands(
        edges_px=np.array(shells().edges_px),
        free_weight=np.percentile(free / counts, LIMITS, axis=0),
        law_weight=np.percentile(law / counts, LIMITS, axis=0),
        free_beyond_pct=beyond_pct(free),
        law_beyond_pct=beyond_pct(law),
        excess_pct=np.percentile(excess, LIMITS, axis=0),
        excess_sigma=np.maximum(spread, expected),
        law_within_pct=100 * np.median(np.cumsum(law, axis=1), axis=0),
    )
