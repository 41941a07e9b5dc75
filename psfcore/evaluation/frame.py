"""The evaluation of one image: observed and simulated light in its occulter.

Hofmeister et al., The point-spread function of HRI_EUV, section "Evaluation". The equations of
`psfcore.evaluation.evaluation` apply.

| symbol | name | unit |
|---|---|---|
| y, s | observed, simulated | DN/s |
| D | dark: rows and columns | - |
| PE | pe_pct | % |
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.scatter.optics import Pixels
from psfcore.transit.occulter import FoundPlace

Vector = NDArray[np.float64]

CENTRE_PX = 2.0


@dataclass(frozen=True, eq=False)
class Slice:
    """A row or a column of pixels through the centre of an occulter.

    offset_px: distance of each pixel from the centre, with sign. observed, simulated: intensities, DN/s. dark: True for
    fully dark pixels.
    """

    offset_px: Vector
    observed: Vector
    simulated: Vector
    dark: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class FrameEvaluation:
    """Observed and simulated light in the occulter of one image, DN/s.

    observed, simulated: intensities of the dark pixels, in the order of `dark`. noise_dn_s: standard error of the mean
    of simulated minus observed over the dark pixels. centre_noise_dn_s: the same error for the dark pixels at the
    centre; nan if there are no such pixels. along_x, along_y: slices; None for most images.
    """

    index: int
    file: str
    pointing: int
    time_s: float
    found: FoundPlace
    dark: Pixels
    observed: Vector
    simulated: Vector
    noise_dn_s: float
    centre_noise_dn_s: float
    along_x: Slice | None = None
    along_y: Slice | None = None

    @property
    def observed_dn_s(self) -> float:
        """Mean observed intensity of the dark pixels."""
        return float(self.observed.mean())

    @property
    def simulated_dn_s(self) -> float:
        """Mean simulated intensity of the dark pixels."""
        return float(self.simulated.mean())

    @property
    def error_dn_s(self) -> float:
        """Mean of simulated minus observed intensity of the dark pixels."""
        return self.simulated_dn_s - self.observed_dn_s

    @property
    def pe_pct(self) -> Vector:
        """PE of each dark pixel, percent, Eq. (2)."""
        return 100 * (self.simulated - self.observed) / self.observed_dn_s

    @property
    def residual_pct(self) -> float:
        """Mean PE over the dark pixels, percent, Eq. (3)."""
        return 100 * self.error_dn_s / self.observed_dn_s

    @property
    def noise_pct(self) -> float:
        """Standard error of the residual, percent."""
        return 100 * self.noise_dn_s / self.observed_dn_s

    @property
    def centre_dn_s(self) -> tuple[float, float]:
        """Mean observed and mean simulated intensity at the centre; nan if there are no dark pixels at the centre."""
        at = at_centre(self.dark, self.found)
        if not at.any():
            return float("nan"), float("nan")
        return float(self.observed[at].mean()), float(self.simulated[at].mean())

    @property
    def centre_pct(self) -> float:
        """Mean PE at the centre, percent."""
        observed, simulated = self.centre_dn_s
        return 100 * (simulated - observed) / self.observed_dn_s

    @property
    def centre_noise_pct(self) -> float:
        """Standard error of the mean PE at the centre, percent."""
        return 100 * self.centre_noise_dn_s / self.observed_dn_s

    def residual_against_pct(self, plane: NDArray[np.floating]) -> float:
        """The residual, in percent, against another image [y, x] instead of the observation, for example a noise-free
        image."""
        wanted = float(np.mean(plane[self.dark], dtype=np.float64))
        return 100 * (self.simulated_dn_s - wanted) / wanted


def at_centre(dark: Pixels, found: FoundPlace) -> NDArray[np.bool_]:
    """Mask of the dark pixels within CENTRE_PX of the centre of the occulter."""
    place = found.place
    return np.asarray(np.hypot(dark[0] - place.y_px, dark[1] - place.x_px) <= CENTRE_PX)
