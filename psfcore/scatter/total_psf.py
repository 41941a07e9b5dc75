"""The total PSF: the scatter kernel convolved with the diffraction PSF, and its derivatives.

Scattered light is diffracted too, so the total PSF is the convolution of the two. On the full reach, both kernels sum to
1. The sum of their convolution differs from 1 only by a small amount of light that falls beyond the grid.

The uncertainty of a fitted PSF is represented by sample PSFs: the sigma points of the covariance (Julier and Uhlmann
1997), two sets of parameters for each parameter of the fit. The sets have the same mean and the same covariance as the
fit. If an image is deconvolved with each of these PSFs, the spread of the results is the part of the image's error that
comes from the PSF.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray

from psfcore.convolution.convolver import Convolver
from psfcore.deconvolve.assess.error_planes import sigma_points
from psfcore.errors import DataError
from psfcore.psf import REACH_GRID_PX, FittedShape, Psf, encircled_energy
from psfcore.psf_sampling import psf_for_image
from psfcore.scatter.shapes import Shape, Vector, shape_named

Kernel = NDArray[np.float64]
DIFFRACTION, SCATTER = "DIFFRACTION", "SCATTER"
CURVE_RADII_PX = (0.5, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0, 300.0)


class TotalPsf:
    """Computes total PSFs that share one diffraction PSF.

    The total PSFs lie on a square whose edge is twice the longer edge of the field, at most the edge of the full reach.
    diffraction: weights [y, x], sum 1 on its own grid. field_shape: (ny, nx) of the images.
    """

    def __init__(
        self, diffraction: Kernel, shape: Shape, field_shape: tuple[int, int], *, threads: int = 1
    ) -> None:
        self.shape = shape
        self.size = min(2 * max(field_shape), REACH_GRID_PX)
        self._convolver = Convolver(diffraction, (self.size, self.size), dtype=np.float64, threads=threads)

    def kernel(self, coordinates: Vector) -> Kernel:
        """The total PSF [y, x] at these coordinates of the shape."""
        return self.diffracted(self.shape.kernel(coordinates, self.size))

    def diffracted(self, scatter: Kernel) -> Kernel:
        """A scatter kernel [y, x] on the square, convolved with the diffraction PSF."""
        return np.asarray(self._convolver.apply(scatter), dtype=np.float64)

    def slope(self, coordinates: Vector, k: int) -> Kernel:
        """The derivative of the total PSF with respect to coordinate k, [y, x]."""
        return self.diffracted(self.shape.slope(coordinates, k, self.size))

    def slopes(self, coordinates: Vector) -> list[Kernel]:
        """The derivatives of the total PSF, one array [y, x] for each coordinate."""
        return [self.slope(coordinates, k) for k in range(coordinates.size)]

    @property
    def radii_px(self) -> Vector:
        """The radii of CURVE_RADII_PX that lie on the square."""
        return np.array([r for r in CURVE_RADII_PX if r < self.size // 2])

    def curve_slopes(self, slopes: list[Kernel]) -> NDArray[np.float64]:
        """The derivatives of C(R) = 100 (1 - encircled energy), in percent: array (radii, coordinates)."""
        return np.stack([-100 * encircled_energy(slope, self.radii_px) for slope in slopes], axis=1)


def curve_sigma(slopes: Iterable[Kernel], covariance: NDArray[np.float64], radii_px: Vector) -> Vector:
    """The standard error of C(R) = 100 (1 - encircled energy) of a kernel, in percent, one for each radius (px).

    slopes: the derivatives of the kernel with respect to the coordinates. covariance: that of the coordinates.
    """
    of_curve = np.stack([-100 * encircled_energy(slope, radii_px) for slope in slopes], axis=1)
    variance = np.einsum("rk,kl,rl->r", of_curve, covariance, of_curve)
    return np.sqrt(np.maximum(variance, 0.0))


def fit_of(psf: Psf) -> FittedShape:
    """The fitted shape of a PSF. Raises DataError "psf-not-fitted" if it, or the component DIFFRACTION, is missing."""
    if psf.fitted is None or DIFFRACTION not in psf.components:
        raise DataError(
            "psf-not-fitted",
            f"expected a PSF with a fitted shape and its diffraction PSF, from a fit to a transit; got {psf.name} "
            f"{psf.version} without them: fit a PSF with `heliopsf psf fit`",
        )
    return psf.fitted


def possible_psfs(psf: Psf, *, threads: int = 1) -> list[Psf]:
    """The PSFs at the sigma points of a fit, two for each parameter. They have the shape of `psf` and no components.

    Raises DataError "psf-not-fitted".
    """
    fitted, size = fit_of(psf), psf.kernel.shape[0]
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
