"""Maps of the errors of simulated scatter by position in the occulter, with all discs superposed.

Source: Hofmeister et al., The point-spread function of HRI_EUV, section "Accuracy and robustness". The discs are aligned to
the nearest whole pixel. The alignment does not interpolate, so it does not change the noise. It blurs positions by up to
half a pixel along each axis.

    MPE = mean over images of PE,   MAPE = mean over images of |PE|         Eq. (1)

PE is the percentage error of a pixel. The same maps are computed from noise realisations, for comparison. The absolute
value of noise does not average to zero, so the MAPE can only be interpreted relative to the MAPE of noise alone.

| symbol | name | unit |
|---|---|---|
| MPE, MAPE | mpe_pct, mape_pct | % of the disc's mean |
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

LEAST_SHARE = 0.5  # a position is on the maps if it is dark in at least this fraction of the images


@dataclass(frozen=True, eq=False)
class Superposed:
    """Maps [y, x] by offset from the centre of the occulter, which is at [half_px, half_px]; nan outside the disc.

    images: number of superposed discs. count: for each position, the number of images in which this pixel is dark.
    noise_mpe_pct: standard error of the MPE from noise alone. noise_mape_pct: MAPE of noise alone.
    """

    images: int
    count: NDArray[np.int64]
    mpe_pct: Map
    mape_pct: Map
    noise_mpe_pct: Map
    noise_mape_pct: Map

    @property
    def half_px(self) -> int:
        """Index of the centre in both axes."""
        return self.count.shape[0] // 2

    @property
    def mpe_rms_pct(self) -> float:
        """Rms of the MPE over the map."""
        return _rms(self.mpe_pct)

    @property
    def mpe_noise_rms_pct(self) -> float:
        """Expected rms of the MPE from noise alone."""
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
        """Expected mean of the MAPE from noise alone."""
        return float(np.nanmean(self.noise_mape_pct))

    @property
    def mape_largest_pct(self) -> float:
        """The largest MAPE of the map."""
        return float(np.nanmax(self.mape_pct))


class Superposition:
    """Running sums over superposed images. noise_realisations: number of noise realisations for each image."""

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
        """Add an image: the PE of its dark pixels, and the PE of each noise realisation."""
        at = dark[0] - round(place.y_px) + self._half, dark[1] - round(place.x_px) + self._half
        self._images += 1
        self._count[at] += 1
        self._pe[at] += pe_pct
        self._ape[at] += np.abs(pe_pct)
        for k, noise in enumerate(noise_pe_pct):
            self._noise_pe[k][at] += noise
            self._noise_ape[k][at] += np.abs(noise)

    def superposed(self) -> Superposed:
        """The maps of Eq. (1), at positions that are dark in at least LEAST_SHARE of the images."""
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
