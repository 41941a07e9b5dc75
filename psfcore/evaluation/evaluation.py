"""Evaluate a PSF: simulate the light that it scatters into the occulter, and compare it with the observed light.

Source: Hofmeister et al., The point-spread function of HRI_EUV, sections "Accuracy and robustness" and "Evaluation".
H is the convolution with a total PSF on the field, y is an image, and D selects the fully dark pixels of this image:

    x = H^-1 y,   s = H (1 - D) x                              Eq. (1)
    PE = (s - y) / mean over D of y, for each pixel of D       Eq. (2)
    residual = mean over D of PE                               Eq. (3)
    MPE = mean over images of PE,   MAPE = mean over images of |PE|         Eq. (4)

PE is the percentage error of a pixel. Differences from the paper:

- In the paper's formula, the PE is divided by the sum over the occulted pixels. The paper's text and figures require
  the mean, so the mean is used here.
- Only fully dark pixels are set to zero. The scene is reconstructed by a linear method.
- The residual at the centre is the mean PE within CENTRE_PX, so it is also divided by the mean of the whole disc. The
  mean of the centre alone is the mean of a dozen pixels with a dozen photons each. This mean would be too noisy as a
  denominator and would bias the residual high.

Errors contain the photon and read noise of the image, propagated through Eq. (1). They do not contain the error of the
PSF. Errors of means are exact (`noise_covariance`). Errors of single pixels come from noise realisations. The variance
of the noise in a realisation follows from the observed intensity, but in the pixels of D from the simulated intensity.

MPE and MAPE are maps by position in the occulter. The discs are aligned to the nearest whole pixel. The alignment does
not interpolate, so it does not change the noise. It blurs positions by up to half a pixel along each axis. The same
maps are computed from noise realisations, for comparison. The absolute value of noise does not average to zero, so the
MAPE can only be interpreted relative to the MAPE of noise alone.

| symbol | name | unit |
|---|---|---|
| y, s | observed, simulated | DN/s |
| D | dark: rows and columns | - |
| PE | pe_pct: percentage error of a pixel | % |
| MPE, MAPE | mpe_pct, mape_pct | % of the disc's mean |
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from psfcore.arrays import Flags, Kernel, Plane, Vector
from psfcore.errors import DataError
from psfcore.psf import Psf
from psfcore.scatter.reconstruction import LEAST_DARK_PIXELS, Progress, dark_pixels
from psfcore.scatter.total_psf import Optics, Pixels, noise_covariance, pick, put
from psfcore.transit.occulter import DOUBT_SIGMAS, FoundPlace, find_occulter
from psfcore.transit.transit import Frame, Transit

CENTRE_PX = 2.0
LEAST_SHARE = 0.5  # a position is on the maps if it is dark in at least this fraction of the images
# Smallest depth of an occulter: the missing light divided by the light that a disc would hide according to the PSF. The
# inversion uses a higher limit. The limit is lower here because a given PSF may lack scatter: the disc is then much
# brighter than this PSF predicts, and the depth is smaller.
LEAST_DEPTH = 0.2
SLICE_HALF_PX = 20
SLICES_A_POINTING = 3
NOISE_REALISATIONS = 4
INVERSION_STEPS = 6
SCENES_KEPT = 24


@dataclass(frozen=True, eq=False)
class Slice:
    """A row or a column of pixels through the centre of an occulter.

    Attributes
    ----------
    offset_px
        Distance of each pixel from the centre, with sign.
    observed_dn_s, simulated_dn_s
        Intensity of each pixel, DN/s.
    dark
        True for fully dark pixels.
    """

    offset_px: Vector
    observed_dn_s: Vector
    simulated_dn_s: Vector
    dark: Flags


@dataclass(frozen=True, eq=False)
class FrameEvaluation:
    """Observed and simulated light in the occulter of one image, DN/s.

    Attributes
    ----------
    observed, simulated
        Intensities of the dark pixels, in the order of `dark`.
    noise_dn_s
        Standard error of the mean of simulated minus observed over the dark pixels.
    centre_noise_dn_s
        The same error for the dark pixels at the centre; nan if there are no such pixels.
    along_x, along_y
        The row and the column of pixels through the centre; None for most images.
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
        """The mean observed intensity of the dark pixels."""
        return float(self.observed.mean())

    @property
    def simulated_dn_s(self) -> float:
        """The mean simulated intensity of the dark pixels."""
        return float(self.simulated.mean())

    @property
    def error_dn_s(self) -> float:
        """The mean of simulated minus observed intensity of the dark pixels."""
        return self.simulated_dn_s - self.observed_dn_s

    @property
    def pe_pct(self) -> Vector:
        """The percentage error PE of each dark pixel, Eq. (2)."""
        return 100 * (self.simulated - self.observed) / self.observed_dn_s

    @property
    def residual_pct(self) -> float:
        """The mean PE over the dark pixels, percent, Eq. (3)."""
        return 100 * self.error_dn_s / self.observed_dn_s

    @property
    def noise_pct(self) -> float:
        """The standard error of the residual, percent."""
        return 100 * self.noise_dn_s / self.observed_dn_s

    @property
    def centre_dn_s(self) -> tuple[float, float]:
        """The mean observed and mean simulated intensity at the centre; nan if there are no dark pixels at the
        centre.
        """
        at = at_centre(self.dark, self.found)
        if not at.any():
            return float("nan"), float("nan")
        return float(self.observed[at].mean()), float(self.simulated[at].mean())

    @property
    def centre_pct(self) -> float:
        """The mean PE at the centre, percent."""
        observed, simulated = self.centre_dn_s
        return 100 * (simulated - observed) / self.observed_dn_s

    @property
    def centre_noise_pct(self) -> float:
        """The standard error of the mean PE at the centre, percent."""
        return 100 * self.centre_noise_dn_s / self.observed_dn_s


