"""Sample PSFs that represent the uncertainty of a fitted PSF.

The samples are the sigma points of the covariance (Julier and Uhlmann 1997): two sets of parameters for each parameter
of the fit. The sets have the same mean and the same covariance as the fit. If an image is deconvolved
with each of these PSFs, the results differ. Their spread is the part of the image's error that comes from the PSF.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from astropy.io.fits import Header

from psfcore.convolution.convolver import Convolver
from psfcore.deconvolve.assess.error_planes import sigma_points
from psfcore.errors import DataError
from psfcore.psf import Psf
from psfcore.psf_sampling import psf_for_image
from psfcore.scatter.shapes import shape_named

DIFFRACTION, SCATTER = "DIFFRACTION", "SCATTER"


def possible_psfs(psf: Psf, *, threads: int = 1) -> list[Psf]:
    """The PSFs at the sigma points of a fit, two for each parameter. They have the shape of `psf` and no components.

    Raises DataError "psf-not-fitted" if the PSF has no covariance.
    """
    if psf.fitted is None or DIFFRACTION not in psf.components:
        raise DataError(
            "psf-not-fitted",
            f"expected a PSF with a covariance from a fit to a transit; got {psf.name} {psf.version} without one",
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


def possible_on_pixels(psf: Psf, header: Header, *, threads: int = 1) -> list[Psf]:
    """The PSFs of `possible_psfs` on the pixels of an image; empty if the errors of the PSF are not known."""
    if psf.fitted is None:
        return []
    return [psf_for_image(one, header) for one in possible_psfs(psf, threads=threads)]
