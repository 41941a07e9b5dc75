"""Signs of artefacts: structures that a deconvolution made and that are not on the Sun.

There are four signs. A comparison with the image before deconvolution ("the image before") shows that these signs
cannot be real:

    hole        x < 0.02 y (or x <= 0) in a pixel with y > 5 sigma                             Eq. (1)
    overshoot   x > (y + 5 sigma) / h0: no scene without negative light can give this,
                because such a scene has y >= h0 x                                             Eq. (2)
    new extreme |x - med x| > 8 sigma_x in a pixel that is the largest or smallest of 3 x 3 px,
                where the image before is smooth: y - med y has the opposite sign,
                or |y - med y| < sigma                                                         Eq. (3)
    ringing     rise after the first dip of the mean profile around bright sources, in percent
                of the peak, minus the same rise in the image before                           Eq. (4)

med is the median of 5 x 5 px. ALARMS gives for each sign the value from which a person should inspect the image. The
artefact score is the sum of the four signs, each divided by its value in ALARMS. A score below 1 means that nothing was
found. The score ranks the images of a catalogue; it is not a probability.

sigma is computed from the noise of the camera if that noise is known. Otherwise sigma is estimated from the pixels
(Immerkaer 1996). sigma_x is always estimated from the pixels. The estimate uses the second difference in both
directions: for white noise, the standard deviation of this difference is 6 sigma. The pixels are divided into classes
of brightness, and the noise of a class follows from the median absolute value of its second differences. Structure in
the image increases this estimate, so it is an upper limit.

| symbol | name | unit |
|---|---|---|
| y, x | before, after | image unit |
| h0 | peak_weight: the PSF's central weight | - |
| sigma, sigma_x | noise before, noise after | image unit |
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from psfcore.deconvolve.assess import ranks

HOLE_SHARE = 0.02
DETECTION_SIGMA = 5.0
EXTREME_SIGMA = 8.0
# Values from which a person should inspect the image: pixels per million, and percent of the peak of a source.
ALARMS = {"holes_ppm": 100.0, "overshoots_ppm": 100.0, "new_extremes_ppm": 200.0, "ringing_pct": 2.0}
RING_RADIUS_PX = 8
_BLOCK_ROWS = 64
_SOURCES = 100
_FEWEST_SOURCES = 3
_BRIGHTNESS_CLASSES = 16

Plane = NDArray[np.floating]
Flags = NDArray[np.bool_]
Places = tuple[NDArray[np.intp], ...]
NoiseAt = Callable[[Places], Plane]  # the noise of the pixels at these positions [y, x], shape (n,)
Pixels = TypeVar("Pixels", NDArray[np.floating], NDArray[np.bool_])


@dataclass(frozen=True, eq=False)
class Artefacts:
    """Signs of artefacts in one image.

    suspected: pixels [y, x] that show a sign of Eq. (1) to (3). signs: the measured value of each sign, with the names
    of ALARMS; ringing_pct is None if there are fewer than three bright sources. sources: number of bright sources.
    score: artefact score; 0 means no signs, and an image with a score of 1 or more should be inspected.
    """

    suspected: Flags
    signs: dict[str, float | None]
    sources: int
    score: float

    def as_json(self) -> dict[str, object]:
        """Values for JSON, without the plane of suspected pixels."""
        return {"score": self.score, "sources": self.sources, "signs": self.signs, "alarms": ALARMS}


def find_artefacts(
    before: Plane, after: Plane, counted: Flags, peak_weight: float, *, sigma: NoiseAt | None = None
) -> Artefacts:
    """Find signs of artefacts in the counted pixels of `after` [y, x].

    before, after: finite (`filled`), in single precision, which is accurate enough and twice as fast. sigma: function
    that returns the noise of `before` at positions [y, x], in the unit of `before`; None: the noise is estimated from
    the pixels.
    """
    classes = classes_of(before[counted])
    noise_after = noise_levels(after, counted, classes)
    noise_before = sigma or _estimated_noise(before, counted, classes)
    holes = _holes(before, after, counted, noise_before)
    overshoots = _overshoots(before, after, counted, noise_before, peak_weight)
    extremes = counted & _new_extremes(before, after, noise_before, noise_after)
    ringing, sources = ringing_pct(before, after, counted)
    area = max(1, int(np.count_nonzero(counted)))
    signs: dict[str, float | None] = {
        "holes_ppm": 1e6 * int(np.count_nonzero(holes)) / area,
        "overshoots_ppm": 1e6 * int(np.count_nonzero(overshoots)) / area,
        "new_extremes_ppm": 1e6 * int(np.count_nonzero(extremes)) / area,
        "ringing_pct": ringing,
    }
    score = sum((signs[name] or 0.0) / alarm for name, alarm in ALARMS.items())
    return Artefacts(
        suspected=holes | overshoots | extremes, signs=signs, sources=sources, score=float(score)
    )


@dataclass(frozen=True, eq=False)
class BrightnessClasses:
    """Classes of pixels by brightness. All classes have the same number of pixels.

    numbers: the class of each pixel (n,). centres: median brightness of each class; empty: there are no classes.
    """

    numbers: ranks.Groups
    centres: NDArray[np.float64]


def classes_of(brightness: Plane) -> BrightnessClasses:
    """Divide pixels into classes by their brightness (n,). With fewer than 16 pixels there are no classes."""
    values = np.asarray(brightness, dtype=np.float32)
    if values.size < _BRIGHTNESS_CLASSES:
        return BrightnessClasses(np.zeros(values.size, np.uint8), np.empty(0))
    numbers = ranks.parts_of_equal_size(values, _BRIGHTNESS_CLASSES)
    return BrightnessClasses(numbers, ranks.medians(values, numbers, _BRIGHTNESS_CLASSES))


@dataclass(frozen=True, eq=False)
class NoiseLevels:
    """The noise of pixels as a function of their brightness.

    centres, levels: brightness and noise of the classes; empty: no classes. smallest: the noise is not below this
    value.
    """

    centres: Plane
    levels: Plane
    smallest: float

    @property
    def least(self) -> float:
        """The noise of no pixel is below this value."""
        return max(self.smallest, float(self.levels.min()) if self.levels.size else 0.0)

    def at(self, brightness: Plane) -> Plane:
        """The noise of pixels of this brightness."""
        centres = self.centres
        if centres.size == 0:
            return np.full(brightness.shape, self.smallest)
        # The brightest class contains a wide range of brightness. Within it, the noise is assumed to grow like photon
        # noise.
        beyond = np.sqrt(np.maximum(brightness, centres[-1]) / centres[-1]) if centres[-1] > 0 else 1.0
        return np.asarray(np.maximum(np.interp(brightness, centres, self.levels) * beyond, self.smallest))


def noise_levels(pixels: Plane, counted: Flags, classes: BrightnessClasses) -> NoiseLevels:
    """Upper limit of the noise of `pixels` [y, x], which must be finite."""
    second = second_differences(pixels, counted).astype(np.float32, copy=False)
    smallest = 1e-6 * max(float(pixels.max()), -float(pixels.min())) + np.finfo(float).tiny
    levels = 1.4826 * ranks.medians(second, classes.numbers, classes.centres.size)
    return NoiseLevels(classes.centres, levels, smallest)


def _estimated_noise(pixels: Plane, counted: Flags, classes: BrightnessClasses) -> NoiseAt:
    """The noise of pixels, estimated from the pixels themselves, as a function of their brightness."""
    levels = noise_levels(pixels, counted, classes)
    return lambda at: levels.at(pixels[at])


def second_differences(plane: Plane, counted: Flags) -> Plane:
    """The absolute second difference along both axes, divided by 6, of the counted pixels (n,); the plane is mirrored
    at its edges. Sums are in double precision.
    """
    differences = np.empty(np.count_nonzero(counted), plane.dtype)
    first = 0
    for rows, block in _blocks_with_rim(plane, 1, "symmetric"):
        double = block.astype(np.float64)
        along_y = double[:-2] - 2 * double[1:-1] + double[2:]
        both = along_y[:, :-2] - 2 * along_y[:, 1:-1] + along_y[:, 2:]
        chosen = np.abs(both[counted[rows]])
        differences[first : first + chosen.size] = chosen / 6
        first += chosen.size
    return differences


def row_blocks(count: int) -> Iterator[slice]:
    """All rows [0, count) in blocks that stay in the processor's cache."""
    for top in range(0, count, _BLOCK_ROWS):
        yield slice(top, min(top + _BLOCK_ROWS, count))


