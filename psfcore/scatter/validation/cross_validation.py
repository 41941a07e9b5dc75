"""Cross-validation of a fit: hold out blocks of images and bootstrap the rest, in many runs; bands over all fits.

Source: Hofmeister et al., The point-spread function of HRI_EUV, section "Results". The images are divided into ten
blocks in the order of time (fewer blocks if there are fewer than 30 images). Each block is held out once, with a guard
on both sides. In all other blocks, images are resampled with replacement (bootstrap). Ten runs give 100 PSFs. There are
two schemes.

Shared: the fit of a fold differs by a small step from the fit to all images. The contributions of the images to the
normal equations give this step directly:

    q_f = q + (sum over images of k_i A_i)^-1 sum over images of k_i v_i        Eq. (1)

where k_i is the number of times that image i occurs in the bootstrap sample. All folds share the reconstructed scenes,
so this scheme costs almost no time. Its error is of second order in the step.

Exact: every fold is fitted separately. The fit starts from the PSF of Eq. (1) and from the scenes of the fit to all
images, so it converges in one or two rounds. The occulters are located again, and the scenes are iterated until they
converge.

If the scatter is isotropic, every sample is also fitted without a formula (`free_shells`). The free fit is compared
with the formula:

    excess within R = sum over shells within R of (free - formula)              Eq. (2)

There are two estimates of the error of an excess. The first is the spread over the samples, which contains the noise of
the images. This spread is too small if a weight is at its lower bound of zero, or if only the prior determines a shell.
The second estimate follows from the covariance matrix of the free fit. This matrix ignores the bounds and includes the
prior. The larger of the two estimates is used. A band extends from a low to a high percentile of a quantity over the
samples.

| symbol | name |
|---|---|
| A_i, v_i | FrameFit.normal, FrameFit.score |
| q | Inversion.coordinates |
| k_i | FoldSample.counts |
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydantic import TypeAdapter
from scipy.special import ndtr

from psfcore.arrays import Matrix, Vector, json_attributes, json_values
from psfcore.errors import DataError
from psfcore.psf import cumulative_curve
from psfcore.scatter.inversion import refit
from psfcore.scatter.reconstruction import Progress, Solution
from psfcore.scatter.segments import beyond_pct
from psfcore.scatter.validation.free_shells import FreeShares, free_shares, law_light, shells
from psfcore.transit.transit import folds

RUNS = 10
RESOLVE_STEPS = 5
SETTLE_STEPS = 1
# The percentiles of a Gaussian at two and one standard deviations below its mean, at its mean, and above it.
LIMITS = tuple(100 * float(ndtr(deviations)) for deviations in (-2, -1, 0, 1, 2))
ONE_SIGMA = (LIMITS[1], LIMITS[3])
LIMIT_NAMES = ("minus_2_sigma", "minus_1_sigma", "median", "plus_1_sigma", "plus_2_sigma")
# Within this distance, the free fit of the paper differs from the power law of the paper.
NEAR_CENTRE_PX = 3.0
PARTING_SIGMAS = 3.0


@dataclass(frozen=True)
class FoldSample:
    """One fold of one run.

    Attributes
    ----------
    counts
        The number of times that each image counts.
    held_out
        Indices of the held-out images.
    """

    run: int
    fold: int
    counts: tuple[int, ...]
    held_out: tuple[int, ...]


@dataclass(frozen=True)
class FoldShells:
    """The scattered light in each shell for one sample, as a fraction of all light.

    Attributes
    ----------
    free
        Light of the free fit.
    law
        Light of the formula.
    excess_sigma
        Error of the excess within the outer edge of each shell, from the covariance of the free fit.
    """

    free: tuple[float, ...]
    law: tuple[float, ...]
    excess_sigma: tuple[float, ...]


@dataclass(frozen=True)
class FoldFit:
    """The PSF fitted to one sample.

    Attributes
    ----------
    curve_pct
        The curve C(R) = 100 (1 - encircled energy) of the total PSF.
    held_out_pct
        The residual of each held-out image, in percent of the observed mean; the keys are the indices of the images.
    shells
        The light in each shell; None if the formula is not isotropic.
    """

    run: int
    fold: int
    coordinates: tuple[float, ...]
    values: dict[str, float]
    curve_pct: tuple[float, ...]
    held_out_pct: dict[int, float]
    shells: FoldShells | None = None

    def to_json(self) -> dict[str, object]:
        """Plain values."""
        return dict(json_values(self))

    @staticmethod
    def from_json(content: dict[str, object]) -> FoldFit:
        """The fit from the values of `to_json`."""
        return _FOLD_FIT.validate_python(content)


_FOLD_FIT = TypeAdapter(FoldFit)


def held_out_folds(images: int) -> tuple[FoldSample, ...]:
    """One sample for each fold, without bootstrap: each fitted image counts once.

    Raises DataError "too-few-images" if the images do not suffice for two blocks.
    """
    blocks = folds(images)
    if not blocks:
        raise DataError(
            "too-few-images", f"expected at least 6 images for held-out folds; got {images}: add images"
        )
    return tuple(
        FoldSample(0, k, tuple(int(n in block.fitted) for n in range(images)), block.held_out)
        for k, block in enumerate(blocks)
    )


def bootstrap_samples(images: int, *, runs: int = RUNS, seed: int = 1) -> tuple[FoldSample, ...]:
    """The samples of all runs; each run has one sample for each held-out block. Raises DataError "too-few-images"."""
    once = held_out_folds(images)
    rng = np.random.default_rng(seed)
    samples = []
    for run in range(runs):
        for sample in once:
            counts = np.zeros(images, dtype=np.int64)
            for block in once:  # resample each with replacement, without the held-out images and the guard
                left = [image for image in block.held_out if sample.counts[image]]
                if left:
                    np.add.at(counts, rng.choice(left, len(left)), 1)
            samples.append(replace(sample, run=run, counts=tuple(counts.tolist())))
    return tuple(samples)


def shared_fits(
    solution: Solution,
    wanted: tuple[FoldSample, ...],
    *,
    progress: Progress = lambda stage, step, steps: None,
) -> tuple[FoldFit, ...]:
    """The PSFs of all samples by Eq. (1), from the solution of all images.

    Images that the solution did not use are left out of all samples. Raises DataError "transit-says-too-little" if a
    sample does not determine all parameters.
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
        out.append(_fold_fit(sample, solution, at + move, held_out, shares))
    return tuple(out)


