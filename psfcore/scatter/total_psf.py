"""The total PSF, its derivatives, and its effect on one field: convolution, inverse, and the noise that passes through
both.

Scattered light is diffracted too, so the total PSF is the convolution of the two. On the full reach, both kernels sum
to
1. The sum of their convolution differs from 1 only by a small amount of light that falls beyond the grid.

The uncertainty of a fitted PSF is represented by sample PSFs: the sigma points of the covariance (Julier and Uhlmann
1997), two sets of parameters for each parameter of the fit. The sets have the same mean and the same covariance as the
fit. If an image is deconvolved with each of these PSFs, the spread of the results is the part of the image's error that
comes from the PSF.

On one field of pixels, the convolution H with a PSF has an inverse, and the inverse a derivative:

    inverse:     x <- x + G (y - H x)                       Eq. (1)
    derivative:  d x / d q = -G (dH / dq) x                 Eq. (2)

G is the inverse of the convolution on a periodic plane. The core of HRI_EUV's PSF contains 0.43 of the light, so
Eq. (1) converges in about five steps. Eq. (1) is linear and does not bias faint pixels, unlike Richardson-Lucy. Between
steps, fields stay in the memory order of the convolution engine (its "lanes"). Functions below read and write single
pixels in this order.

A frame y = H x + n has fully dark pixels D. The scene is estimated as G y, and its fully dark pixels are set to 0. The
residual in the disc is then r = D [y - H (1 - D) G y]. The sum of the residual weighted by a template t is

    t . r = b . n + (t . r without noise),   b = t - G^T (1 - D) H^T t                Eq. (3)
    cov(t_1 . r, t_2 . r) = sum over all pixels of b_1 b_2 var(n)                     Eq. (4)

If the PSF changes, the expected light P H x in dark pixels P of a scene x that is 0 there changes as

    P [1 - H (1 - P) G] (dH / dq) x                                                   Eq. (5)

The second term of Eq. (5) is the change of the estimated scene, by Eq. (2).

The first term of b describes the noise of the disc's pixels. The second term describes the noise of the estimated
scene, which the model scatters into the disc.

| symbol | name |
|---|---|
| H, H^T | Blur.convolve, Blur.correlate |
| G, G^T | Optics.invert_once |
| x, y | scene and observation, both as lanes |
| q | a parameter of the PSF |
| t | template: a weight for each dark pixel |
| n | photon and read noise, DN/s |
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Self

import numpy as np
from astropy.io.fits import Header
from numpy.typing import NDArray

from psfcore.arrays import Kernel, Matrix, Vector
from psfcore.convolution.convolver import Convolver
from psfcore.convolution.engine import Engine, aligned
from psfcore.convolution.kernels import BLOCK_ROWS
from psfcore.convolution.lengths import LANES
from psfcore.deconvolve.assess.error_planes import sigma_points
from psfcore.deconvolve.conditions import new_engine
from psfcore.deconvolve.iterations.linear import (
    LEAST_TRANSFER,
    inverse_filter,
    solve_linear,
    transfer_sample,
)
from psfcore.errors import DataError
from psfcore.noise import Noise
from psfcore.psf import CURVE_RADII_PX, REACH_GRID_PX, FittedShape, Psf, encircled_energy
from psfcore.psf_sampling import psf_for_image
from psfcore.scatter.shapes import Shape, shape_named
from psfcore.transit.transit import Frame, Place

DIFFRACTION, SCATTER = "DIFFRACTION", "SCATTER"
Lanes = NDArray[np.float32]
Pixels = tuple[NDArray[np.intp], NDArray[np.intp]]  # (rows, columns) of single pixels
STEPS = 5
# A step that changes a scene by less than this fraction (rms) leaves an error about fifty times smaller, which is the
# rounding of float32 in the dark pixels. This holds for a PSF with at least LEAST_TRANSFER at all frequencies.
SETTLED = 1e-3
# Noise beyond this distance from a disc adds less than 1e-5 to the variance of sums over the disc.
NOISE_REACH_PX = 200
BLOCK_PX = 2**18  # of sums over all pixels: arrays of this size need little memory


class TotalPsf:
    """Computes total PSFs that share one diffraction PSF.

    The total PSFs lie on a square whose edge is twice the longer edge of the field, at most the edge of the full reach.

    Parameters
    ----------
    diffraction
        Weights [y, x] of the diffraction PSF, sum 1 on their own grid.
    field_shape
        Shape (ny, nx) of the images.
    """

    def __init__(
        self, diffraction: Kernel, shape: Shape, field_shape: tuple[int, int], *, threads: int = 1
    ) -> None:
        self.shape = shape
        self.size = min(2 * max(field_shape), REACH_GRID_PX)
        self._convolver = Convolver(diffraction, (self.size, self.size), dtype=np.float64, threads=threads)

    def of(self, shape: Shape) -> TotalPsf:
        """The same computation for another shape."""
        other = copy.copy(self)
        other.shape = shape
        return other

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

    def curve_slopes(self, slopes: list[Kernel]) -> Matrix:
        """The derivatives of C(R) = 100 (1 - encircled energy), in percent: array (radii, coordinates)."""
        of_curve = np.empty((self.radii_px.size, len(slopes)))
        for column, slope in zip(of_curve.T, slopes, strict=True):
            column[:] = -100 * encircled_energy(slope, self.radii_px)
        return of_curve


def curve_sigma(slopes: Iterable[Kernel], covariance: Matrix, radii_px: Vector) -> Vector:
    """The standard error of C(R) = 100 (1 - encircled energy) of a kernel, in percent, one for each radius (px).

    Parameters
    ----------
    slopes
        The derivatives of the kernel with respect to the coordinates.
    covariance
        Covariance matrix of the coordinates.
    """
    of_curve = np.stack([-100 * encircled_energy(slope, radii_px) for slope in slopes], axis=1)
    variance = np.einsum("rk,kl,rl->r", of_curve, covariance, of_curve)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


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
    """The PSFs of `possible_psfs` on the pixels of an image; empty if the errors of the PSF are not known, as those of
    the terms of a PSF that changes over the field.
    """
    if psf.fitted is None or psf.field_terms:
        return []
    return [psf_for_image(one, header) for one in possible_psfs(psf, threads=threads)]


class Blur:
    """Convolution with a kernel on one field, in float32; the result is cropped to the field.

    The scene is assumed dark beyond the edges of the field.

    Parameters
    ----------
    kernel
        Values [y, x] of any sign, centre at [n // 2, n // 2]; or a PSF on the pixels of the field, which may change
        over the field.
    """

    def __init__(self, kernel: Kernel | Psf, field_shape: tuple[int, int], *, threads: int = 1) -> None:
        self.engine = (
            new_engine(kernel, field_shape, field_shape, threads)
            if isinstance(kernel, Psf)
            else Engine(kernel, field_shape, threads=threads)
        )
        self._partly_filled = field_shape[0] % BLOCK_ROWS != 0

    def twins(self) -> list[Self]:
        """The same operator for each thread, see `Engine.twin`."""
        if self.engine.threads == 1:
            return [self]
        twins = [copy.copy(self) for _ in range(self.engine.threads)]
        for twin in twins:
            twin.engine = self.engine.twin()
        return twins

    def lanes(self, field: NDArray[np.floating], *, out: Lanes | None = None) -> Lanes:
        """A field [y, x] rearranged into the engine's order, in `out` if it is given."""
        return self.engine.to_lanes(field, out=out)

    def field(self, lanes: Lanes) -> NDArray[np.float32]:
        """The field [y, x], rearranged from the engine's order."""
        return self.engine.from_lanes(lanes)

    def convolve(self, lanes: Lanes) -> Lanes:
        """H x: the field convolved with the kernel."""
        return self._through(lanes, partial(self.engine.columns, adjoint=False))

    def correlate(self, lanes: Lanes) -> Lanes:
        """H^T y: the field correlated with the kernel. This is the adjoint of `convolve`."""
        return self._through(lanes, partial(self.engine.columns, adjoint=True))

    def _through(self, lanes: Lanes, columns: Callable[[], None]) -> Lanes:
        self.engine.rows_forward(lanes)
        columns()
        return self._rows(0, self.engine.row_blocks)

    def _rows(self, first: int, stop: int) -> Lanes:
        """The field that the engine's spectrum contains, or some of its blocks of rows."""
        out = np.empty((stop - first, *self.engine.lanes_shape[1:]), np.float32)
        self.engine.rows_inverse(out, first)
        if self._partly_filled and stop == self.engine.row_blocks:
            # The last block also contains rows beyond the field; the field is dark there.
            rows = self.engine.field_shape[0] % BLOCK_ROWS
            out[-1, :, 0, min(rows, LANES) :] = 0.0
            out[-1, :, 1, max(rows - LANES, 0) :] = 0.0
        return out


class Optics(Blur):
    """Convolution with a PSF, and its approximate inverse.

    Eq. (1) converges at once at the frequencies where the absolute value of the PSF's Fourier transform is at least
    LEAST_TRANSFER of `psfcore.deconvolve.iterations.linear`, and slowly at the others.

    Attributes
    ----------
    least_transfer
        The smallest absolute value of the PSF's Fourier transform.
    """

    def __init__(self, psf_kernel: Kernel | Psf, field_shape: tuple[int, int], *, threads: int = 1) -> None:
        super().__init__(psf_kernel, field_shape, threads=threads)
        self._inverse = inverse_filter(self.engine)
        self._fields: tuple[Lanes, Lanes] | None = None
        self.least_transfer = float(np.abs(transfer_sample(self.engine).values).min())

    def twins(self) -> list[Self]:
        """The same operator for each thread, each with its own working memory."""
        twins = super().twins()
        if len(twins) > 1:
            for twin in twins:
                twin._fields = None
                _ = twin.fields
        return twins

    @property
    def fields(self) -> tuple[Lanes, Lanes]:
        """Working memory for two fields; it is kept, because memory that is taken for every image is left in pieces."""
        if self._fields is None:
            self._fields = aligned(*self.engine.lanes_shape), aligned(*self.engine.lanes_shape)
        return self._fields

    def invert_once(self, lanes: Lanes, *, adjoint: bool = False) -> Lanes:
        """G y, or G^T y if `adjoint`."""
        return self._through(lanes, partial(self.engine.multiply_columns, self._inverse, conjugate=adjoint))

    def invert(self, observed: Lanes, start: Lanes | None = None, *, steps: int = STEPS) -> Lanes:
        """The scene x of an observation, from `steps` iterations of Eq. (1).

        Parameters
        ----------
        start
            First estimate, which is overwritten; default: the observation.
        """
        first = observed.copy() if start is None else start
        settled = SETTLED if self.least_transfer >= LEAST_TRANSFER else 0.0
        return solve_linear(self.engine, self._inverse, observed, first, steps, settled=settled)  # Eq. (1)

    def light_in(self, pixels: Pixels, scene: Lanes, slopes: Sequence[Blur] = ()) -> tuple[Vector, Matrix]:
        """The light that a scene scatters into single pixels, and how it changes with the PSF, Eq. (5).

        The result is that of `convolve` and `invert_once` one after the other, but the scene is transformed only once,
        and fields are not written to memory. The derivatives have the shape (slopes, pixels).

        Parameters
        ----------
        scene
            The scene; it is 0 in the pixels.
        slopes
            Derivatives of the PSF, on an array of its size and for fields of the same shape.
        """
        engine = self.engine
        if any(slope.engine.transfer.shape[:2] != engine.transfer.shape[:2] for slope in slopes):
            raise ValueError("expected derivatives for the same fields, on an array of the size of the PSF")
        blocks = pixels[0] // BLOCK_ROWS
        first, stop = (int(blocks.min()), int(blocks.max()) + 1) if blocks.size else (0, 1)
        here = pixels[0] - first * BLOCK_ROWS, pixels[1]
        engine.rows_forward(scene)
        engine.transform_columns()
        engine.multiply_kept(engine.transfer)
        light = pick(self._rows(first, stop), here)
        responses = np.empty((len(slopes), light.size))
        for k, slope in enumerate(slopes):
            engine.multiply_kept(slope.engine.transfer)
            changed = pick(self._rows(first, stop), here)
            engine.rows_cut()
            engine.multiply_columns(self._inverse)
            around = self._rows(first, stop)
            put(around, here, 0.0)
            engine.rows_cut()
            engine.rows_forward(around, first)
            engine.multiply_columns(engine.transfer)
            responses[k] = changed - pick(self._rows(first, stop), here)
        return light, responses


def pick(lanes: Lanes, pixels: Pixels) -> Vector:
    """Read single pixels (rows, columns) from lanes."""
    return np.asarray(lanes[_index(pixels)], dtype=np.float64)


def put(lanes: Lanes, pixels: Pixels, values: NDArray[np.floating] | float) -> None:
    """Set single pixels (rows, columns) in lanes."""
    lanes[_index(pixels)] = values


def _index(pixels: Pixels) -> tuple[NDArray[np.intp], ...]:
    rows, columns = pixels
    return rows // BLOCK_ROWS, columns, rows % BLOCK_ROWS // LANES, rows % LANES


def around_disc(frame: Frame, dark: Pixels, shape: tuple[int, int]) -> tuple[Frame, Pixels]:
    """The part of a frame around its dark pixels, inside the field; also these pixels in this part.

    Parameters
    ----------
    shape
        Shape (ny, nx) of the part, at most that of the frame.
    """
    y, x = (
        int(np.clip(round(float(of_axis.mean())) - size // 2, 0, whole - size))
        for of_axis, size, whole in zip(dark, shape, frame.pixels.shape, strict=True)
    )
    place = Place(frame.place.x_px - x, frame.place.y_px - y, frame.place.radius_px)
    pixels = frame.pixels[y : y + shape[0], x : x + shape[1]]
    return replace(frame, pixels=pixels, place=place, filled=None), (dark[0] - y, dark[1] - x)


def noise_covariance(
    optics: Optics, frame: Frame, dark: Pixels, templates: Sequence[Vector], noise: Noise
) -> Matrix:
    """Eq. (4): covariance (templates, templates) of the weighted sums over the dark pixels, in (DN/s)^2."""
    b = np.empty((len(templates), frame.pixels.size), dtype=np.float32)
    for row, template in zip(b, templates, strict=True):
        here = np.zeros(optics.engine.lanes_shape, np.float32)
        put(here, dark, template)
        scattered = optics.correlate(here)
        put(scattered, dark, 0.0)
        here -= optics.invert_once(scattered, adjoint=True)  # Eq. (3)
        row[:] = optics.field(here).ravel()
    covariance = np.zeros((len(templates), len(templates)))
    observed = frame.pixels.ravel()
    for first in range(0, observed.size, BLOCK_PX):
        part = b[:, first : first + BLOCK_PX]
        # The variance is a linear function of the expected pixel value. The observed value can replace the expected
        # value here, because the noise of the observed values averages out in the sum over the pixels.
        variance = noise.variance(observed[first : first + BLOCK_PX].astype(np.float64), frame.exposure_s)
        covariance += (part * variance.astype(np.float32)) @ part.T  # Eq. (4)
    return covariance
