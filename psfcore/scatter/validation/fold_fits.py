"""Fit a transit without some of its images, to test the PSF on held-out images.

Source: Hofmeister et al., The point-spread function of HRI_EUV, section "Accuracy and robustness", without the bootstrap.
Each block of consecutive images (`psfcore.transit.blocks`) is held out in turn, with a guard on both sides. The fit of a
fold does not use the held-out images at all, not even to locate the occulters of other images.
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
    """The fit of one fold. kernel: the total PSF [y, x] of this fit, on the square of TotalPsf."""

    fold: Fold
    inversion: Inversion
    kernel: Kernel


@dataclass(frozen=True, eq=False)
class FoldKernels:
    """The total PSF for each image, fitted without that image. A call with the image's index returns this PSF."""

    fits: tuple[FoldInversion, ...]

    def __call__(self, index: int) -> Kernel:
        """The total PSF of the fold that holds out image `index`."""
        return next(fit.kernel for fit in self.fits if index in fit.fold.held_out)


def fold_kernels(
    transit: Transit,
    shape: Shape = SOFTENED_POWER_LAW,
    *,
    start: Vector | None = None,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> FoldKernels:
    """Fit a shape of scatter once for each fold.

    start: coordinates at which each fit starts, for example those of the fit to all images; default: shape.start. Raises
    DataError "too-few-frames" if there are too few images for two folds, and the errors of `invert`.
    """
    parts = folds(len(transit.frames))
    if not parts:
        raise DataError(
            "too-few-frames", f"expected at least 6 images for held-out folds; got {len(transit.frames)}"
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
    """Fit one fold. Raises the errors of `invert`; the message begins with the names of the held-out images."""
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
    """Progress of the fits of all folds; each fold counts equally."""

    def __init__(self, progress: Progress, number: int, of: int) -> None:
        self._progress, self._number, self._of = progress, number, of

    def __call__(self, stage: str, step: int, steps: int) -> None:
        self._progress(f"fold {self._number}: {stage}", self._number - 1, self._of)
