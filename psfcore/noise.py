"""Noise of an exposure: photons and readout.

    var(D) = g D + r^2            Eq. (1)    of D in DN
    var(R) = (g R t + r^2) / t^2  Eq. (2)    of a rate R = D / t in DN/s

The variance is that of the expected value. Taken from the observed one it would be smallest where the noise
happened to be negative, and of the wrong sign where a pixel is.

| symbol | name | unit |
|---|---|---|
| D | expected value of a pixel in one exposure | DN |
| g | photon_gain_dn: DN a detected photon | DN |
| r | read_noise_dn: rms of the readout | DN |
| t | dn_per_unit: the exposure for DN/s, 1 for DN | s, 1 |
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.image import Image

Plane = NDArray[np.float64]


@dataclass(frozen=True)
class Noise:
    """What a photon and a readout do to a pixel.

    Raises DataError "bad-noise": both finite, neither below zero, and one above it.
    """

    photon_gain_dn: float
    read_noise_dn: float

    def __post_init__(self) -> None:
        pair = (self.photon_gain_dn, self.read_noise_dn)
        if not all(math.isfinite(value) and value >= 0 for value in pair) or not any(pair):
            raise DataError("bad-noise", f"expected DN a photon and DN rms, not both zero; got {pair}")

    def variance(self, expected: Plane, dn_per_unit: float) -> Plane:
        """Variance [y, x] of pixels whose expected value is `expected`; below zero counts as zero."""
        photons = self.photon_gain_dn * np.maximum(expected, 0.0) / dn_per_unit
        return np.asarray(photons + (self.read_noise_dn / dn_per_unit) ** 2)  # Eq. (1), Eq. (2)

    def observe(self, expected: Plane, dn_per_unit: float, rng: np.random.Generator) -> Plane:
        """Pixels [y, x] as one more exposure of the same scene would have them."""
        seen_dn: Plane = np.maximum(expected, 0.0) * dn_per_unit
        if self.photon_gain_dn > 0:
            seen_dn = np.asarray(rng.poisson(seen_dn / self.photon_gain_dn) * self.photon_gain_dn)
        if self.read_noise_dn > 0:
            seen_dn = np.asarray(seen_dn + rng.normal(0.0, self.read_noise_dn, expected.shape))
        return np.asarray(seen_dn / dn_per_unit)


def dn_per_unit(image: Image) -> float:
    """DN in one exposure for one unit of the image: the exposure where the unit is DN/s, else 1.

    Raises DataError "no-exposure".
    """
    if (image.unit or "").replace(" ", "").lower() != "dn/s":
        return 1.0
    if image.exposure_s is None:
        message = "expected XPOSURE or EXPTIME, to know the noise of an image in DN/s; got neither"
        raise DataError("no-exposure", message)
    return image.exposure_s
