"""The PSF that the tests of the deconvolution use: the scatter of HRI_EUV and a small core."""

from __future__ import annotations

from functools import cache

import numpy as np

from psfcore.convolution.convolver import linear_convolve
from psfcore.psf import Psf, crop_centred
from psfcore.scatter.power_law import scatter_kernel
from tests.psfcore.conftest import gaussian, make_psf


@cache
def scattering_psf(size: int = 256, core_px: float = 0.8) -> Psf:
    """41 % of the light is scattered, as in HRI_EUV; the core is a Gaussian."""
    scatter = crop_centred(scatter_kernel(6.15, 2.53, 0.411, 2048), (size, size))
    return make_psf(np.maximum(linear_convolve(scatter, gaussian(41, core_px), (size, size)), 0))
