"""Fits of a transit without some of its images, so that a PSF is judged on images that it was not fitted to.

Hofmeister et al., The point-spread function of HRI_EUV, section "Accuracy and robustness", without the resampling:
each sequential block of images (`psfcore.transit.blocks`) is held out in turn, and a guard on both of its sides.
A fold's fit sees its own images alone: also the places of its occulters are found without those held out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from psfcore.errors import DataError
from psfcore.scatter.inversion import Inversion, Progress, invert
from psfcore.scatter.shapes import SOFTENED_POWER_LAW, Shape, Vector
from psfcore.scatter.total_psf import Kernel
from psfcore.transit.blocks import Fold, folds
from psfcore.transit.transit import Transit


@dataclass(frozen=True, eq=False)
class FoldInversion:
    """The fit of one fold: its inversion, and the total PSF [y, x] on what the field can see."""

    fold: Fold
    inversion: Inversion
    kernel: Kernel


@dataclass(frozen=True, eq=False)
class FoldKernels:
    """A total PSF for every image of a transit, fitted without it. Called with an image's index, it gives the PSF."""

    fits: tuple[FoldInversion, ...]

    def __call__(self, index: int) -> Kernel:
        """The PSF of the fold that holds image `index` out."""
        return next(fit.kernel for fit in self.fits if index in fit.fold.held_out)


def fold_kernels(
    transit: Transit,
    shape: Shape = SOFTENED_POWER_LAW,
    *,
    start: Vector | None = None,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> FoldKernels:
    """Fit a shape of scatter once a fold. start: coordinates, as those of the fit to all images; none: the shape's own.

    Raises DataError "too-few-frames" where there are too few images for two folds, and as `inversion.invert`.
    """
    parts = folds(len(transit.frames))
    if not parts:
        raise DataError(
            "too-few-frames", f"expected at least 6 images, to hold some out; got {len(transit.frames)}"
        )
    fits = []
    for number, fold in enumerate(parts, start=1):
        stage = _FoldProgress(progress, number, len(parts))
        fits.append(fit_fold(transit, fold, shape, start=start, threads=threads, progress=stage))
    return FoldKernels(tuple(fits))


def fit_fold(
    transit: Transit,
    fold: Fold,
    shape: Shape = SOFTENED_POWER_LAW,
    *,
    start: Vector | None = None,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> FoldInversion:
    """The fit of one fold. Raises DataError as `inversion.invert`, the images held out named first."""
    part = replace(transit, frames=tuple(transit.frames[n] for n in fold.fitted))
    try:
        solution = invert(part, shape, start=start, threads=threads, progress=progress)
    except DataError as error:
        raise DataError(error.code, f"without {_named(transit, fold.held_out)}: {error.message}") from error
    return FoldInversion(fold, solution.inversion, solution.total.kernel(solution.inversion.coordinates))


def _named(transit: Transit, images: Sequence[int]) -> str:
    first, last = transit.frames[images[0]].file, transit.frames[images[-1]].file
    return first if first == last else f"{first} to {last}"


class _FoldProgress:
    """Progress of one fold among all: each counts as much as another."""

    def __init__(self, progress: Progress, number: int, of: int) -> None:
        self._progress, self._number, self._of = progress, number, of

    def __call__(self, stage: str, step: int, steps: int) -> None:
        self._progress(f"fold {self._number}: {stage}", self._number - 1, self._of)
