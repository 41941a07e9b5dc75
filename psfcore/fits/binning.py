"""Compare the pixels of a PSF with the pixels of an image, which may be binned.

This module imports no numerical library.
"""

from __future__ import annotations

from typing import Protocol

from psfcore.errors import DataError
from psfcore.fits.cards import Cards
from psfcore.fits.header import known_instrument, plate_scale_arcsec
from psfcore.plate_scale import PLATE_SCALE_TOLERANCE


class Sampled(Protocol):
    """The properties of a PSF that are compared with an image header, to decide whether PSF and image have matching
    pixels.

    `psfcore.psf.Psf` has these properties.
    """

    @property
    def name(self) -> str: ...
    @property
    def instrument(self) -> str | None: ...
    @property
    def plate_scale_arcsec(self) -> float | None: ...


def binning_factor(psf: Sampled, header: Cards) -> int:
    """The number of PSF pixels in one image pixel, along each axis.

    The factor is 1 if the plate scales agree to 1 %, or if one of them is not known. If the plate scale of the image is
    a whole multiple of the plate scale of the PSF, the same on both axes, the factor is this multiple. This requires
    that the image is from the PSF's instrument, or that the PSF names no instrument. Otherwise the multiple may be a
    coincidence: for example, a pixel of FSI is as wide as nine pixels of HRI_EUV. Raises DataError
    "plate-scale-mismatch".
    """
    if psf.plate_scale_arcsec is None:
        return 1
    scales = [plate_scale_arcsec(header, axis) for axis in (1, 2)]
    factors = {_factor(scale / psf.plate_scale_arcsec) for scale in scales if scale is not None}
    if factors <= {1}:
        return 1
    whole = factors.pop() if len(factors) == 1 else None
    if whole is None or not _same_instrument(psf, header):
        raise _mismatch(psf, psf.plate_scale_arcsec, scales, whole)
    return whole


def _mismatch(psf: Sampled, psf_arcsec: float, scales: list[float | None], whole: int | None) -> DataError:
    """The error for pixels of another size. whole: the factor by which the PSF must be rebinned; None: no factor
    fits."""
    found = " x ".join("unknown" if scale is None else f"{scale:g}" for scale in scales)
    advice = (
        "use a PSF of the image's pixels"
        if whole is None
        else f"rebin the PSF with `heliopsf psf rebin PSF --factor {whole} -o FILE`, and use FILE as the PSF"
    )
    return DataError(
        "plate-scale-mismatch",
        f"expected {psf_arcsec:g} arcsec/px, the plate scale of PSF {psf.name}, or binned images of its instrument; got "
        f"CDELT1 x CDELT2 = {found} arcsec/px: {advice}",
        {"psf": psf.name, "psf_arcsec": psf_arcsec, "image_arcsec": found, "factor": whole},
    )


def _same_instrument(psf: Sampled, header: Cards) -> bool:
    return psf.instrument is None or known_instrument(header) == psf.instrument


def _factor(ratio: float) -> int | None:
    """The whole number that agrees with the ratio of two plate scales to 1 %; None if there is no such number."""
    whole = round(ratio)
    return whole if whole >= 1 and abs(ratio / whole - 1) <= PLATE_SCALE_TOLERANCE else None