def shared_step(solution: Solution, sample: FoldSample) -> Vector:
    """The step of Eq. (1): coordinates fitted to a sample minus coordinates fitted to all images.

    Raises DataError "transit-says-too-little" if the sample does not determine all parameters.
    """
    counts = [sample.counts[n] for n in solution.part]
    counted = [(k, frame) for k, frame in zip(counts, solution.inversion.frames, strict=True) if k]
    normal = np.sum([k * frame.normal for k, frame in counted], axis=0)
    if not counted or np.linalg.cond(normal) > 1e12:
        raise DataError(
            "transit-says-too-little",
            f"run {sample.run}, fold {sample.fold}: expected images that determine all parameters; got too few: add "
            "images",
        )
    return np.asarray(np.linalg.solve(normal, np.sum([k * f.score for k, f in counted], axis=0)))  # Eq. (1)


def exact_fit(
    solution: Solution, sample: FoldSample, *, progress: Progress = lambda stage, step, steps: None
) -> FoldFit:
    """The PSF of one sample, from a separate fit, and the residuals of the held-out images with this PSF.

    Raises the errors of `shared_fits` and `invert`.

    Parameters
    ----------
    solution
        The fit to all images.
    progress
        Function that is called before each image is processed, so that a worker can send a heartbeat or stop the fit.
    """
    start = solution.inversion.coordinates + shared_step(solution, sample)
    fitted, at = refit(solution, sample.counts, start, progress=progress)
    sky, left_out = fitted.sky, fitted.sky.left_out()
    held_out = {}
    for step, n in enumerate(sample.held_out):
        progress("images held out", step, len(sample.held_out))
        if solution.transit.frames[n].file in left_out:
            continue
        sky.improve(n, fitted.optics, RESOLVE_STEPS)
        residual, expected = fitted.residual(n)
        held_out[n] = float(-100 * residual.mean() / (expected + residual).mean())
    shares = None
    if solution.inversion.shape.isotropic:
        # The last step of the fit changed the PSF by a negligible amount but did not update the scenes. Update them
        # here.
        for step, n in enumerate(fitted.part):
            progress("settling", step, len(fitted.part))
            sky.improve(n, fitted.optics, SETTLE_STEPS)
        shares = free_shares(fitted, at, progress=progress)
    return _fold_fit(sample, solution, at, held_out, shares)


