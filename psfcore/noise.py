"""Noise of an exposure: photon noise and read noise.

    var(D) = g D + r^2            Eq. (1)    D in DN
    var(R) = (g R t + r^2) / t^2  Eq. (2)    rate R = D / t in DN/s

The variance is computed from the expected value of a pixel. If it were computed from the observed value, it would be
too small for a pixel whose noise happens to be negative, and it could be negative for a negative pixel.

| symbol | name | unit |
|---|---|---|
| D | expected value of a pixel in one exposure | DN |
| g | photon_gain_dn: DN per detected photon | DN |
| r | read_noise_dn: rms | DN |
| t | dn_per_unit: exposure time for DN/s, 1 for DN | s, 1 |

This module loads numpy on first use, so that the web process can check the figures of requests.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, ConfigDict, Field

from psfcore.errors import DataError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Plane = NDArray[np.float64]

# Strict: the text "12.5" and the value true are refused, because they are not numbers.
Figure = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]


@dataclass(frozen=True)
class Noise:
    """Photon gain and read noise of a camera.

    Both must be finite and at least zero, and one of them must be above zero; otherwise raises DataError "bad-noise".
    """

    photon_gain_dn: float
    read_noise_dn: float

    def __post_init__(self) -> None:
        pair = (self.photon_gain_dn, self.read_noise_dn)
        if not all(math.isfinite(value) and value >= 0 for value in pair) or not any(pair):
            raise DataError(
                "bad-noise",
                f"expected photon gain (DN per photon) and read noise (DN rms), at least 0 and not both 0; got {pair}",
            )

    def variance(self, expected: Plane, dn_per_unit: float) -> Plane:
        """Variance [y, x] of pixels whose expected values are `expected`; negative expected values count as zero."""
        import numpy as np

        photons = self.photon_gain_dn * np.maximum(expected, 0.0) / dn_per_unit
        return np.asarray(photons + (self.read_noise_dn / dn_per_unit) ** 2)  # Eq. (1), Eq. (2)

    def observe(self, expected: Plane, dn_per_unit: float, rng: np.random.Generator) -> Plane:
        """Simulate one exposure [y, x] of a scene whose noise-free image is `expected`."""
        import numpy as np

        exposure_dn: Plane = np.maximum(expected, 0.0) * dn_per_unit
        if self.photon_gain_dn > 0:
            exposure_dn = np.asarray(rng.poisson(exposure_dn / self.photon_gain_dn) * self.photon_gain_dn)
        if self.read_noise_dn > 0:
            exposure_dn = np.asarray(exposure_dn + rng.normal(0.0, self.read_noise_dn, expected.shape))
        return np.asarray(exposure_dn / dn_per_unit)


class NoiseFigures(BaseModel):
    """Variance of a pixel in DN^2 = photon_gain_dn * signal in DN + read_noise_dn^2."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    photon_gain_dn: Figure = Field(description="DN per detected photon")
    read_noise_dn: Figure = Field(description="read noise, DN rms")

    def noise(self) -> Noise:
        """The noise model with these figures. Raises DataError "bad-noise" if both are zero."""
        return Noise(self.photon_gain_dn, self.read_noise_dn)
