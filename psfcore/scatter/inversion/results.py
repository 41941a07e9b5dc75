"""Results of an inversion: the rounds, the fit of every image, and the parameters with their covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.scatter.inversion.reconstruction import Reconstruction
from psfcore.scatter.optics import Pixels
from psfcore.scatter.shapes import Shape, Vector
from psfcore.transit.occulter import FoundPlace


@dataclass(frozen=True)
class Round:
    """One Gauss-Newton step. frames: number of images. moved_points: largest change of C(R), in percentage points."""

    frames: int
    values: dict[str, float]
    curve_pct: tuple[float, ...]
    moved_points: float
    chi2_per_pixel: float


@dataclass(frozen=True, eq=False)
class FrameFit:
    """The fit of one image: the position of its occulter, and the observed and expected light in the disc.

    observed, expected: means over the fully dark pixels, DN/s. noise: standard error of the mean residual, DN/s.
    normal, score: matrix and right-hand side that this image adds to the normal equations of the coordinates.
    mean_jacobian: derivatives of `expected` with respect to the coordinates, DN/s.
    """

    file: str
    pointing: int
    found: FoundPlace
    dark: Pixels
    observed: float
    expected: float
    noise: float
    chi2: float
    normal: NDArray[np.float64]
    score: Vector
    mean_jacobian: Vector

    @property
    def residual_pct(self) -> float:
        """Expected mean minus observed mean, in percent of the observed mean."""
        return 100 * (self.expected - self.observed) / self.observed


@dataclass(frozen=True, eq=False)
class Inversion:
    """The scatter that was fitted to a transit: coordinates with their covariance, and the curve C(R) with its errors.

    curve_pct, curve_sigma: C(R) = 100 (1 - encircled energy) of the total PSF at radii_px, and its standard error. The
    radii lie within the array of TotalPsf. covariance: covariance matrix of the coordinates; it follows from the photon
    and read noise of all pixels, propagated through the whole fit. left_out: files that the fit did not use, with the
    reasons.
    """

    shape: Shape
    coordinates: Vector
    covariance: NDArray[np.float64]
    radii_px: Vector
    curve_pct: Vector
    curve_sigma: Vector
    rounds: tuple[Round, ...]
    converged: bool
    frames: tuple[FrameFit, ...]
    left_out: dict[str, str]

    @property
    def values(self) -> dict[str, float]:
        """Parameter values by name."""
        return self.shape.values(self.coordinates)

    @property
    def value_sigma(self) -> dict[str, float]:
        """Standard errors of the parameters by name."""
        sigma = np.sqrt(np.diag(self.covariance))
        return {
            p.name: float(abs(p.slope(float(q))) * s)
            for p, q, s in zip(self.shape.parameters, self.coordinates, sigma, strict=True)
        }

    @property
    def chi2_per_pixel(self) -> float:
        """chi2 of all dark pixels divided by the degrees of freedom.

        The result is about 1 if photon and read noise explain the residuals.
        """
        pixels = sum(frame.dark[0].size for frame in self.frames)
        return sum(frame.chi2 for frame in self.frames) / (pixels - self.coordinates.size)


@dataclass(frozen=True, eq=False)
class Solution(Reconstruction):
    """An inversion together with its scenes and optics, for later analyses. part: ordered like inversion.frames."""

    inversion: Inversion


@dataclass(frozen=True, eq=False)
class SolutionWithoutErrors(Reconstruction):
    """A fit to all or some of the images of a transit. Its errors are not computed. left_out: files that the fit could
    not use, with the reasons.

    The scenes of images outside the fit are taken from the solution from which the fit started.
    """

    coordinates: Vector
    rounds: tuple[Round, ...]
    converged: bool
    left_out: dict[str, str]