def at_centre(dark: Pixels, found: FoundPlace) -> Flags:
    """The mask of the dark pixels within CENTRE_PX of the centre of the occulter."""
    place = found.place
    return np.asarray(np.hypot(dark[0] - place.y_px, dark[1] - place.x_px) <= CENTRE_PX)


# --- maps ------------------------------------------------------------------------------------------------


def superposed_maps(frames: Sequence[FrameEvaluation], values: Sequence[Vector], half_px: int) -> Plane:
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

    Attributes
    ----------
    images
        Number of superposed discs.
    count
        For each position, the number of images in which this pixel is dark.
    noise_mpe_pct
        Standard error of the MPE from noise alone.
    noise_mape_pct
        MAPE of noise alone.
    mpe_rms_pct, mpe_largest_pct
        Rms and largest absolute value of the MPE over the map.
    mape_mean_pct, mape_largest_pct
        Mean and largest value of the MAPE.
    mpe_noise_rms_pct, mape_noise_mean_pct
        The values of mpe_rms_pct and mape_mean_pct that noise alone gives.
    """

    images: int
    count: NDArray[np.int64]
    mpe_pct: Plane
    mape_pct: Plane
    noise_mpe_pct: Plane
    noise_mape_pct: Plane
    mpe_rms_pct: float
    mpe_largest_pct: float
    mpe_noise_rms_pct: float
    mape_mean_pct: float
    mape_largest_pct: float
    mape_noise_mean_pct: float

    @property
    def half_px(self) -> int:
        """The index of the centre in both axes."""
        return int(self.count.shape[0] // 2)


def superposed(pe_pct: Plane, noise_pct: Plane) -> Superposed:
    """The maps of Eq. (4), at positions that are dark in at least LEAST_SHARE of the images.

    Parameters
    ----------
    pe_pct
        The PE of each image, as `superposed_maps` returns it.
    noise_pct
        The PE of each noise realisation, with the shape (realisations, images, y, x).
    """
    count = np.isfinite(pe_pct).sum(axis=0)
    shown = count >= max(LEAST_SHARE * len(pe_pct), 1)
    over, realisations = np.where(shown, count, np.nan), max(len(noise_pct), 1)
    of_noise = np.nansum(noise_pct, axis=1) / over
    mpe, mape = np.nansum(pe_pct, axis=0) / over, np.nansum(np.abs(pe_pct), axis=0) / over  # Eq. (4)
    noise_mpe = np.sqrt(np.sum(of_noise**2, axis=0) / realisations)
    noise_mape = np.sum(np.nansum(np.abs(noise_pct), axis=1), axis=0) / realisations / over
    return Superposed(
        images=len(pe_pct),
        count=count,
        mpe_pct=mpe,
        mape_pct=mape,
        noise_mpe_pct=noise_mpe,
        noise_mape_pct=noise_mape,
        mpe_rms_pct=rms(mpe),
        mpe_largest_pct=float(np.nanmax(np.abs(mpe))),
        mpe_noise_rms_pct=rms(noise_mpe),
        mape_mean_pct=float(np.nanmean(mape)),
        mape_largest_pct=float(np.nanmax(mape)),
        mape_noise_mean_pct=float(np.nanmean(noise_mape)),
    )


def rms(values: Plane | Vector) -> float:
    """The root mean square of the values that are not nan; nan if there is no value."""
    return float(np.sqrt(np.nanmean(values**2))) if values.size else math.nan


# --- the evaluation ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Evaluation:
    """The evaluation of one PSF, or of one PSF for each fold, on all images of a transit.

    Attributes
    ----------
    left_out
        Files that could not be evaluated, with the reasons.
    """

    transit: Transit
    frames: tuple[FrameEvaluation, ...]
    left_out: dict[str, str]
    superposed: Superposed


def evaluate(
    transit: Transit,
    psf_for_frame: Callable[[int], Kernel | Psf],
    *,
    noise_realisations: int = NOISE_REALISATIONS,
    seed: int = 1,
    threads: int = 1,
    progress: Progress = lambda stage, step, steps: None,
) -> Evaluation:
    """Simulate the light in every occulter of a transit, and compare it with the observed light.

    The images before and after an image help to locate its occulter. These images are reconstructed with the PSF of the
    evaluated image, so that an image of one fold never depends on the PSF of another fold.

    Raises DataError "no-occulter" if no image can be evaluated.

    Parameters
    ----------
    psf_for_frame
        Function that returns the total PSF [y, x] for the index of an image, centre at [n // 2, n // 2], or a PSF that
        may change over the field, on the pixels of the images. A PSF is prepared only once for all images for which
        this function returns the same object.
    noise_realisations
        Number of noise realisations for each image; they give the superposed maps of noise alone.
    seed
        Random seed of these realisations.
    """
    kernels = [psf_for_frame(n) for n in range(len(transit.frames))]
    sliced = _sliced(transit.frames)
    done: dict[int, FrameEvaluation] = {}
    noise_pct: dict[int, list[Vector]] = {}
    left_out: dict[str, str] = {}
    sharing: dict[int, list[int]] = {}  # the images that share a kernel
    for n, kernel in enumerate(kernels):
        sharing.setdefault(id(kernel), []).append(n)
    for indices in sharing.values():
        simulator = _FrameSimulator(transit, kernels[indices[0]], threads)
        for n in indices:
            progress("evaluating", len(done) + len(left_out), len(kernels))
            frame = transit.frames[n]
            found, dark = simulator.find(n)
            reason = _reason(frame, found, dark)
            if reason is not None:
                left_out[frame.file] = reason
                continue
            simulated = simulator.simulated(n, dark)
            done[n] = _compared(simulator, n, found, dark, simulated, sliced=n in sliced)
            rng = np.random.default_rng([seed, n])
            share = 100 / done[n].observed_dn_s
            noise_pct[n] = [
                share * simulator.noise_alone(n, dark, simulated, rng) for _ in range(noise_realisations)
            ]
    if not done:
        reasons = "; ".join(f"{file}: {why}" for file, why in list(left_out.items())[:3])
        raise DataError(
            "no-occulter",
            f"expected at least one image with a usable occulter; got none ({reasons}): check the positions in "
            "transit.json",
        )
    order = sorted(done)
    frames = tuple(done[n] for n in order)
    half_px = half_width_px(max(frame.place.radius_px for frame in transit.frames))
    pe_maps = superposed_maps(frames, [frame.pe_pct for frame in frames], half_px)
    noise_maps = [
        superposed_maps(frames, [noise_pct[n][k] for n in order], half_px) for k in range(noise_realisations)
    ]
    maps = superposed(pe_maps, np.array(noise_maps).reshape(-1, *pe_maps.shape))
    return Evaluation(transit, frames, left_out, maps)


def _sliced(frames: Sequence[Frame]) -> set[int]:
    """Indices of the images whose slices are kept: SLICES_A_POINTING for each pointing, at equal intervals."""
    chosen: set[int] = set()
    for pointing in {frame.pointing for frame in frames}:
        here = [n for n, frame in enumerate(frames) if frame.pointing == pointing]
        middles = (np.arange(SLICES_A_POINTING) + 0.5) / SLICES_A_POINTING * len(here)
        chosen.update(here[int(at)] for at in middles)
    return chosen


class _FrameSimulator:
    """Simulates the images of a transit with one PSF."""

    def __init__(self, transit: Transit, psf: Kernel | Psf, threads: int) -> None:
        self.transit, self.kernel = transit, psf.kernel if isinstance(psf, Psf) else psf
        self.optics = optics = Optics(psf, transit.shape, threads=threads)

        # The function does not use `self`: a cycle of references would keep the scenes too long.
        def scene(n: int) -> NDArray[np.float32]:
            observed = optics.lanes(transit.frames[n].pixels)
            return optics.field(optics.invert(observed, steps=INVERSION_STEPS))

        self.scene_of = lru_cache(maxsize=SCENES_KEPT)(scene)  # x of Eq. (1), [y, x]

    def find(self, n: int) -> tuple[FoundPlace, Pixels]:
        """The position of the occulter of frame n, and its fully dark pixels."""
        frames = self.transit.frames
        places = [frame.place for frame in frames]
        found = find_occulter(n, frames, self.scene_of, places, self.kernel, self.transit.noise)
        return found, dark_pixels(frames[n], found)

    def simulated(self, n: int, dark: Pixels) -> NDArray[np.float32]:
        """S of Eq. (1), [y, x]."""
        scene = self.scene_of(n).copy()
        scene[dark] = 0.0
        return self.optics.field(self.optics.convolve(self.optics.lanes(scene)))

    def noise_alone(
        self, n: int, dark: Pixels, simulated: NDArray[np.float32], rng: np.random.Generator
    ) -> Vector:
        """Eq. (1) for a perfect PSF and one noise realisation of the image: s - y of the pixels in D, DN/s."""
        frame, optics = self.transit.frames[n], self.optics
        expected = frame.pixels.astype(np.float64)
        expected[dark] = simulated[dark]
        expected = np.maximum(expected, 0.0)
        noise = self.transit.noise.observe(expected, frame.exposure_s, rng) - expected
        scene = optics.invert_once(optics.lanes(noise))
        put(scene, dark, 0.0)
        return pick(optics.convolve(scene), dark) - noise[dark]


def _reason(frame: Frame, found: FoundPlace, dark: Pixels) -> str | None:
    """The reason why an image cannot be evaluated; None if it can be evaluated."""
    where = f"({frame.place.x_px:g}, {frame.place.y_px:g}) px"
    if not found.within_reach or found.depth + DOUBT_SIGMAS * found.depth_sigma < LEAST_DEPTH:
        return f"expected an occulter at {where}; found no occulter there"
    if dark[0].size < LEAST_DARK_PIXELS:
        return f"expected at least {LEAST_DARK_PIXELS} fully dark pixels; got {dark[0].size}"
    observed = float(frame.pixels[dark].mean(dtype=np.float64))
    if observed <= 0:
        return f"expected a positive mean intensity in the occulter at {where}; got {observed:.3g} DN/s"
    return None


def _compared(
    simulator: _FrameSimulator,
    n: int,
    found: FoundPlace,
    dark: Pixels,
    simulated: NDArray[np.float32],
    *,
    sliced: bool,
) -> FrameEvaluation:
    frame, noise = simulator.transit.frames[n], simulator.transit.noise
    # The standard errors of two means of s - y: over all dark pixels, and over the dark pixels at the centre.
    at = at_centre(dark, found)
    templates = [np.full(at.size, 1 / at.size), at / max(int(np.count_nonzero(at)), 1)]
    disc, centre = np.sqrt(np.diag(noise_covariance(simulator.optics, frame, dark, templates, noise)))
    along_x, along_y = _slices(frame, found, dark, simulated) if sliced else (None, None)
    return FrameEvaluation(
        index=n,
        file=frame.file,
        pointing=frame.pointing,
        time_s=frame.time_s,
        found=found,
        dark=dark,
        observed=frame.pixels[dark].astype(np.float64),
        simulated=simulated[dark].astype(np.float64),
        noise_dn_s=float(disc),
        centre_noise_dn_s=float(centre) if at.any() else float("nan"),
        along_x=along_x,
        along_y=along_y,
    )


def _slices(
    frame: Frame, found: FoundPlace, dark: Pixels, simulated: NDArray[np.float32]
) -> tuple[Slice, Slice]:
    """The row and the column nearest to the centre of the occulter, cropped to the field."""
    is_dark = np.zeros(simulated.shape, bool)
    is_dark[dark] = True
    y, x = round(found.place.y_px), round(found.place.x_px)
    row = (y, slice(max(0, x - SLICE_HALF_PX), x + SLICE_HALF_PX + 1))
    column = (slice(max(0, y - SLICE_HALF_PX), y + SLICE_HALF_PX + 1), x)

    def along(at: tuple[int | slice, int | slice], start: int, centre_px: float) -> Slice:
        observed: Vector = frame.pixels[at].astype(np.float64)
        offset = start + np.arange(observed.size) - centre_px
        return Slice(np.asarray(offset, np.float64), observed, simulated[at].astype(np.float64), is_dark[at])

    return (
        along(row, row[1].start, found.place.x_px),
        along(column, column[0].start, found.place.y_px),
    )