def _fold_fit(
    sample: FoldSample,
    solution: Solution,
    at: Vector,
    held_out: dict[int, float],
    shares: FreeShares | None,
) -> FoldFit:
    """The fit at these coordinates, with free shells if there are shares."""
    shape, total, shells_of_fold = solution.inversion.shape, solution.total, None
    if shares is not None:
        free = shares.fit(sample.counts, law_light(shape, at))
        within = np.cumsum(np.cumsum(free.covariance, axis=0), axis=1)
        vectors = (free.light, free.law_light, np.sqrt(np.diag(within)))
        shells_of_fold = FoldShells(*(tuple(vector.tolist()) for vector in vectors))
    return FoldFit(
        run=sample.run,
        fold=sample.fold,
        coordinates=tuple(float(q) for q in at),
        values=shape.values(at),
        curve_pct=tuple(float(c) for c in cumulative_curve(total.kernel(at), total.radii_px)),
        held_out_pct=held_out,
        shells=shells_of_fold,
    )


# --- bands ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ShellBands:
    """The free fits and the formulas of all samples, shell by shell.

    Arrays (5, shells) contain percentiles over the samples, at -2, -1, 0, +1 and +2 sigma. "law" stands for the
    formula.

    Attributes
    ----------
    edges_px
        Edges of the shells, (shells + 1,).
    free_weight, law_weight
        Weight per pixel of each shell, (5, shells).
    free_beyond_pct, law_beyond_pct
        Percentage of the light that is scattered beyond the inner edge of each shell, (5, shells).
    excess_pct
        Excess of Eq. (2) within the outer edge of each shell, in percentage points of all light, (5, shells).
    excess_sigma
        Error of the excess, (shells,).
    law_within_pct
        Median of the formula's light within the outer edge of each shell, (shells,).
    """

    edges_px: Vector
    free_weight: Matrix
    law_weight: Matrix
    free_beyond_pct: Matrix
    law_beyond_pct: Matrix
    excess_pct: Matrix
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
        """The excess within NEAR_CENTRE_PX.

        This excess includes all shells that contain only pixels up to this distance.
        """
        beyond = np.sqrt(NEAR_CENTRE_PX**2 + 1)
        return self.excess(int(np.flatnonzero(self.edges_px[1:] < beyond)[-1]))

    @property
    def largest(self) -> Excess:
        """The excess with the largest ratio of its absolute value to its error."""
        return self.excess(int(np.argmax(np.abs(self.excess_pct[2] / self.excess_sigma))))

    def to_json(self) -> dict[str, object]:
        """Plain values."""
        return {
            "edges_px": self.edges_px.tolist(),
            "weight": {"free": limits_json(self.free_weight), "formula": limits_json(self.law_weight)},
            "diffuse_light_beyond_inner_edge_pct": {
                "free": limits_json(self.free_beyond_pct),
                "formula": limits_json(self.law_beyond_pct),
            },
            "excess_within_outer_edge_points": limits_json(self.excess_pct)
            | {"sigma": self.excess_sigma.tolist()},
            "excess_near_centre": vars(self.near_centre),
            "largest_excess": vars(self.largest) | {"parts": self.largest.parts},
        }


