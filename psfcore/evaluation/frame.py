"""The evaluation of one image, and maps of the errors of all images by position in the occulter.

Hofmeister et al., The point-spread function of HRI_EUV, sections "Evaluation" and "Accuracy and robustness". The equations
of `psfcore.evaluation.evaluation` apply. On the maps, the discs are aligned to the nearest whole pixel. The alignment does
not interpolate, so it does not change the noise. It blurs positions by up to half a pixel along each axis.

    MPE = mean over images of PE,   MAPE = mean over images of |PE|         Eq. (4)

The same maps are computed from noise realisations, for comparison. The absolute value of noise does not average to zero,
so the MAPE can only be interpreted relative to the MAPE of noise alone.

| symbol | name | unit |
|---|---|---|
| y, s | observed, simulated | DN/s |
| D | dark: rows and columns | - |
| PE | pe_pct: percentage error of a pixel | % |
| MPE, MAPE | mpe_pct, mape_pct | % of the disc's mean |
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.scatter.optics import Pixels
from psfcore.transit.occulter import FoundPlace

Vector = NDArray[np.float64]

Map = NDArray[np.float64]

CENTRE_PX = 2.0
LEAST_SHARE = 0.5  # a position is on the maps if it is dark in at least this fraction of the images


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


def at_centre(dark: Pixels, found: FoundPlace) -> NDArray[np.bool_]:
    """Mask of the dark pixels within CENTRE_PX of the centre of the occulter."""
    place = found.place
    return np.asarray(np.hypot(dark[0] - place.y_px, dark[1] - place.x_px) <= CENTRE_PX)


def superposed_maps(frames: Sequence[FrameEvaluation], values: Sequence[Vector], half_px: int) -> Map:
    """Values of the dark pixels of each image by whole-pixel offset from the centre of its occulter; nan elsewhere.

    The result has the shape (images, 2 half_px + 1, 2 half_px + 1).
    """
    maps = np.full((len(frames), 2 * half_px + 1, 2 * half_px + 1), np.nan)
    for of, frame, of_frame in zip(maps, frames, values, strict=True):
        (rows, columns), place = frame.dark, frame.found.place
        of[rows - round(place.y_px) + half_px, columns - round(place.x_px) + half_px] = of_frame
    return maps


def half_width_px(radius_px: float) -> int:
    """The half width of a map that contains a disc of this radius."""
    return math.ceil(radius_px) + 1


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


def superposed(pe_pct: Map, noise_pct: Map) -> Superposed:
    """The maps of Eq. (4), at positions that are dark in at least LEAST_SHARE of the images.

    pe_pct: PE of each image, as `superposed_maps` returns it. noise_pct: the same for each noise realisation, with the
    shape (realisations, images, y, x).
    """
    count = np.isfinite(pe_pct).sum(axis=0)
    shown = count >= max(LEAST_SHARE * len(pe_pct), 1)
    over, realisations = np.where(shown, count, np.nan), max(len(noise_pct), 1)
    noise_mpe = np.nansum(noise_pct, axis=1) / over
    noise_mape = np.nansum(np.abs(noise_pct), axis=1)
    return Superposed(
        images=len(pe_pct),
        count=count,
        mpe_pct=np.nansum(pe_pct, axis=0) / over,  # Eq. (4)
        mape_pct=np.nansum(np.abs(pe_pct), axis=0) / over,  # Eq. (4)
        noise_mpe_pct=np.sqrt(np.sum(noise_mpe**2, axis=0) / realisations),
        noise_mape_pct=np.sum(noise_mape, axis=0) / realisations / over,
    )


def _rms(values: Map) -> float:
    return float(np.sqrt(np.nanmean(values**2)))
