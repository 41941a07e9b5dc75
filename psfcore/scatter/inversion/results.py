"""Results of an inversion: its rounds, every frame at the solution, and the parameters with their covariance."""

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
    """One Gauss-Newton step. moved_points: the largest change of the cumulative curve, in percentage points."""

    frames: int
    values: dict[str, float]
    curve_pct: tuple[float, ...]
    moved_points: float
    chi2_per_pixel: float


@dataclass(frozen=True, eq=False)
class FrameFit:
    """One frame at the solution: the position of its occulter, and the observed and expected light in the disc.

    observed, expected: means over the fully dark pixels, DN/s. noise: standard error of the mean residual, DN/s.
    normal, score: contribution of this frame to the normal equations in coordinates, summed over its pixels.
    mean_jacobian: change of the expected mean with the coordinates, DN/s.
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
        """Simulated minus observed, in percent of the observed mean."""
        return 100 * (self.expected - self.observed) / self.observed


@dataclass(frozen=True, eq=False)
class Inversion:
    """Scatter as fitted to a transit: coordinates with their covariance, curve with its errors, and the rounds.

    radii_px, curve_pct, curve_sigma: cumulative curve of the total PSF, 100 (1 - encircled energy), on the square
    that light within the field can cross. covariance: of the coordinates, from the photon and read noise of all
    pixels, propagated through the whole estimate. left_out: frames that the fit did not use, with the reasons.
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
        """chi2 of all dark pixels over the degrees of freedom; about 1 if photon and read noise explain it."""
        pixels = sum(frame.dark[0].size for frame in self.frames)
        return sum(frame.chi2 for frame in self.frames) / (pixels - self.coordinates.size)


@dataclass(frozen=True, eq=False)
class Solution(Reconstruction):
    """An inversion with the scenes and optics behind it, for later analyses. part is in the order of its frames."""

    inversion: Inversion


@dataclass(frozen=True, eq=False)
class SolutionWithoutErrors(Reconstruction):
    """A fit to some of a transit's frames, without errors. left_out: frames that the fit could not use, with reasons.

    Scenes of frames outside the fit are those of the solution from which it started.
    """

    coordinates: Vector
    rounds: tuple[Round, ...]
    converged: bool
    left_out: dict[str, str]
