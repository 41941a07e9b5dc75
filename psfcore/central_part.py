"""The central part of a PSF."""

from __future__ import annotations

from dataclasses import replace

from psfcore.errors import DataError
from psfcore.psf import Psf, crop_centred


def central_part(psf: Psf, size_px: int) -> Psf:
    """The central (size_px, size_px) px of a PSF and of its components. The weights are not renormalised.

    Raises DataError "cutout-too-large" if the PSF is smaller.
    """
    smallest = min(psf.kernel.shape)
    if size_px > smallest:
        raise DataError("cutout-too-large", f"expected a size of 1 to {smallest} px; got {size_px}")
    shape = (size_px, size_px)
    return replace(
        psf,
        kernel=crop_centred(psf.kernel, shape),
        components={name: crop_centred(part, shape) for name, part in psf.components.items()},
    )
