"""What the discs show: means over cells of radius and azimuth, and their response to any change of the image.

With y an image, D its fully dark pixels, H the PSF, G the inverse on the periodic plane and x = (2 - G H) G y the
scene, the unexplained light in the disc is r = D [y - H (1 - D) x]. The mean of r over a cell is a linear function of
the whole image. The adjoint gives its weights in one pass:

    a . r = q . y,   q = a - (2 - G^T H^T) G^T (1 - D) H^T a        Eq. (1)

An effect that changes the image by e therefore changes the cell by q . e, a sum over pixels, whatever the effect. A
global gain error has q . e close to 0. The noise of two cells contains the disc's own noise and the noise of the scene
that scatters into the disc:

    cov(a_1 . r, a_2 . r) = sum over all pixels of q_1 q_2 var(y)    Eq. (2)

| symbol | name | unit |
|---|---|---|
| a | weights of a cell: 1 / number of its pixels | - |
| q | sensitivity | - |
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.scatter.inversion import Solution
from psfcore.scatter.optics import Optics, Pixels, put

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Planes = NDArray[np.float32]

RINGS = (
    (0.0, 0.38, 1),
    (0.38, 0.7, 4),
    (0.7, 1.0, 8),
)  # inner and outer radius (in units of the outermost dark pixel's radius), number of sectors
LEAST_PIXELS = 3
LEAST_VARIANCE = 1e-12  # of the largest eigenvalue: redundant cells have directions without any noise


@dataclass(frozen=True, eq=False)
class Cells:
    """The cells of one disc: weights (cells, dark pixels), number of pixels, mean radius over the disc's, and azimuth (rad)."""

    weights: Matrix
    pixels: Vector
    radius: Vector
    azimuth: Vector


def cells_of(dark: Pixels, x_px: float, y_px: float) -> Cells:
    """Divide the dark pixels around a disc's centre into cells; cells of fewer than LEAST_PIXELS pixels are left out."""
    rows, columns = dark
    dx, dy = columns - x_px, rows - y_px
    r = np.hypot(dx, dy)
    share = r / max(float(r.max()), 1e-9)
    angle = np.arctan2(dy, dx)
    members: list[NDArray[np.bool_]] = []
    for low, high, sectors in RINGS:
        ring = (share >= low) & ((share < high) | (high >= 1.0))
        sector = np.floor((angle + np.pi / sectors) / (2 * np.pi / sectors)).astype(int) % sectors
        members.extend(ring & (sector == k) for k in range(sectors))
    kept = [m for m in members if m.sum() >= LEAST_PIXELS]
    weights = np.array([m / m.sum() for m in kept])
    centre = np.exp(1j * angle)
    return Cells(
        weights=weights,
        pixels=np.array([float(m.sum()) for m in kept]),
        radius=weights @ share,
        azimuth=np.angle(weights @ (centre * share)),
    )


def sensitivities(optics: Optics, dark: Pixels, weights: Matrix) -> Planes:
    """Eq. (1): the derivative of each cell's mean with respect to every pixel of the image, (cells, ny, nx)."""
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
    """The matrix that gives numbers with this covariance (n, n) unit noise; zeros if they have no noise."""
    values, vectors = np.linalg.eigh(covariance)
    if values[-1] <= 0:
        return np.zeros_like(covariance)
    return np.asarray((vectors / np.sqrt(np.maximum(values, values[-1] * LEAST_VARIANCE))) @ vectors.T)


@dataclass(frozen=True, eq=False)
class DiscCells:
    """The cells of frame `index` (its position among all frames): residuals (observed minus expected) and their derivatives.

    residual, expected: (cells,) in DN/s. covariance: Eq. (2). jacobian: (columns, cells), DN/s for one unit of a parameter.
    pixels, radius, azimuth: as in `Cells`. observed: the disc's mean. level_before: `level` before the light of an effect
    was subtracted from the image, DN/s; None if nothing was subtracted.
    """

    index: int
    residual: Vector
    expected: Vector
    covariance: Matrix
    jacobian: Matrix
    pixels: Vector
    radius: Vector
    azimuth: Vector
    level_before: float | None = None

    @property
    def share(self) -> Vector:
        """Each cell's fraction of the disc's pixels."""
        return np.asarray(self.pixels / self.pixels.sum())

    @property
    def observed(self) -> float:
        """The disc's mean, DN/s."""
        return float(self.share @ (self.expected + self.residual))

    @property
    def level(self) -> float:
        """Reference of percentages of this disc, DN/s: the absolute mean as observed, before any effect was subtracted."""
        return abs(self.observed if self.level_before is None else self.level_before)

    @property
    def mean_expected(self) -> float:
        """The disc's expected mean, DN/s."""
        return float(self.share @ self.expected)

    @property
    def mean_noise(self) -> float:
        """The noise of the disc's mean, DN/s."""
        return float(np.sqrt(self.share @ self.covariance @ self.share))


def disc_cells(solution: Solution, n: int) -> tuple[DiscCells, Planes]:
    """The cells of frame n, with an empty Jacobian, and their sensitivities."""
    place = solution.sky.found[n].place
    dark = solution.sky.dark[n]
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
    ), planes