def limits_json(limits: Matrix) -> dict[str, object]:
    """Percentiles at LIMITS by name."""
    return dict(zip(LIMIT_NAMES, limits.tolist(), strict=True))


@dataclass(frozen=True)
class Excess:
    """The light of the free fit within a distance minus the light of the formula within the same distance.

    Attributes
    ----------
    points
        The difference in percent of all light.
    sigma
        Error of `points`.
    of_formula_pct
        The same difference in percent of the light that the formula puts within the distance.
    """

    within_px: float
    points: float
    sigma: float
    of_formula_pct: float

    @property
    def parts(self) -> bool:
        """Whether the free fit and the formula differ by more than PARTING_SIGMAS standard errors."""
        return abs(self.points) > PARTING_SIGMAS * self.sigma


@dataclass(frozen=True, eq=False)
class Bands:
    """Medians and bands of all samples: percentiles at -2, -1, 0, +1 and +2 sigma.

    Attributes
    ----------
    curve_pct
        Percentiles of C(R) at radii_px, (5, radii).
    values
        Percentiles of each parameter, (5,).
    totals
        The total of scatter of each fit.
    held_out_pct
        Mean residual of each held-out image, percent.
    shells
        Percentiles by shell; None if the formula is not isotropic.
    """

    radii_px: Vector
    curve_pct: Matrix
    values: dict[str, Vector]
    totals: Vector
    held_out_pct: dict[int, float]
    shells: ShellBands | None

    @property
    def held_out(self) -> dict[str, float]:
        """Mean, rms and largest absolute value of the held-out residuals, in percent.

        Each image counts once, with its mean residual over the samples.
        """
        found = np.array(list(self.held_out_pct.values()))
        if found.size == 0:
            return {}
        return {
            "mean_pct": float(found.mean()),
            "rms_pct": float(np.sqrt((found**2).mean())),
            "largest_pct": float(np.abs(found).max()),
        }

    def to_json(self) -> dict[str, object]:
        """Plain values."""
        return {
            "light_beyond_pct": limits_json(self.curve_pct),
            "parameters": {name: limits_json(limits) for name, limits in self.values.items()},
            "shells": None if self.shells is None else self.shells.to_json(),
            **json_attributes(self, "radii_px", "totals", "held_out", "held_out_pct"),
        }


def bands(fits: tuple[FoldFit, ...], radii_px: Vector) -> Bands:
    """Medians and percentiles over the samples.

    Parameters
    ----------
    radii_px
        The radii at which the curves C(R) of the fits are given.
    """
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
    """Medians and percentiles over the samples, for each shell."""
    free, law = np.array([fold.free for fold in folds]), np.array([fold.law for fold in folds])
    counts = shells().counts
    excess = 100 * np.cumsum(free - law, axis=1)  # Eq. (2)
    spread = np.subtract(*np.percentile(excess, ONE_SIGMA[::-1], axis=0)) / 2
    expected = 100 * np.median([fold.excess_sigma for fold in folds], axis=0)

    return ShellBands(
        edges_px=np.array(shells().edges_px),
        free_weight=np.percentile(free / counts, LIMITS, axis=0),
        law_weight=np.percentile(law / counts, LIMITS, axis=0),
        free_beyond_pct=np.percentile(beyond_pct(free), LIMITS, axis=0),
        law_beyond_pct=np.percentile(beyond_pct(law), LIMITS, axis=0),
        excess_pct=np.percentile(excess, LIMITS, axis=0),
        excess_sigma=np.maximum(spread, expected),
        law_within_pct=100 * np.median(np.cumsum(law, axis=1), axis=0),
    )
