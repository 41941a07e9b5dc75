"""A PSF on the pixels that an image has: binned, cut out, or as it is.

A binned pixel is the mean of n x n pixels. A scene that is constant within binned pixels is seen by them through

    K[M] = sum over d of t(d) h[n M + d],   t(d) = (1 - |d| / n) for |d| < n       Eq. (1), on each axis

t is the box of the pixel that is seen convolved with the box of the pixel that sees. Both have n pixels, so their
shifts by half a pixel for even n cancel: K is centred at [n // 2, n // 2] for even and odd factors alike, and it
is h, box-averaged, at the mean of all the phases that a source can have within a binned pixel. The t(n M + d)
sum to 1 over M: no light is lost. A delta stays a delta.

A cut-out, or a window that starts elsewhere on the detector (PXBEG), is seen through the same PSF: with one PSF
for the whole field only the difference of two positions counts. What a window changes is its edge, whose
neighbourhood gets light from scenes that are not in the image; no choice of PSF makes up for that.

| symbol | name | unit |
|---|---|---|
| h | kernel, centre at [size // 2, size // 2] | - |
| K | the kernel of a binned pixel | - |
| n | factor | px |
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.header import optional_text, plate_scale_arcsec
from psfcore.image import Image
from psfcore.instruments.files import match_instrument
from psfcore.psf import PLATE_SCALE_TOLERANCE, REACH_GRID_PX, Psf, crop_centred

LARGEST_FACTOR = 64
Kernel = NDArray[np.float64]


def psf_for_image(psf: Psf, header: Header) -> Psf:
    """The PSF on the pixels of an image with this header: `psf` itself, or rebinned by its `binning_factor`."""
    return rebinned(psf, binning_factor(psf, header))


def check_compatible(image: Image, psf: Psf) -> None:
    """Raise DataError "plate-scale-mismatch" when the scales are known and differ by over 1 %."""
    if psf.plate_scale_arcsec is None:
        return
    for axis in (1, 2):
        scale = plate_scale_arcsec(image.header, axis)
        if scale is None:
            continue
        if abs(scale / psf.plate_scale_arcsec - 1) > PLATE_SCALE_TOLERANCE:
            wanted = f"{psf.plate_scale_arcsec:g} arcsec/px as PSF {psf.name} has it"
            raise DataError(
                "plate-scale-mismatch", f"expected {wanted}; got CDELT{axis} = {scale:g} arcsec/px"
            )


def binning_factor(psf: Psf, header: Header) -> int:
    """How many of the PSF's pixels a pixel of an image with this header has, on each axis.

    Same scale to 1 %, or a scale that is not known: 1. A whole multiple on both axes: that,
    where the image is of the PSF's own instrument or the PSF names none: another telescope's pixels may be a
    multiple by chance (an FSI pixel is nine of HRI_EUV's). Raises DataError "plate-scale-mismatch".
    """
    if psf.plate_scale_arcsec is None:
        return 1
    scales = [plate_scale_arcsec(header, axis) for axis in (1, 2)]
    factors = {_factor(scale / psf.plate_scale_arcsec) for scale in scales if scale is not None}
    if factors <= {1}:
        return 1
    if len(factors) > 1 or None in factors or not _same_instrument(psf, header):
        found = " x ".join("unknown" if scale is None else f"{scale:g}" for scale in scales)
        wanted = f"{psf.plate_scale_arcsec:g} arcsec/px as PSF {psf.name} has it, or its own images binned"
        raise DataError("plate-scale-mismatch", f"expected {wanted}; got CDELT1 x CDELT2 = {found} arcsec/px")
    return factors.pop() or 1


def _same_instrument(psf: Psf, header: Header) -> bool:
    cards = {key: optional_text(header, key) for key in ("TELESCOP", "INSTRUME", "DETECTOR")}
    return psf.instrument is None or match_instrument(cards) == psf.instrument


def rebinned(psf: Psf, factor: int) -> Psf:
    """The PSF of pixels that are means of factor x factor pixels, with its components.

    Raises DataError "bad-binning" for a factor out of range or larger than the kernel's half.
    """
    if factor == 1:
        return psf
    smallest = min(psf.kernel.shape)
    if not 1 <= factor <= min(LARGEST_FACTOR, max(1, smallest // 2)):
        raise DataError("bad-binning", f"expected a factor of 1 to {LARGEST_FACTOR}; got {factor}")
    scale = psf.plate_scale_arcsec
    return replace(
        psf,
        kernel=rebinned_kernel(psf.kernel, factor),
        version=f"{psf.version}+bin{factor}",
        plate_scale_arcsec=None if scale is None else scale * factor,
        components={name: rebinned_kernel(part, factor) for name, part in psf.components.items()},
        provenance={**psf.provenance, "binning": factor},
    )


def rebinned_kernel(kernel: Kernel, factor: int) -> Kernel:
    """Eq. (1), on both axes; keeps the sum within the full reach, which is measured in unbinned pixels."""
    inner = crop_centred(kernel, (min(kernel.shape[0], REACH_GRID_PX), min(kernel.shape[1], REACH_GRID_PX)))
    rows = _rebin_axis(inner, factor)
    return np.ascontiguousarray(_rebin_axis(rows.T, factor).T)


def _rebin_axis(kernel: Kernel, factor: int) -> Kernel:
    """Eq. (1) along the first axis: each weight is shared by the two binned offsets that it lies between."""
    offset = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
    low, past = np.divmod(offset, factor)
    half = int(max(-low.min(), low.max() + 1))
    out = np.zeros((2 * half + 1, *kernel.shape[1:]))
    upper = (past / factor)[:, None]
    np.add.at(out, low + half, (1 - upper) * kernel)
    np.add.at(out, low + half + 1, upper * kernel)
    return out


def _factor(ratio: float) -> int | None:
    """The whole number that the ratio of two scales is to 1 %, or None."""
    whole = round(ratio)
    return whole if whole >= 1 and abs(ratio / whole - 1) <= PLATE_SCALE_TOLERANCE else None
