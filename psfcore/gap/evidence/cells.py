"""The cells of a disc: mean residuals in sectors of rings, and their response to any change of the image.

Let y be an image and D the mask of its fully dark pixels. H is the PSF, and G is the inverse of H on the periodic
plane. The reconstructed scene is x = (2 - G H) G y. The residual in the disc is r = D [y - H (1 - D) x]. A cell is a
sector of a ring of the disc. The mean of r over a cell is a linear function of the whole image. The adjoint of H and G
gives the weights q of this function in one pass:

    a . r = q . y,   q = a - (2 - G^T H^T) G^T (1 - D) H^T a        Eq. (1)

An effect that changes the image by e therefore changes the cell by q . e, a sum over pixels. If e is an error of the
gain that is the same for all pixels, q . e is close to 0. The noise of a cell has two parts: the noise of the disc
itself, and the noise of the scene that scatters into the disc. The covariance of two cells contains both parts:

    cov(a_1 . r, a_2 . r) = sum over all pixels of q_1 q_2 var(y)    Eq. (2)

| symbol | name | unit |
|---|---|---|
| a | weights of a cell: 1 / (number of its pixels) | - |
| q | sensitivity: the derivative of the mean of a cell with respect to each pixel | - |
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.arrays import Flags, Matrix, Vector, squares
from psfcore.scatter.reconstruction import Solution
from psfcore.scatter.total_psf import Optics, Pixels, put

Planes = NDArray[np.float32]

# Inner and outer radius (fractions of the radius of the outermost dark pixel), number of sectors.
RINGS = ((0.0, 0.38, 1), (0.38, 0.7, 4), (0.7, 1.0, 8))
LEAST_PIXELS = 3
BOXES = 64
# Smaller eigenvalues of a covariance are raised to this fraction of the largest one: redundant cells would give 0.
LEAST_VARIANCE = 1e-12


@dataclass(frozen=True, eq=False)
class Cells:
    """The cells of one disc.

    Attributes
    ----------
    weights
        The weight of each dark pixel in each cell (cells, dark pixels).
    pixels
        Number of pixels of each cell.
    radius
        Mean radius of each cell, divided by the radius of the outermost dark pixel.
    azimuth
        Mean azimuth of each cell, rad.
    """

    weights: Matrix
    pixels: Vector
    radius: Vector
    azimuth: Vector


def cells_of(dark: Pixels, x_px: float, y_px: float) -> Cells:
    """Divide the dark pixels of a disc into cells. Cells with fewer than LEAST_PIXELS pixels are left out.

    Parameters
    ----------
    x_px, y_px
        The centre of the disc.
    """
    dx, dy = dark[1] - x_px, dark[0] - y_px
    r = np.hypot(dx, dy)
    share = r / max(float(r.max()), 1e-9)
    angle = np.arctan2(dy, dx)
    members: list[Flags] = []
    for low, high, sectors in RINGS:
        ring = (share >= low) & ((share < high) | (high >= 1.0))
        sector = np.floor((angle + np.pi / sectors) / (2 * np.pi / sectors)).astype(int) % sectors
        members.extend(ring & (sector == k) for k in range(sectors))
    cells = [m for m in members if m.sum() >= LEAST_PIXELS]
    weights = np.array([m / m.sum() for m in cells])
    return Cells(
        weights=weights,
        pixels=np.array([float(m.sum()) for m in cells]),
        radius=weights @ share,
        azimuth=np.angle(weights @ (np.exp(1j * angle) * share)),
    )


def sensitivities(optics: Optics, dark: Pixels, weights: Matrix) -> Planes:
    """The derivative of the mean of each cell with respect to every pixel, q of Eq. (1), (cells, ny, nx)."""
    out = []
    for weight in weights:
        cell = np.zeros(optics.engine.lanes_shape, np.float32)
        put(cell, dark, weight)
        scattered = optics.correlate(cell)
        put(scattered, dark, 0.0)
        once = optics.invert_once(scattered, adjoint=True)
        cell -= 2 * once
        cell += optics.invert_once(optics.correlate(once), adjoint=True)
        out.append(optics.field(cell))
    return np.array(out)


def whitening(covariance: Matrix) -> Matrix:
    """The whitening matrix of a covariance (n, n). It is 0 if there is no noise.

    Multiplied by this matrix, values with this covariance become uncorrelated, with variance 1.
    """
    values, vectors = np.linalg.eigh(covariance)
    if values[-1] <= 0:
        return np.zeros_like(covariance)
    return np.asarray((vectors / np.sqrt(np.maximum(values, values[-1] * LEAST_VARIANCE))) @ vectors.T)


@dataclass(frozen=True, eq=False)
class DiscCells:
    """The cells of one disc: their residuals and the derivatives of these residuals.

    Attributes
    ----------
    index
        The number of the frame among all frames.
    residual
        Observed minus expected (cells,), DN/s.
    expected
        The light that the model predicts (cells,), DN/s.
    covariance
        The covariance of the residuals, Eq. (2).
    jacobian
        The derivatives (columns, cells), DN/s for one unit of a parameter.
    pixels, radius, azimuth
        Size and place of each cell, as in `Cells`.
    boxes
        The sensitivities of the cells, and these times the expected image, each summed over boxes of the detector (2,
        cells, rows, columns).
    scene
        The mean of the occulted scene in each box [y, x], DN/s.
    level_before
        The value of `level` before the light of an effect was subtracted from the image, DN/s; None if nothing was
        subtracted.
    """

    index: int
    residual: Vector
    expected: Vector
    covariance: Matrix
    jacobian: Matrix
    pixels: Vector
    radius: Vector
    azimuth: Vector
    boxes: Planes
    scene: Matrix
    level_before: float | None = None

    @property
    def share(self) -> Vector:
        """The fraction of the pixels of the disc that each cell contains (cells,)."""
        return np.asarray(self.pixels / self.pixels.sum())

    @property
    def observed(self) -> float:
        """The observed mean of the disc, DN/s."""
        return float(self.share @ (self.expected + self.residual))

    @property
    def level(self) -> float:
        """The reference for percentages of this disc, DN/s: the absolute value of its observed mean.

        The reference is the mean before any effect was subtracted.
        """
        return abs(self.observed if self.level_before is None else self.level_before)

    @property
    def mean_expected(self) -> float:
        """The mean of the disc that the model predicts, DN/s."""
        return float(self.share @ self.expected)

    @property
    def patterns(self) -> Matrix:
        """Five patterns in the cells, each with mean zero (5, cells): the radius, two dipoles and two quadrupoles."""
        r, t = self.radius, self.azimuth
        out = np.array([r**2, r * np.cos(t), r * np.sin(t), r**2 * np.cos(2 * t), r**2 * np.sin(2 * t)])
        return np.asarray(out - (out @ self.share)[:, None])

    @property
    def mean_noise(self) -> float:
        """The noise of the mean of the disc, DN/s."""
        return float(np.sqrt(self.share @ self.covariance @ self.share))


def disc_cells(solution: Solution, n: int) -> tuple[DiscCells, Planes]:
    """The cells of frame n, with an empty Jacobian, and the sensitivities of these cells (cells, ny, nx)."""
    place, dark = solution.sky.found[n].place, solution.sky.dark[n]
    cells = cells_of(dark, place.x_px, place.y_px)
    residual, expected = solution.residual(n)
    planes = sensitivities(solution.optics, dark, cells.weights)
    frame = solution.transit.frames[n]
    variance = solution.transit.noise.variance(frame.pixels.astype(np.float64), frame.exposure_s)
    flat = planes.reshape(planes.shape[0], -1)
    covariance = (flat * variance.ravel().astype(np.float32)) @ flat.T
    return DiscCells(
        index=n,
        residual=cells.weights @ residual,
        expected=cells.weights @ expected,
        covariance=np.asarray(covariance, dtype=np.float64),
        jacobian=np.zeros((0, cells.pixels.size)),
        pixels=cells.pixels,
        radius=cells.radius,
        azimuth=cells.azimuth,
        boxes=np.zeros((2, 0, 0, 0), np.float32),
        scene=np.zeros((0, 0)),
    ), planes


def box_px(shape: tuple[int, ...]) -> int:
    """The edge of a box, px: the shorter side of the detector has about BOXES boxes."""
    return max(min(shape[-2:]) // BOXES, 1)


def summed_over_boxes(planes: Planes) -> Planes:
    """The sums of planes (planes, y, x) over boxes. Incomplete boxes at the last rows and columns are left out."""
    return np.asarray(squares(planes, box_px(planes.shape)).sum(axis=(2, 4)))


def coarse_kernel(kernel: Matrix, step: int) -> Matrix:
    """A kernel [y, x], binned: each coarse pixel is the sum of `step` x `step` pixels. Its centre is in the
    middle of a coarse pixel.
    """
    middle = kernel.shape[0] // 2
    reach = (middle + step // 2) // step
    at = (np.arange(kernel.shape[0]) - middle + step // 2) // step + reach
    out = np.zeros((2 * reach + 1,) * 2)
    keep = at <= 2 * reach
    np.add.at(out, np.ix_(at[keep], at[keep]), kernel[np.ix_(keep, keep)])
    return out