def _blocks_with_rim(
    plane: Pixels, rim_px: int, rim: Literal["edge", "symmetric"]
) -> Iterator[tuple[slice, Pixels]]:
    """The blocks of `row_blocks`, and their pixels with a rim on all sides. rim: as the mode of `numpy.pad`."""
    padded = np.pad(plane, rim_px, mode=rim)
    for rows in row_blocks(len(plane)):
        yield rows, padded[rows.start : rows.stop + 2 * rim_px]


def ringing_pct(before: Plane, after: Plane, counted: Flags) -> tuple[float | None, int]:
    """Compute Eq. (4); also return the number of bright sources. With fewer than three sources, Eq. (4) is None."""
    sources = _bright_sources(before, counted)
    if len(sources) < _FEWEST_SOURCES:
        return None, len(sources)
    rise_after, rise_before = (_rise(_mean_profile(plane, sources)) for plane in (after, before))
    return 100 * max(0.0, rise_after - rise_before), len(sources)


# The noise is computed only for the few pixels that the other conditions leave.


def _holes(before: Plane, after: Plane, counted: Flags, noise_before: NoiseAt) -> Flags:
    """Find the counted pixels that fulfil Eq. (1)."""
    holes = np.empty_like(counted)
    for rows in row_blocks(len(before)):
        holes[rows] = counted[rows] & (after[rows] < HOLE_SHARE * before[rows])
    places = np.nonzero(holes)
    holes[places] = before[places] > DETECTION_SIGMA * noise_before(places)
    return holes


