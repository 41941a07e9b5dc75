"""PSFs that a fitted PSF might be instead: what its covariance allows.

The sigma points of a covariance (Julier and Uhlmann 1997): two PSFs a parameter, whose mean and spread are those of
the fit. A deconvolution with each of them gives the part of its error that comes from the PSF.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from psfcore.convolution.convolver import Convolver
from psfcore.deconvolve.assess.error_planes import sigma_points
from psfcore.errors import DataError
from psfcore.psf import Psf
from psfcore.scatter.shapes import shape_named

DIFFRACTION, SCATTER = "DIFFRACTION", "SCATTER"


def possible_psfs(psf: Psf, *, threads: int = 1) -> list[Psf]:
    """The sigma points of a fitted PSF, two a parameter, on its own array and without components.

    Raises DataError "psf-not-fitted" where the PSF does not say how well it is known.
    """
    if psf.fitted is None or DIFFRACTION not in psf.components:
        raise DataError(
            "psf-not-fitted",
            f"expected a PSF fitted to a transit; {psf.name} {psf.version} has no covariance",
        )
    fitted, size = psf.fitted, psf.kernel.shape[0]
    shape = shape_named(fitted.shape)
    points = sigma_points(np.array(fitted.coordinates), np.array(fitted.covariance))
    convolver = Convolver(psf.components[DIFFRACTION], (size, size), dtype=np.float64, threads=threads)
    return [
        replace(
            psf,
            kernel=np.maximum(convolver.apply(shape.kernel(point, size)), 0.0),
            components={},
            fitted=None,
        )
        for point in points
    ]
