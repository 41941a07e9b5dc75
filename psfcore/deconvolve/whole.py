"""The computations of a deconvolution: the estimate, its errors, the measured changes, and the quality plane."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from psfcore.deconvolve.assess.changes import Changes, measure_changes
from psfcore.deconvolve.assess.quality import quality_plane
from psfcore.deconvolve.conditions import Conditions, Deconvolved, Progress
from psfcore.deconvolve.methods.registry import method_named
from psfcore.image import Image
from psfcore.psf import Psf

if TYPE_CHECKING:
    from psfcore.deconvolve.assess.error_planes import ErrorPlanes

ERROR_ESTIMATE = "error estimate"  # a stage whose steps are noise realisations


@dataclass(frozen=True)
class Assessed:
    """The measured changes of a deconvolution, and the quality plane [y, x] (bits of `QualityBit`)."""

    found: Changes
    quality: NDArray[np.uint8]


@dataclass(frozen=True)
class Work:
    """One deconvolution of one image.

    The method runs for the image. If errors are requested, it runs again for each noise realisation and for each
    variant of the PSF within its errors.

    psf: the PSF on the image's pixels. method: the name of a method. parameters: the parameters of this method.
    """

    image: Image
    psf: Psf
    method: str
    conditions: Conditions
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def run(
        self, image: Image | None = None, psf: Psf | None = None, progress: Progress | None = None
    ) -> Deconvolved:
        """Run the method. image: replaces `self.image`; it must have the same shape. psf: replaces `self.psf`."""
        conditions = replace(self.conditions, progress=progress)
        return method_named(self.method)(image or self.image, psf or self.psf, conditions, **self.parameters)

    def errors(
        self,
        result: Deconvolved,
        draws: int,
        *,
        possible_psfs: Callable[[], Sequence[Psf]] = lambda: (),
        begin: Callable[[str, int], Progress | None] = lambda stage, steps: None,
    ) -> ErrorPlanes:
        """The error planes from `draws` noise realisations (2 or more). The conditions contain the noise.

        possible_psfs: function that returns variants of the PSF within its errors, on the image's pixels. It returns no
        PSF if the errors are not known. begin(stage, steps) is called when a stage begins, and returns the progress
        function of the stage.
        """
        noise = self.conditions.noise
        assert noise is not None
        # Most deconvolutions compute no errors, and do not load SciPy.
        from psfcore.deconvolve.assess.error_planes import error_planes, psf_error_plane, with_psf_error

        told = begin(ERROR_ESTIMATE, draws)
        planes = error_planes(
            self.image,
            self.psf,
            lambda image: self.run(image).pixels,
            noise,
            estimate=result.pixels,
            draws=draws,
            edge_px=result.edge_band_px,
            threads=self.conditions.threads,
            # The first run deconvolves the model image without noise.
            progress=None if told is None else lambda done, of: told(done - 1, of - 1),
        )
        psfs = possible_psfs()
        if not psfs:
            return planes
        from_psf = psf_error_plane(
            psfs,
            lambda psf: self.run(psf=psf).pixels,
            chance=False,
            progress=begin("errors of the PSF", len(psfs)),
        )
        return with_psf_error(planes, from_psf)

    def assess(self, result: Deconvolved, errors: ErrorPlanes | None) -> Assessed:
        """Measure the changes, and make the quality plane."""
        edge_px = counted_edge_px(result)
        found = measure_changes(
            self.image,
            result.pixels,
            self.psf,
            noise=self.conditions.noise,
            edge_px=edge_px,
            threads=self.conditions.threads,
        )
        quality = quality_plane(
            self.image,
            result.pixels,
            edge_px=edge_px,
            suspected=found.artefacts.suspected,
            error=None if errors is None else errors.error,
        )
        return Assessed(found, quality)


def counted_edge_px(result: Deconvolved) -> int:
    """The width of the edge band that is marked: at most a quarter of the shorter side."""
    return min(result.edge_band_px, min(result.pixels.shape) // 4)
