"""The position of the occulter, found by simulating the occulter in front of the scene that other images show.

Hofmeister et al., The point-spread function of HRI_EUV, section "The inversion algorithm", step (e). The scene behind
the occulter of frame i comes from its neighbours: frames of the same pointing, nearest in time, that show this scene.
The light that a disc hides in this scene is convolved with the PSF and subtracted:

    m = scale Q + level - H (P c)                                                                   Eq. (1)
    chi2 = sum (y - m)^2 / var + ((x - x0)^2 + (y - y0)^2) / s^2 + (scale - 1)^2 / t^2              Eq. (2)

Q is the mean of the observed images of the neighbours, and P the mean of their deconvolved scenes. c is the share of a
pixel that the disc covers, and H the convolution with the PSF on the patch. (x, y) is the centre of the disc, (x0, y0)
the centre from the ephemeris. Scale and level are fitted too, so that smooth differences around the disc do not shift
the position. Such differences come, for example, from another gain, or from light that the neighbours' occulters hide.
The paper moves the disc until the simulation looks best; here Gauss-Newton steps minimise Eq. (2).

If no neighbour shows the scene, Q and P are the mean of a ring around the disc in the frame itself.

| symbol | name | unit |
|---|---|---|
| y, var (in the sum) | observed, variance: patch around the position from the ephemeris | DN/s, (DN/s)^2 |
| c | coverage | - |
| s | EPHEMERIS_SIGMA_PX | px |
| t | SCALE_SIGMA | - |
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from psfcore.arrays import scaled_inverse
from psfcore.convolution.convolver import Convolver
from psfcore.noise import Noise
from psfcore.transit.transit import Frame, Place

Plane = NDArray[np.float64]
Window = tuple[slice, slice]

EPHEMERIS_SIGMA_PX = 1.0
LEAST_NEIGHBOURS = 4  # their mean adds a quarter to the variance of the frame; the paper's two add half
ENOUGH_PHOTONS = 300.0  # photons per pixel in all neighbours together: a faint scene needs more neighbours
# The largest noise of a mean scene P, as a fraction of its mean. A noisier P is smoothed; otherwise the disc would be
# fitted to the noise.
LARGEST_TEMPLATE_NOISE = 0.3
LARGEST_SMOOTHING_PX = 8.0
PATCH_MARGIN_PX = 9
LARGEST_SHIFT_PX = 5.0
SETTLED_PX = 1e-3
STEPS = 30
LEAST_DEPTH = 0.5
SCALE_SIGMA = 0.02  # the brightness of images of one pointing differs by one or two percent
DOUBT_SIGMAS = 3.0
UNDESCRIBED = 4.0  # if chi2 per pixel is larger, the simulation does not describe the patch
DAMPED_FROM = 6  # from this step on each step is halved: steps may oscillate where the scene is faint
DECONVOLUTION_NOISE = 2.3  # factor by which a deconvolution increases noise, for a core weight of 0.43
# Least intensity, DN/s: a patch without light has no photon noise, and a noise that was measured can have no read
# noise.
LEAST_LEVEL = 1e-6
_STRIPS = 32
_DIFFERENCE_PX = 0.05


class Windowed(Protocol):
    """An array [y, x] of which windows can be read."""

    def __getitem__(self, window: Window, /) -> NDArray[np.float32]: ...


@dataclass(frozen=True)
class FoundPlace:
    """The position of an occulter with its errors (px, each axis), and how it was found.

    The errors from the patch are multiplied by sqrt(chi2_per_pixel) if this factor is above 1.

    Attributes
    ----------
    neighbours
        Number of frames that show the scene behind the occulter; 0 if the ring around the disc was used.
    settled
        Whether the steps converged.
    depth
        The missing light divided by the light that a disc would hide; 1 with an occulter, 0 without an occulter.
    depth_sigma
        The error of `depth`.
    within_reach
        Whether the position is near enough to the ephemeris.
    """

    place: Place
    sigma_x_px: float
    sigma_y_px: float
    chi2_per_pixel: float
    neighbours: int
    steps_done: int
    settled: bool
    depth: float = 1.0
    depth_sigma: float = 0.0
    within_reach: bool = True

    @property
    def seen(self) -> bool:
        """Whether the patch may contain an occulter.

        The result is False in three cases: depth is below LEAST_DEPTH by more than DOUBT_SIGMAS standard errors; the
        search ended at its limit LARGEST_SHIFT_PX; or the simulation does not describe the patch and the position
        differs from the ephemeris by more than DOUBT_SIGMAS standard errors of the ephemeris.
        """
        return self.within_reach and self.depth + DOUBT_SIGMAS * self.depth_sigma >= LEAST_DEPTH


def coverage(shape: tuple[int, int], place: Place) -> Plane:
    """The share of each pixel [y, x] that a disc covers, 0 to 1: exact chords in x, averaged over strips in y."""
    rows, columns = patch_window(shape, place, 1.0)  # no pixel outside this window is covered
    strip = (np.arange(rows.start * _STRIPS, rows.stop * _STRIPS) + 0.5) / _STRIPS - 0.5
    half = np.sqrt(np.maximum(place.radius_px**2 - (strip - place.y_px) ** 2, 0.0))
    edges = np.arange(columns.start, columns.stop + 1) - 0.5 - place.x_px
    # The part of each chord that is left of an edge, from the middle of the chord; a pixel covers the part between its
    # edges.
    until = np.clip(edges, -half[:, None], half[:, None])
    out = np.zeros(shape)
    out[rows, columns] = np.diff(until.reshape(-1, _STRIPS, edges.size).mean(axis=1), axis=1)
    return out


def fully_dark(shape: tuple[int, int], place: Place, margin_px: float = 0.0) -> NDArray[np.bool_]:
    """True for pixels [y, x] whose farthest corner is inside the disc by at least margin_px."""
    rows, columns = patch_window(shape, place, max(-margin_px, 0.0))  # no pixel outside this window is inside
    y = np.abs(np.arange(rows.start, rows.stop) - place.y_px)[:, None] + 0.5
    x = np.abs(np.arange(columns.start, columns.stop) - place.x_px)[None, :] + 0.5
    dark = np.zeros(shape, dtype=bool)
    dark[rows, columns] = np.hypot(y, x) <= place.radius_px - margin_px
    return dark


def disc_distance(shape: tuple[int, int], place: Place) -> Plane:
    """The distance of the centre of each pixel [y, x] from the centre of the occulter, px."""
    y = np.arange(shape[0]) - place.y_px
    x = np.arange(shape[1]) - place.x_px
    return np.asarray(np.hypot(y[:, None], x[None, :]))


def patch_window(shape: tuple[int, int], place: Place, margin_px: float = PATCH_MARGIN_PX) -> Window:
    """The rows and columns of the square around a disc, cut to the frame."""
    reach = place.radius_px + margin_px
    bounds = [
        slice(min(max(0, round(centre - reach)), size), min(max(0, round(centre + reach) + 1), size))
        for centre, size in ((place.y_px, shape[0]), (place.x_px, shape[1]))
    ]
    return bounds[0], bounds[1]


def neighbours_of(index: int, frames: Sequence[Frame], places: Sequence[Place], noise: Noise) -> list[int]:
    """The frames of the same pointing, nearest in time, whose occulters do not overlap the patch of this one.

    At least LEAST_NEIGHBOURS such frames are chosen, if the transit has enough. More are chosen until all of them
    together have ENOUGH_PHOTONS photons per pixel.
    """
    here, frame = places[index], frames[index]
    reach = here.radius_px + PATCH_MARGIN_PX
    free = [
        k
        for k, (other, there) in enumerate(zip(frames, places, strict=True))
        if k != index
        and other.pointing == frame.pointing
        and max(abs(there.x_px - here.x_px), abs(there.y_px - here.y_px)) > reach + there.radius_px
    ]
    free.sort(key=lambda k: (abs(frames[k].time_s - frame.time_s), k))
    window = patch_window(frame.pixels.shape, here)
    chosen: list[int] = []
    photons = 0.0
    for k in free:
        if len(chosen) >= LEAST_NEIGHBOURS and photons >= ENOUGH_PHOTONS:
            break
        level = float(frames[k].pixels[window].mean(dtype=np.float64))
        # The square of signal / noise: the number of photons, reduced because of the read noise. An image without light
        # has no photons; its mean can be negative if an effect that is too strong was subtracted.
        if level > 0:
            photons += level**2 / float(noise.variance(np.array(level), frames[k].exposure_s))
        chosen.append(k)
    return chosen


def find_occulter(
    index: int,
    frames: Sequence[Frame],
    scene_of: Callable[[int], Windowed],
    places: Sequence[Place],
    psf_kernel: Plane,
    noise: Noise,
) -> FoundPlace:
    """Find the position of the occulter in frame `index`.

    Parameters
    ----------
    scene_of
        Function of the index of a frame that returns the deconvolved frame [y, x], DN/s; only a window of it is read.
    places
        The best known positions of the occulter in all frames; they decide which frames are neighbours.
    psf_kernel
        Weights [y, x] of the PSF, centre at [n // 2, n // 2].
    """
    frame, start = frames[index], frames[index].place
    window = patch_window(frame.pixels.shape, start)
    observed = frame.pixels[window].astype(np.float64)
    neighbours = neighbours_of(index, frames, places, noise)
    if neighbours:
        share = _shares(neighbours, frames, window, noise)
        seen, behind = (
            sum(w * p[window].astype(np.float64) for w, p in zip(share, planes, strict=True))
            for planes in ([frames[k].pixels for k in neighbours], [scene_of(k) for k in neighbours])
        )
        neighbours_noise = sum(
            w**2 * noise.variance(_level(seen), frames[k].exposure_s)
            for w, k in zip(share, neighbours, strict=True)
        )
        behind = _quiet(behind, float(np.sqrt(np.mean(neighbours_noise))) * DECONVOLUTION_NOISE)
    else:
        seen = behind = np.full(observed.shape, _ring_mean(frame, start, window))
        neighbours_noise = np.zeros(observed.shape)
    simulated = _SimulatedDisc(seen, behind, psf_kernel)
    local = Place(start.x_px - window[1].start, start.y_px - window[0].start, start.radius_px)

    def variance(model: Plane) -> Plane:
        return np.asarray(noise.variance(_level(model), frame.exposure_s) + neighbours_noise)

    solution = _solve(simulated, observed, variance, local, len(neighbours))
    x_px, y_px = solution.place.x_px + window[1].start, solution.place.y_px + window[0].start
    return replace(solution, place=Place(x_px, y_px, start.radius_px))


def _shares(
    chosen: Sequence[int], frames: Sequence[Frame], window: Window, noise: Noise
) -> NDArray[np.float64]:
    """The weights of the neighbouring images in their mean. The sum is 1; long exposures have larger weights."""
    mean = np.mean([frames[k].pixels[window].mean(dtype=np.float64) for k in chosen])
    level = np.array(max(mean, LEAST_LEVEL))
    weight = np.array([1 / float(noise.variance(level, frames[k].exposure_s)) for k in chosen])
    return np.asarray(weight / weight.sum())


class _SimulatedDisc:
    """The simulation of Eq. (1) on a patch."""

    def __init__(self, seen: Plane, behind: Plane, psf_kernel: Plane) -> None:
        self.seen, self.behind = seen, behind
        ny, nx = seen.shape
        self._blur = Convolver(psf_kernel, (ny, nx), dtype=np.float64)

    def hidden(self, x_px: float, y_px: float, radius_px: float) -> Plane:
        """H (P c): the light that a disc removes."""
        covered = coverage((self.seen.shape[0], self.seen.shape[1]), Place(x_px, y_px, radius_px))
        return np.asarray(self._blur.apply(self.behind * covered))


def _solve(
    disc: _SimulatedDisc,
    observed: Plane,
    variance: Callable[[Plane], Plane],
    start: Place,
    neighbours: int,
) -> FoundPlace:
    """Minimise Eq. (2) by Gauss-Newton steps. Weights come from the simulation; the observed noise would bias them.

    The fitted values `at` are x and y on the patch, scale and level.
    """
    at = np.array([start.x_px, start.y_px, 1.0, 0.0])
    origin, radius = at.copy(), start.radius_px
    # Noise of the neighbours would bias a free scale towards 0, and the rest of the scene's gradient would shift the
    # disc.
    prior = np.diag([EPHEMERIS_SIGMA_PX**-2, EPHEMERIS_SIGMA_PX**-2, SCALE_SIGMA**-2, 0.0])
    h = _DIFFERENCE_PX
    settled, done = False, 0
    while done < STEPS and not settled:
        x, y = at[0], at[1]
        model = at[2] * disc.seen + at[3] - disc.hidden(x, y, radius)
        misfit, weight = observed - model, 1 / variance(model)
        slopes = np.array(
            [
                (disc.hidden(x - h, y, radius) - disc.hidden(x + h, y, radius)) / (2 * h),
                (disc.hidden(x, y - h, radius) - disc.hidden(x, y + h, radius)) / (2 * h),
                disc.seen,
                np.ones_like(observed),
            ]
        ).reshape(4, -1)
        weighted = slopes * weight.ravel()
        normal = weighted @ slopes.T
        # If the Sun changed between the images, the neighbours do not describe the patch. Then the patch gets a smaller
        # weight and the ephemeris a larger one.
        scaled_prior = prior.copy()
        scaled_prior[:2, :2] *= _excess(weight, misfit)
        step = np.linalg.lstsq(
            normal + scaled_prior, weighted @ misfit.ravel() + scaled_prior @ (origin - at), rcond=None
        )[0]
        step[:2] = np.clip(step[:2], -1.0, 1.0) * (0.5 if done >= DAMPED_FROM else 1.0)
        at = at + step
        at[:2] = np.clip(at[:2], origin[:2] - LARGEST_SHIFT_PX, origin[:2] + LARGEST_SHIFT_PX)
        done += 1
        settled = bool(np.abs(step[:2]).max() < SETTLED_PX)
    hidden = disc.hidden(at[0], at[1], radius)
    model = at[2] * disc.seen + at[3] - hidden
    misfit, weight = observed - model, 1 / variance(model)
    # The depth is fitted together with the scale, because both dim the whole patch.
    templates = np.array([-hidden, disc.seen]).reshape(2, -1)
    normal_2 = (templates * weight.ravel()) @ templates.T
    inverse = scaled_inverse(normal_2)
    more = inverse @ (templates * weight.ravel()) @ misfit.ravel()
    excess = _excess(weight, misfit)
    sigma = np.sqrt(np.diag(scaled_inverse(normal / excess + prior)))
    chi2_per_pixel = float(np.sum(weight * misfit**2)) / observed.size
    # If the simulation does not describe the patch, the position may be wrong. Then it must be near the ephemeris.
    described = chi2_per_pixel < UNDESCRIBED
    reach_px = LARGEST_SHIFT_PX - 1e-6 if described else DOUBT_SIGMAS * EPHEMERIS_SIGMA_PX
    return FoundPlace(
        place=Place(float(at[0]), float(at[1]), radius),
        sigma_x_px=float(sigma[0]),
        sigma_y_px=float(sigma[1]),
        chi2_per_pixel=chi2_per_pixel,
        neighbours=neighbours,
        steps_done=done,
        settled=settled,
        depth=float(1 + more[0]),
        depth_sigma=float(np.sqrt(inverse[0, 0] * excess)),
        within_reach=bool(np.abs(at[:2] - origin[:2]).max() < reach_px),
    )


def _excess(weight: Plane, misfit: Plane) -> float:
    """The variance of the misfit divided by the variance of the noise, at least 1.

    The ratio is above 1 if the ring replaces the scene, or if the scene changed.
    """
    return max(float(np.mean(weight * misfit**2)), 1.0)


def _ring_mean(frame: Frame, place: Place, window: Window) -> float:
    """The mean of the unocculted ring from 3 to 9 px outside the disc."""
    local = Place(place.x_px - window[1].start, place.y_px - window[0].start, place.radius_px)
    patch = frame.pixels[window]
    distance = disc_distance((patch.shape[0], patch.shape[1]), local) - place.radius_px
    return float(patch[(distance > 3) & (distance < PATCH_MARGIN_PX)].mean(dtype=np.float64))


def _level(plane: Plane) -> Plane:
    """The expected intensity: the plane smoothed by a Gaussian with sigma 3 px, at least a twentieth of the mean."""
    least = max(0.05 * float(plane.mean()), LEAST_LEVEL)
    return np.asarray(np.maximum(gaussian_filter(plane, 3.0), least))


def _quiet(plane: Plane, noise_per_pixel: float) -> Plane:
    """The plane, smoothed if its noise is more than LARGEST_TEMPLATE_NOISE of its mean.

    A Gaussian of width sigma reduces white noise by a factor 2 sqrt(pi) sigma.
    """
    largest_noise = LARGEST_TEMPLATE_NOISE * max(float(plane.mean()), 1e-30)
    sigma = noise_per_pixel / largest_noise / (2 * np.sqrt(np.pi))
    if sigma * 2 * np.sqrt(np.pi) <= 1:
        return plane
    return np.asarray(gaussian_filter(plane, min(sigma, LARGEST_SMOOTHING_PX)))
