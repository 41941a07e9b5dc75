"""One image under evaluation: the light in its occulter as observed and as simulated. See `evaluation`.

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
    """A row or a column through the middle of an occulter: offsets from its centre (px), intensities in DN/s.

    dark: which of its pixels are fully dark.
    """

    offset_px: Vector
    observed: Vector
    simulated: Vector
    dark: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class FrameEvaluation:
    """One image: the light in its occulter as observed and as simulated, DN/s.

    observed, simulated: of the dark pixels, in the order of `dark`. noise, centre_noise: standard errors of the mean
    of their difference, over all of them and at the centre; nan where the centre is not among them. along_x,
    along_y: slices, of some images.
    """

    index: int
    file: str
    fov: int
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
        """Mean over the dark pixels."""
        return float(self.observed.mean())

    @property
    def simulated_dn_s(self) -> float:
        """Mean over the dark pixels."""
        return float(self.simulated.mean())

    @property
    def error_dn_s(self) -> float:
        """Simulated minus observed, mean over the dark pixels."""
        return self.simulated_dn_s - self.observed_dn_s

    @property
    def pe_pct(self) -> Vector:
        """PE, percent, a dark pixel at a time."""
        return 100 * (self.simulated - self.observed) / self.observed_dn_s

    @property
    def residual_pct(self) -> float:
        """Mean PE over the dark pixels, percent."""
        return 100 * self.error_dn_s / self.observed_dn_s

    @property
    def noise_pct(self) -> float:
        """Standard error of the residual."""
        return 100 * self.noise_dn_s / self.observed_dn_s

    @property
    def centre_dn_s(self) -> tuple[float, float]:
        """Observed and simulated mean at the centre; nan where no dark pixel lies there."""
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
        """Standard error of the PE at the centre."""
        return 100 * self.centre_noise_dn_s / self.observed_dn_s

    def residual_against_pct(self, plane: NDArray[np.floating]) -> float:
        """The residual with an image [y, x] in place of the observed one: one without noise, where there is one."""
        wanted = float(np.mean(plane[self.dark], dtype=np.float64))
        return 100 * (self.simulated_dn_s - wanted) / wanted


def at_centre(dark: Pixels, found: FoundPlace) -> NDArray[np.bool_]:
    """Which of the dark pixels lie within CENTRE_PX of the occulter's centre."""
    place = found.place
    return np.asarray(np.hypot(dark[0] - place.y_px, dark[1] - place.x_px) <= CENTRE_PX)