def _overshoots(
    before: Plane, after: Plane, counted: Flags, noise_before: NoiseAt, peak_weight: float
) -> Flags:
    """Find the counted pixels that fulfil Eq. (2)."""
    overshoots = np.empty_like(counted)
    for rows in row_blocks(len(before)):
        overshoots[rows] = counted[rows] & (after[rows] > before[rows].astype(np.float64) / peak_weight)
    places = np.nonzero(overshoots)
    limit = (before[places] + DETECTION_SIGMA * noise_before(places)) / peak_weight
    overshoots[places] = after[places] > limit
    return overshoots


def _new_extremes(before: Plane, after: Plane, noise_before: NoiseAt, noise_after: NoiseLevels) -> Flags:
    """Find the pixels that fulfil Eq. (3)."""
    extremes = np.zeros(after.shape, dtype=np.bool_)
    for sign, places in _peaks(before, after, noise_after).items():
        limit = EXTREME_SIGMA * noise_after.at(before[places])
        away_after = sign * (after[places] - _medians(after, places))
        away_before = sign * (before[places] - _medians(before, places))
        # A real peak or pit is also visible in the image before, except for the noise.
        extremes[places] |= (away_after > limit) & (away_before < noise_before(places))
    return extremes


def _peaks(before: Plane, after: Plane, noise_after: NoiseLevels) -> dict[int, Places]:
    """The pixels that may fulfil Eq. (3): with 1 those that are the largest of 3 x 3 px, with -1 the smallest ones.

    A median lies between the minimum and the maximum of its pixels. If a pixel differs from both by less than the
    limit, it cannot fulfil Eq. (3). Medians are therefore needed only for the few pixels that are left.
    """
    peaks: dict[int, list[Places]] = {1: [], -1: []}
    for rows, block in _blocks_with_rim(after, 2, "edge"):
        pixels, inner = block[2:-2, 2:-2], block[1:-1, 1:-1]
        for sign, nearest, farthest in ((1, np.maximum, np.minimum), (-1, np.minimum, np.maximum)):
            away = sign * (pixels - _within(block, 2, farthest))
            # The noise is computed only where the smallest noise of all would not be enough. It is rounded differently:
            # the factor.
            y, x = np.nonzero(
                (pixels == _within(inner, 1, nearest)) & (away > 0.999 * EXTREME_SIGMA * noise_after.least)
            )
            left = away[y, x] > EXTREME_SIGMA * noise_after.at(before[rows][y, x])
            peaks[sign].append((y[left] + rows.start, x[left]))
    return {sign: tuple(map(np.concatenate, zip(*of_sign, strict=True))) for sign, of_sign in peaks.items()}


def _maxima(plane: Pixels, radius_px: int) -> Pixels:
    """Largest value of the square of 2 radius_px + 1 px around each pixel [y, x]; near an edge, of its part inside the
    plane.
    """
    return _extremes(plane, radius_px, np.maximum)


