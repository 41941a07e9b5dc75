"""What the tests of the deconvolution share: a PSF with the scatter of HRI_EUV, and the published method."""

from __future__ import annotations

from functools import cache

import numpy as np

from psfcore.convolution.convolver import linear_convolve
from psfcore.deconvolve.conditions import Conditions, Deconvolved, Progress
from psfcore.deconvolve.declaration import Edges
from psfcore.deconvolve.methods.registry import method_named
from psfcore.image import Image
from psfcore.psf import Psf, crop_centred
from psfcore.scatter.power_law import scatter_kernel
from tests.psfcore.conftest import gaussian, make_psf


@cache
def scattering_psf(size: int = 256, core_px: float = 0.8) -> Psf:
    """41 % of the light is scattered, as in HRI_EUV; the core is a Gaussian."""
    scatter = crop_centred(scatter_kernel(6.15, 2.53, 0.411, 2048), (size, size))
    return make_psf(np.maximum(linear_convolve(scatter, gaussian(41, core_px), (size, size)), 0))


def richardson_lucy(
    image: Image,
    psf: Psf,
    *,
    steps: int = 20,
    threads: int = 1,
    progress: Progress | None = None,
    edges: Edges = "zero",
) -> Deconvolved:
    """The published method: a fixed number of steps, and a scene that is zero beyond the field."""
    conditions = Conditions(edges=edges, threads=threads, progress=progress)
    return method_named("richardson-lucy")(image, psf, conditions, steps=steps)
