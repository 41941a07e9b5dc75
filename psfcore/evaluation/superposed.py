"""Errors of simulated scatter by their place in the occulter: all images of it laid on one another.

Hofmeister et al., The point-spread function of HRI_EUV, section "Accuracy and robustness". Discs are registered to
the nearest whole pixel: nothing is interpolated, so that noise stays what it is, and places are blurred by up to
half a pixel on each axis.

    MPE = mean over images of PE,   MAPE = mean over images of |PE|         Eq. (1)

What noise alone gives is the same of draws of noise, a draw at a time: |noise| does not average out, so that MAPE
says little without it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.scatter.optics import Pixels
from psfcore.transit.transit import Place

Vector = NDArray[np.float64]
Map = NDArray[np.float64]

LEAST_SHARE = 0.5  # of the images, in which a place is dark, for it to be on the maps


@dataclass(frozen=True, eq=False)
class Superposed:
    """Maps [y, x] by the offset from the occulter's centre, which is at [half_px, half_px]; nan off the disc.

    images: how many discs were laid on one another; count: how many are dark at a place. noise_mpe_pct: standard
    error of the MPE that noise alone makes; noise_mape_pct: the MAPE that it makes.
    """

    images: int
    count: NDArray[np.int64]
    mpe_pct: Map
    mape_pct: Map
    noise_mpe_pct: Map
    noise_mape_pct: Map

    @property
    def half_px(self) -> int:
        """Index of the centre."""
        return self.count.shape[0] // 2

    @property
    def mpe_rms_pct(self) -> float:
        """Rms of the MPE over the map."""
        return _rms(self.mpe_pct)

    @property
    def mpe_noise_rms_pct(self) -> float:
        """What noise alone makes of it."""
        return _rms(self.noise_mpe_pct)

    @property
    def mpe_largest_pct(self) -> float:
        """The largest |MPE| of the map."""
        return float(np.nanmax(np.abs(self.mpe_pct)))

    @property
    def mape_mean_pct(self) -> float:
        """Mean of the MAPE over the map."""
        return float(np.nanmean(self.mape_pct))

    @property
    def mape_noise_mean_pct(self) -> float:
        """What noise alone makes of it."""
        return float(np.nanmean(self.noise_mape_pct))

    @property
    def mape_largest_pct(self) -> float:
        """The largest MAPE of the map."""
        return float(np.nanmax(self.mape_pct))


class Superposition:
    """Sums over the images laid on one another so far. draws: of noise, with every image."""

    def __init__(self, radius_px: float, noise_realisations: int) -> None:
        self._half = math.ceil(radius_px) + 1
        shape = (2 * self._half + 1, 2 * self._half + 1)
        self._images = 0
        self._count = np.zeros(shape, np.int64)
        self._pe, self._ape = np.zeros(shape), np.zeros(shape)
        self._noise_pe, self._noise_ape = (
            np.zeros((noise_realisations, *shape)),
            np.zeros((noise_realisations, *shape)),
        )

    def add(self, place: Place, dark: Pixels, pe_pct: Vector, noise_pe_pct: Sequence[Vector]) -> None:
        """One more image: the PE of its dark pixels, and that of each draw of noise."""
        at = dark[0] - round(place.y_px) + self._half, dark[1] - round(place.x_px) + self._half
        self._images += 1
        self._count[at] += 1
        self._pe[at] += pe_pct
        self._ape[at] += np.abs(pe_pct)
        for k, noise in enumerate(noise_pe_pct):
            self._noise_pe[k][at] += noise
            self._noise_ape[k][at] += np.abs(noise)

    def superposed(self) -> Superposed:
        """Eq. (1), where at least LEAST_SHARE of the images are dark."""
        shown = self._count >= max(LEAST_SHARE * self._images, 1)
        count = np.where(shown, self._count, np.nan)
        realisations = max(len(self._noise_pe), 1)
        noise_mpe = np.sqrt(np.sum((self._noise_pe / count) ** 2, axis=0) / realisations)
        return Superposed(
            images=self._images,
            count=self._count,
            mpe_pct=self._pe / count,  # Eq. (1)
            mape_pct=self._ape / count,  # Eq. (1)
            noise_mpe_pct=noise_mpe,
            noise_mape_pct=np.sum(self._noise_ape, axis=0) / realisations / count,
        )


def _rms(values: Map) -> float:
    return float(np.sqrt(np.nanmean(values**2)))