def _extremes(plane: Pixels, radius_px: int, chosen: np.ufunc) -> Pixels:
    """As the filters of scipy.ndimage, but several times as fast."""
    extremes = np.empty_like(plane)
    for rows, block in _blocks_with_rim(
        plane, radius_px, "edge"
    ):  # repeated edge pixels do not change the extremes
        extremes[rows] = _within(block, radius_px, chosen)
    return extremes


def _within(block: Pixels, radius_px: int, chosen: np.ufunc) -> Pixels:
    """Extremes of the square around each pixel of a block, without a rim of radius_px."""
    return _slid(_slid(block, radius_px, chosen).T, radius_px, chosen).T


def _slid(rows: Pixels, radius_px: int, chosen: np.ufunc) -> Pixels:
    """Extremes of 2 radius_px + 1 successive rows. The windows double their height until they are high enough."""
    full_height, height = 2 * radius_px + 1, 1
    while height < full_height:
        more = min(height, full_height - height)
        rows = chosen(rows[:-more], rows[more:])
        height += more
    return rows


def _medians(plane: Plane, places: tuple[NDArray[np.intp], ...]) -> Plane:
    """Median of the 5 x 5 px around each position in `places`; the plane is mirrored at its edges."""
    mirrored = np.pad(plane, 2, mode="symmetric")
    windows = np.lib.stride_tricks.sliding_window_view(mirrored, (5, 5))
    return np.asarray(np.median(windows[places].reshape(len(places[0]), 25), axis=1))


def _bright_sources(before: Plane, counted: Flags) -> NDArray[np.int64]:
    """Positions [y, x] of the brightest compact peaks, shape (n, 2).

    A peak is the largest value within RING_RADIUS_PX along both axes.
    """
    inside = np.zeros_like(counted)
    inner = np.s_[RING_RADIUS_PX:-RING_RADIUS_PX]
    inside[inner, inner] = _extremes(counted, RING_RADIUS_PX, np.minimum)[inner, inner]
    peaks = np.argwhere(inside & (before == _maxima(before, RING_RADIUS_PX)))
    height = before[tuple(peaks.T)]
    peaks = peaks[height > 2 * np.maximum(_median_on_circle(before, peaks), 0)]
    order = np.argsort(-before[tuple(peaks.T)], kind="stable")
    return peaks[order[:_SOURCES]]


def _median_on_circle(plane: Plane, places: NDArray[np.int64]) -> Plane:
    """Median of sixteen pixels on a circle around each position [y, x] in `places`."""
    angle = np.arange(16) * np.pi / 8
    rows = places[:, :1] + np.rint(RING_RADIUS_PX * np.sin(angle)).astype(int)
    columns = places[:, 1:] + np.rint(RING_RADIUS_PX * np.cos(angle)).astype(int)
    return np.asarray(np.median(plane[rows, columns], axis=1))


def _mean_profile(plane: Plane, sources: NDArray[np.int64]) -> Plane:
    """Mean radial profile of the sources.

    The profile of a source is the mean of each ring minus the mean of the outermost ring, scaled to a peak of 1. The
    result is the median of these profiles.
    """
    offset = np.arange(-RING_RADIUS_PX, RING_RADIUS_PX + 1)
    ring = np.rint(np.hypot(*np.meshgrid(offset, offset))).astype(int).ravel()
    inside = ring <= RING_RADIUS_PX
    count = np.bincount(ring[inside])
    profiles = []
    for y, x in sources:
        stamp = plane[y + offset[0] : y + offset[-1] + 1, x + offset[0] : x + offset[-1] + 1].ravel()
        means = np.bincount(ring[inside], weights=stamp[inside]) / count
        height = means[0] - means[-1]
        if height > 0:
            profiles.append((means - means[-1]) / height)
    return np.median(profiles, axis=0) if profiles else np.zeros(RING_RADIUS_PX + 1)


def _rise(profile: Plane) -> float:
    """Rise of a profile after its first dip, as a fraction of the peak."""
    falls = np.flatnonzero(np.diff(profile) > 0)
    if falls.size == 0:
        return 0.0
    dip = int(falls[0])
    return float(profile[dip + 1 :].max() - profile[dip])


def filled(plane: Plane) -> Plane:
    """Replace the pixels of a plane that are not finite by the median of the finite pixels."""
    good = np.isfinite(plane)
    if good.all():
        return plane
    return np.where(good, plane, float(np.median(plane[good])) if good.any() else 0.0)
