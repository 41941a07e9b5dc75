"""A deconvolution of an image and its computations: the estimate, its errors, the measured changes, and the quality plane."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from inspect import signature
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from psfcore.deconvolve.assess.changes import Changes, measure_changes
from psfcore.deconvolve.assess.quality import quality_plane
from psfcore.deconvolve.box import LARGEST_ERROR, Box, region_without_errors
from psfcore.deconvolve.conditions import Conditions, Deconvolved, Progress
from psfcore.deconvolve.methods.registry import method_named
from psfcore.errors import DataError
from psfcore.image import Image
from psfcore.psf import Psf

if TYPE_CHECKING:
    from psfcore.deconvolve.assess.error_planes import ErrorPlanes

ERROR_ESTIMATE = "error estimate"  # a stage whose steps are noise realisations
MOST_DRAWS = 64


@dataclass(frozen=True)
class Options(Conditions):
    """How an image is deconvolved.

    method: name of the method; parameters: its own parameters, such as steps and stop. error_draws: number of noise
    realisations (2 to 64) for the planes of errors; 0: no such planes. region: deconvolve only this box of the image, with a
    rim that is so wide that the bound of its error is at most `region_error`, a share of the mean light of the box.
    Raises DataError "bad-draws", "bad-margin", "region-errors", "unknown-method" and "unknown-parameter".
    """

    method: str = "richardson-lucy"
    parameters: Mapping[str, Any] = field(default_factory=dict)
    error_draws: int = 0
    region: Box | None = None
    region_error: float = LARGEST_ERROR

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.region is not None and self.error_draws:
            raise region_without_errors(self.error_draws)
        if self.error_draws and not 2 <= self.error_draws <= MOST_DRAWS:
            raise DataError(
                "bad-draws", f"error_draws: expected 0, or 2 to {MOST_DRAWS}; got {self.error_draws}"
            )
        of_method = signature(method_named(self.method)).parameters.values()
        names = [one.name for one in of_method if one.kind is one.KEYWORD_ONLY]
        for name in self.parameters:
            if name not in names:
                raise DataError(
                    "unknown-parameter",
                    f"expected parameters of {self.method}, {', '.join(names)}; got {name!r}",
                )


@dataclass(frozen=True)
class Assessed:
    """The measured changes of a deconvolution, and the quality plane [y, x] (bits of `QualityBit`)."""

    changes: Changes
    quality: NDArray[np.uint8]


@dataclass(frozen=True)
class Work:
    """One deconvolution of one image.

    The method runs for the image. If errors are requested, it runs again for each noise realisation and for each
    variant of the PSF within its errors.

    psf: the PSF on the image's pixels.
    """

    image: Image
    psf: Psf
    options: Options

    def run(
        self, image: Image | None = None, psf: Psf | None = None, progress: Progress | None = None
    ) -> Deconvolved:
        """Run the method. image: replaces `self.image`; it must have the same shape. psf: replaces `self.psf`."""
        options = replace(self.options, progress=progress)
        return method_named(options.method)(
            image or self.image, psf or self.psf, options, **options.parameters
        )

    def errors(
        self,
        result: Deconvolved,
        *,
        possible_psfs: Callable[[], Sequence[Psf]] = lambda: (),
        begin: Callable[[str, int], Progress | None] = lambda stage, steps: None,
    ) -> ErrorPlanes:
        """The error planes. The options contain the number of noise realisations and the noise.

        possible_psfs: function that returns variants of the PSF within its errors, on the image's pixels. It returns no
        PSF if the errors are not known. begin(stage, steps) is called when a stage begins, and returns the progress
        function of the stage.
        """
        noise, draws = self.options.noise, self.options.error_draws
        assert noise is not None
        # Most deconvolutions compute no errors, and do not load SciPy.
        from psfcore.deconvolve.assess.error_planes import error_planes, spread_of_results

        progress = begin(ERROR_ESTIMATE, draws)
        planes = error_planes(
            self.image,
            self.psf,
            lambda image: self.run(image).pixels,
            noise,
            estimate=result.pixels,
            draws=draws,
            edge_px=result.edge_band_px,
            threads=self.options.threads,
            # The first run deconvolves the model image without noise.
            progress=None if progress is None else lambda done, of: progress(done - 1, of - 1),
        )
        psfs = possible_psfs()
        if not psfs:
            return planes
        spread = spread_of_results(
            psfs, lambda psf: self.run(psf=psf).pixels, progress=begin("errors of the PSF", len(psfs))
        )
        return replace(planes, psf_error=np.where(np.isnan(planes.error), np.nan, spread))

    def assess(self, result: Deconvolved, errors: ErrorPlanes | None) -> Assessed:
        """Measure the changes, and make the quality plane."""
        # At most a quarter of the shorter side is marked as an edge.
        edge_px = min(result.edge_band_px, min(result.pixels.shape) // 4)
        changes = measure_changes(
            self.image,
            result.pixels,
            self.psf,
            noise=self.options.noise,
            edge_px=edge_px,
            threads=self.options.threads,
        )
        quality = quality_plane(
            self.image,
            result.pixels,
            edge_px=edge_px,
            suspected=changes.artefacts.suspected,
            error=None if errors is None else errors.error,
        )
        return Assessed(changes, quality)
