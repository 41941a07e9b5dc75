"""Compare shapes of scatter by their errors on held-out images.

Source: Hofmeister et al., The point-spread function of HRI_EUV, section "Accuracy and robustness". The paper compares
three shapes by the MPE and MAPE of all superposed occulters: isotropic, stretched along x, and stretched along any
direction. Free shells are added here. Each shape is fitted to all images. The PSF of a fold differs from this fit by
one step (Eq. (1) of `psfcore.scatter.validation.cross_validation`). Every image is simulated with the PSF of the fold
that holds it out.

The errors of the figures below come from a bootstrap of the images. All shapes use the same images, so the differences
between shapes have much smaller errors than the figures themselves. If the residuals of consecutive images are
correlated, the bootstrap errors are too small.

    MPE rms = rms over the disc of (mean over images of PE)                     Eq. (1)
    MAPE mean = mean over the disc of (mean over images of |PE|)                Eq. (2)

| symbol | name | unit |
|---|---|---|
| MPE rms, MAPE mean | mpe_rms_pct, mape_mean_pct | % of the observed mean |
| PE | FrameEvaluation.pe_pct: percentage error of a pixel | % of the observed mean |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from psfcore.arrays import Kernel, Matrix, Vector
from psfcore.errors import DataError
from psfcore.evaluation.evaluation import (
    LEAST_SHARE,
    FrameEvaluation,
    evaluate,
    half_width_px,
    superposed_maps,
)
from psfcore.scatter.inversion import invert
from psfcore.scatter.reconstruction import Inversion, Progress, Solution, labelled
from psfcore.scatter.shapes import SHAPES, SOFTENED_POWER_LAW
from psfcore.scatter.validation.cross_validation import FoldSample, held_out_folds, shared_step
from psfcore.scatter.validation.free_shells import free_kernel, free_shares, law_light
from psfcore.transit.transit import folds

FREE_SHELLS = "free-shells"
STRETCHED = ("stretched-along-x", "stretched")
BOOTSTRAP_SAMPLES = 1000
FIGURES = ("residual_mean_pct", "residual_rms_pct", "mpe_rms_pct", "mape_mean_pct")
KernelOf = Callable[[int], Kernel]


@dataclass(frozen=True)
class ShapeErrors:
    """Errors of one shape on held-out images, in percent of the observed mean.

    Attributes
    ----------
    figures
        Value and standard error of each of FIGURES.
    minus_first
        Figures of this shape minus those of the softened power law, with standard errors.
    parameters
        Value and standard error of each parameter in the fit to all images; empty for free shells.
    """

    name: str
    parameters: dict[str, tuple[float, float]]
    figures: dict[str, tuple[float, float]]
    minus_first: dict[str, tuple[float, float]]

    def to_json(self) -> dict[str, object]:
        """Plain values."""
        return {
            "name": self.name,
            "parameters": _named(self.parameters),
            **_named(self.figures),
            "minus_softened_power_law": _named(self.minus_first),
        }


@dataclass(frozen=True)
class ShapesByErrors:
    """The errors of all compared shapes; each shape is evaluated on the same images. The power law comes first."""

    images: int
    folds: int
    shapes: tuple[ShapeErrors, ...]

    def to_json(self) -> dict[str, object]:
        """Plain values."""
        return {
            "images": self.images,
            "folds": self.folds,
            "resamples": BOOTSTRAP_SAMPLES,
            "shapes": [shape.to_json() for shape in self.shapes],
        }


def _named(figures: dict[str, tuple[float, float]]) -> dict[str, dict[str, float]]:
    return {name: {"value": value, "sigma": sigma} for name, (value, sigma) in figures.items()}


def compare_shapes_by_errors(
    solution: Solution, *, seed: int = 1, progress: Progress = lambda stage, step, steps: None
) -> ShapesByErrors:
    """Compare the softened power law of `solution` with both stretched shapes and with free shells.

    Raises DataError "unknown-shape" if `solution` has another shape, "too-few-images" for fewer than six images, and
    the errors of `invert` and `evaluate`.

    Parameters
    ----------
    seed
        Random seed of the bootstrap.
    """
    if solution.inversion.shape.name != SOFTENED_POWER_LAW.name:
        raise DataError(
            "unknown-shape",
            f"expected a fit of the shape {SOFTENED_POWER_LAW.name}; got {solution.inversion.shape.name}: fit that "
            "shape first",
        )
    named: dict[str, tuple[Solution | None, KernelOf]] = {
        SOFTENED_POWER_LAW.name: (solution, held_out_kernels(solution))
    }
    for name in STRETCHED:
        # The fit of another shape to all images starts from the fit of the power law.
        start, told = SHAPES[name].coordinates(solution.inversion.values), labelled(progress, name)
        stretched = invert(
            solution.transit, SHAPES[name], start=start, threads=solution.threads, progress=told
        )
        named[name] = stretched, held_out_kernels(stretched)
    named[FREE_SHELLS] = None, _free_fold_kernels(solution, progress)
    evaluations: dict[str, dict[int, FrameEvaluation]] = {}  # the keys are the images' indices
    for name, (_, kernel_of) in named.items():
        told, threads = labelled(progress, name), solution.threads
        done = evaluate(solution.transit, kernel_of, noise_realisations=0, threads=threads, progress=told)
        evaluations[name] = {frame.index: frame for frame in done.frames}
    images = sorted(set.intersection(*(set(evaluation) for evaluation in evaluations.values())))
    # The number of times that each image counts; in the first row, each image counts once.
    draws = np.random.default_rng(seed).multinomial(
        len(images), np.full(len(images), 1 / len(images)), BOOTSTRAP_SAMPLES
    )
    counts = np.concatenate((np.ones((1, len(images))), draws.astype(np.float64)))
    found = {
        name: _figures([evaluation[n] for n in images], counts) for name, evaluation in evaluations.items()
    }
    first = found[SOFTENED_POWER_LAW.name]
    return ShapesByErrors(
        images=len(images),
        folds=len(folds(len(solution.transit.frames))),
        shapes=tuple(
            ShapeErrors(
                name=name,
                parameters={} if fitted is None else _parameters(fitted.inversion),
                figures=_with_errors(found[name]),
                minus_first=_with_errors(found[name] - first),
            )
            for name, (fitted, _) in named.items()
        ),
    )


def _parameters(inversion: Inversion) -> dict[str, tuple[float, float]]:
    sigma = inversion.value_sigma
    return {name: (value, sigma[name]) for name, value in inversion.values.items()}


def held_out_kernels(solution: Solution) -> KernelOf:
    """For each image index, the total PSF [y, x] fitted without that image.

    Each fold takes one step from the fit to all images (`psfcore.scatter.validation.cross_validation.shared_step`).
    Raises DataError "too-few-images" for fewer than six images.
    """
    return _of_folds(solution, lambda _, at: solution.total.kernel(at))


def _free_fold_kernels(solution: Solution, progress: Progress) -> KernelOf:
    """For each image, the total PSF [y, x] with free shells, of the fold that holds the image out."""
    shape, diffraction, size = solution.inversion.shape, solution.transit.diffraction, solution.total.size
    shares = free_shares(solution, solution.inversion.coordinates, progress=progress)

    def kernel(sample: FoldSample, at: Vector) -> Kernel:
        free = shares.fit(sample.counts, law_light(shape, at))
        return free_kernel(free, shape, at, diffraction, size, threads=solution.threads)

    return _of_folds(solution, kernel)


def _of_folds(solution: Solution, kernel_of: Callable[[FoldSample, Vector], Kernel]) -> KernelOf:
    """For each image, the kernel of its fold, which `kernel_of` makes from the fold and its coordinates."""
    samples, at = held_out_folds(len(solution.transit.frames)), solution.inversion.coordinates
    kernels = [kernel_of(sample, at + shared_step(solution, sample)) for sample in samples]
    fold_of = {n: sample.fold for sample in samples for n in sample.held_out}
    return lambda n: kernels[fold_of[n]]


def _figures(frames: list[FrameEvaluation], counts: Matrix) -> Matrix:
    """FIGURES for all images (first column) and for each bootstrap sample, (FIGURES, 1 + BOOTSTRAP_SAMPLES)."""
    half_px = half_width_px(max(frame.found.place.radius_px for frame in frames))
    maps = superposed_maps(frames, [frame.pe_pct for frame in frames], half_px).reshape(len(frames), -1)
    dark = np.isfinite(maps)
    shown = dark.sum(axis=0) >= LEAST_SHARE * len(frames)
    pe, dark = np.nan_to_num(maps[:, shown]), dark[:, shown]
    # In rare samples, a position in the disc is not dark in any image. The error at this position then counts as 0.
    count = np.maximum(counts @ dark, 1)
    mpe, mape = counts @ pe / count, counts @ np.abs(pe) / count
    residual = np.array([frame.residual_pct for frame in frames])
    share = counts / len(frames)
    return np.array(
        [
            share @ residual,
            np.sqrt(share @ residual**2),
            np.sqrt((mpe**2).mean(axis=1)),
            mape.mean(axis=1),
        ]
    )


def _with_errors(figures: Matrix) -> dict[str, tuple[float, float]]:
    return {
        name: (float(values[0]), float(values[1:].std(ddof=1)))
        for name, values in zip(FIGURES, figures, strict=True)
    }
