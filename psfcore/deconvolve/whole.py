"""A whole deconvolution: the estimate, its errors, the measured changes, and the quality plane.

The service and the Python functions both run `Work`, so that they give the same result for the same image and PSF.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray

from psfcore.deconvolve.assess.changes import Changes, measure_changes
from psfcore.deconvolve.assess.quality import quality_plane
from psfcore.deconvolve.conditions import Conditions, Progress
from psfcore.deconvolve.methods.registry import may_be_negative, method_named, method_names
from psfcore.deconvolve.result import Deconvolved
from psfcore.fits.channel import check_channel
from psfcore.fits.doubts import doubts
from psfcore.fits.gain import no_noise_figures, noise_for
from psfcore.image import Image
from psfcore.instruments.model import load_instrument
from psfcore.noise import Noise
from psfcore.psf import Psf
from psfcore.psf_sampling import frame_warnings

if TYPE_CHECKING:
    from psfcore.deconvolve.assess.error_planes import ErrorPlanes

LARGEST_CLIPPED = 0.01  # share of the light of an image; a product's total is accurate to about this share
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
    ) -> ErrorPlanes | None:
        """The error planes from `draws` noise realisations; None for 0 realisations.

        possible_psfs: function that returns variants of the PSF within its errors, on the image's pixels. It returns no
        PSF if the errors are not known. begin(stage, steps) is called when a stage begins, and returns the progress
        function of the stage. Raises DataError "no-noise-figures".
        """
        if not draws:
            return None
        noise = self.conditions.noise
        if noise is None:
            raise no_noise_figures()
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


def input_warnings(psf: Psf, image: Image, method: str | None, *, other_channel: bool) -> dict[str, str]:
    """Warnings about the inputs: sentences by their codes, the most harmful first.

    method: the method of the deconvolution; None: none was chosen yet. other_channel: whether the PSF may be of another
    channel than the image. If it is of another channel and this is not allowed, raises DataError "channel-mismatch".
    """
    channel = check_channel(psf, image.header, other_channel=other_channel)
    warnings = frame_warnings(psf, image.header)
    warnings |= {} if channel is None else {"channel": channel}
    warnings |= image.warnings
    if image.saturation is not None and image.saturation.warning is not None:
        warnings["saturation"] = image.saturation.warning
    if method is not None:
        warnings |= {} if may_be_negative(method) else _negative_warning(image)
        warnings |= doubts(image, psf.kernel)
    return warnings


def _negative_warning(image: Image) -> dict[str, str]:
    """The warning if a method that counts negative pixels as 0 adds more than LARGEST_CLIPPED to the light of the image."""
    light = float(image.pixels.sum(where=image.valid))
    clipped = -float(image.pixels.sum(where=image.valid & (image.pixels < 0)))
    if clipped <= LARGEST_CLIPPED * abs(light):
        return {}
    share = f"{100 * clipped / abs(light):.3g} % of the light" if light else "all of the light"
    kept = ", ".join(name for name in method_names() if may_be_negative(name))
    return {
        "negative-pixels": f"negative pixels count as 0, which adds {share}: use a method that keeps them ({kept})"
    }


def known_noise(instrument: str | None, header: Header) -> Noise | None:
    """The noise figures that the file of a shipped instrument gives for the gain mode of an image; None if unknown."""
    return None if instrument is None else noise_for(load_instrument(instrument), header)
