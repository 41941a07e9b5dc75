"""Cross-validation of a fit: hold out blocks of images and bootstrap the rest, in many runs.

Source: Hofmeister et al., The point-spread function of HRI_EUV, section "Results". The images are divided into ten
blocks in the order of time (fewer blocks if there are fewer than 30 images). Each block is held out once, with a guard on
both sides. In all other blocks, images are resampled with replacement (bootstrap). Ten runs give 100 PSFs. There are two
schemes.

Shared: the fit of a fold differs by a small step from the fit to all images. The contributions of the images to the
normal equations give this step directly:

    q_f = q + (sum over images of k_i A_i)^-1 sum over images of k_i v_i        Eq. (1)

where k_i is the number of times that image i occurs in the bootstrap sample. All folds share the reconstructed scenes, so
this scheme costs almost no time. Its error is of second order in the step.

Exact: every fold is fitted separately. The fit starts from the PSF of Eq. (1) and from the scenes of the fit to all
images, so it converges in one or two rounds. The occulters are located again, and the scenes are iterated until they
converge.

If the scatter is isotropic, every sample is also fitted without a formula (`free_shells`). The free fit is compared with
the formula:

    excess within R = sum over shells within R of (free - formula)              Eq. (2)

There are two estimates of the error of an excess. The first is the spread over the samples, which contains the noise of
the images. This spread is too small if a weight is at its lower bound of zero, or if only the prior determines a shell.
The second estimate follows from the covariance matrix of the free fit. This matrix ignores the bounds and includes the
prior. The larger of the two estimates is used.

| symbol | name |
|---|---|
| A_i, v_i | FrameFit.normal, FrameFit.score |
| q | Inversion.coordinates |
| k_i | FoldSample.counts |
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from psfcore.errors import DataError
from psfcore.psf import cumulative_curve
from psfcore.scatter.inversion import Progress, Solution, refit
from psfcore.scatter.shapes import Shape, Vector
from psfcore.scatter.total_psf import TotalPsf
from psfcore.scatter.validation.free_shells import FreeLight, FreeShares, free_shares, law_light
from psfcore.transit.blocks import Fold, folds

RUNS = 10
RESOLVE_STEPS = 5
SETTLE_STEPS = 1


@dataclass(frozen=True)
class FoldSample:
    """One fold of one run. counts: how many times each image counts. held_out: indices of the held-out images."""

    run: int
    fold: int
    counts: tuple[int, ...]
    held_out: tuple[int, ...]


@dataclass(frozen=True)
class FoldShells:
    """The scattered light in each shell for one sample, as a fraction of all light.

    free: light of the free fit. law: light of the formula. excess_sigma: error of the excess within the outer edge of
    each shell, from the covariance of the free fit.
    """

    free: tuple[float, ...]
    law: tuple[float, ...]
    excess_sigma: tuple[float, ...]

    @staticmethod
    def of(fitted: FreeLight) -> FoldShells:
        """The shells of a free fit."""
        within = np.cumsum(np.cumsum(fitted.covariance, axis=0), axis=1)
        return FoldShells(
            free=tuple(fitted.light.tolist()),
            law=tuple(fitted.law_light.tolist()),
            excess_sigma=tuple(np.sqrt(np.diag(within)).tolist()),
        )


@dataclass(frozen=True)
class FoldFit:
    """The PSF fitted to one sample.

    curve_pct: C(R) = 100 (1 - encircled energy) of the total PSF. held_out_pct: the residual of each held-out image, in
    percent of the observed mean; the keys are the images' indices. shells: None if the formula is not isotropic.
    """

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
        """The fit from the values of `to_json`."""
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


def bootstrap_samples(images: int, *, runs: int = RUNS, seed: int = 1) -> tuple[FoldSample, ...]:
    """The samples of all runs; each run has one sample for each held-out block.

    Raises DataError "too-few-images" if the images do not suffice for two blocks.
    """
    blocks = folds(images)
    if not blocks:
        raise DataError(
            "too-few-images", f"expected at least 6 images for held-out blocks; got {images}: add images"
        )
    rng = np.random.default_rng(seed)
    return tuple(
        _bootstrap_sample(run, fold, blocks, images, rng)
        for run in range(runs)
        for fold in range(len(blocks))
    )


def _bootstrap_sample(
    run: int, fold: int, blocks: tuple[Fold, ...], images: int, rng: np.random.Generator
) -> FoldSample:
    """Resample the images of each remaining block with replacement. Images in the guard are removed first."""
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
        free = None if shares is None else _fold_shells(shares, shape, sample, at + move)
        out.append(_fold_fit(sample, shape, solution.total, at + move, held_out, free))
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
            f"run {sample.run}, fold {sample.fold}: expected images that determine all parameters; got too few: add images",
        )
    return np.asarray(np.linalg.solve(normal, np.sum([k * f.score for k, f in counted], axis=0)))  # Eq. (1)


def exact_fit(
    solution: Solution, sample: FoldSample, *, progress: Progress = lambda stage, step, steps: None
) -> FoldFit:
    """The PSF of one sample, from a separate fit, and the residuals of the held-out images with this PSF.

    solution: the fit to all images. progress: called before each image is processed, so that a worker can send a
    heartbeat or stop the fit. Raises the errors of `shared_fits` and `invert`.
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
        # The last step of the fit changed the PSF by a negligible amount but did not update the scenes. Update them here.
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
