"""Adapts a PSF to the pixels of an image, which may be binned or a cut-out.

A binned pixel is the mean of n x n pixels. For a scene that is constant within binned pixels, the binned PSF is

    K[M] = sum over d of t(d) h[n M + d],   t(d) = (1 - |d| / n) for |d| < n       Eq. (1), on each axis

t is the convolution of two boxes of n pixels: one box is a binned pixel of the scene, the other is a binned pixel of
the image. If n is even, the centre of a box lies half a pixel beside the centre of a pixel. The two boxes are shifted
in opposite directions, so the shifts cancel, and K is centred at [size // 2, size // 2] for even and odd factors. In
other words, K is the share of a point source's light that a binned pixel of the image receives, averaged over all
positions of the source within a binned pixel of the scene. The sum of t(n M + d) over M is 1 for each d, so no light is
lost. A delta function stays a delta function.

A cut-out, or a window that starts at another pixel of the detector (PXBEG), has the same PSF as the whole image,
because one PSF is used for the whole field: only the difference of two positions matters. Near the edges of a window,
light from outside the window enters the image; no choice of the PSF can correct this.

| symbol | name | unit |
|---|---|---|
| h | kernel, centre at [size // 2, size // 2] | - |
| K | kernel for binned pixels | - |
| n | factor | px |
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.binning import binning_factor
from psfcore.fits.header import plate_scale_arcsec
from psfcore.image import Image
from psfcore.psf import PLATE_SCALE_TOLERANCE, REACH_GRID_PX, Psf, crop_centred

LARGEST_FACTOR = 64
Kernel = NDArray[np.float64]


def psf_for_image(psf: Psf, header: Header) -> Psf:
    """The PSF for the pixels of an image with this header: `psf` itself, or `psf` rebinned by `binning_factor`."""
    return rebinned(psf, binning_factor(psf, header))


def check_compatible(image: Image, psf: Psf) -> None:
    """Raise DataError "plate-scale-mismatch" if both plate scales are known and differ by more than 1 %."""
    if psf.plate_scale_arcsec is None:
        return
    for axis in (1, 2):
        scale = plate_scale_arcsec(image.header, axis)
        if scale is None:
            continue
        if abs(scale / psf.plate_scale_arcsec - 1) > PLATE_SCALE_TOLERANCE:
            wanted = f"{psf.plate_scale_arcsec:g} arcsec/px, the plate scale of PSF {psf.name}"
            raise DataError(
                "plate-scale-mismatch", f"expected {wanted}; got CDELT{axis} = {scale:g} arcsec/px"
            )


def rebinned(psf: Psf, factor: int) -> Psf:
    """Rebin the PSF and its components for pixels that are means of factor x factor pixels.

    Raises DataError "bad-binning" if the factor is out of range or larger than half the kernel.
    """
    if factor == 1:
        return psf
    smallest = min(psf.kernel.shape)
    if not 1 <= factor <= min(LARGEST_FACTOR, max(1, smallest // 2)):
        raise DataError(
            "bad-binning",
            f"expected a binning factor of 1 to {min(LARGEST_FACTOR, max(1, smallest // 2))}; got {factor}",
        )
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
    """Eq. (1) along both axes. Only weights within the full reach (in unbinned pixels) are used; their sum is unchanged."""
    inner = crop_centred(kernel, (min(kernel.shape[0], REACH_GRID_PX), min(kernel.shape[1], REACH_GRID_PX)))
    rows = _rebin_axis(inner, factor)
    return np.ascontiguousarray(_rebin_axis(rows.T, factor).T)


def _rebin_axis(kernel: Kernel, factor: int) -> Kernel:
    """Eq. (1) along the first axis: each weight is divided between the two nearest binned offsets."""
    offset = np.arange(kernel.shape[0]) - kernel.shape[0] // 2
    low, past = np.divmod(offset, factor)
    half = int(max(-low.min(), low.max() + 1))
    out = np.zeros((2 * half + 1, *kernel.shape[1:]))
    upper = (past / factor)[:, None]
    np.add.at(out, low + half, (1 - upper) * kernel)
    np.add.at(out, low + half + 1, upper * kernel)
    return out
