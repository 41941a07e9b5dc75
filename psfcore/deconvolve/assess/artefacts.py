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
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from psfcore.deconvolve.assess import ranks
from psfcore.deconvolve.edges import inside_band

HOLE_SHARE = 0.02
DETECTION_SIGMA = 5.0
EXTREME_SIGMA = 8.0
# Values from which a person should inspect the image: pixels per million, and percent of the peak of a source.
ALARMS = {"holes_ppm": 100.0, "overshoots_ppm": 100.0, "new_extremes_ppm": 200.0, "ringing_pct": 2.0}
RING_RADIUS_PX = 8
_BLOCK_ROWS = 64
_PLACES_AT_ONCE = 4096
_MEDIAN_RADIUS_PX = 2
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

    Attributes
    ----------
    suspected
        Pixels [y, x] that show a sign of Eq. (1) to (3).
    signs
        The measured value of each sign, with the names of ALARMS; ringing_pct is None if there are fewer than three
        bright sources.
    sources
        Number of bright sources.
    score
        Artefact score; 0 means no signs, and an image with a score of 1 or more should be inspected.
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

    Parameters
    ----------
    before, after
        The images [y, x], finite (`filled`), in single precision, which is accurate enough and twice as fast.
    sigma
        Function that returns the noise of `before` at positions [y, x], in the unit of `before`; None: the noise is
        estimated from the pixels.
    """
    classes = classes_of(before[counted])
    noise_after = noise_levels(after, counted, classes)
    noise_before = sigma or _estimated_noise(before, counted, classes)
    holes = _holes(before, after, counted, noise_before)
    overshoots = _overshoots(before, after, counted, noise_before, peak_weight)
    extremes = _new_extremes(before, after, counted, noise_before, noise_after)
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

    Attributes
    ----------
    numbers
        The class of each pixel (n,).
    centres
        Median brightness of each class; empty: there are no classes.
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

    Attributes
    ----------
    centres, levels
        Brightness and noise of the classes; empty: no classes.
    smallest
        The lower limit of the noise.
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
    """The blocks of `row_blocks`, and their pixels with a rim on all sides.

    Parameters
    ----------
    rim
        How the rim is filled, as a mode of `numpy.pad`.
    """
    for rows in row_blocks(len(plane)):
        first, last = max(rows.start - rim_px, 0), min(rows.stop + rim_px, len(plane))
        missing = (rim_px - (rows.start - first), rim_px - (last - rows.stop))
        yield rows, np.pad(plane[first:last], (missing, (rim_px, rim_px)), mode=rim)


def ringing_pct(before: Plane, after: Plane, counted: Flags) -> tuple[float | None, int]:
    """Compute Eq. (4); also return the number of bright sources. With fewer than three sources, Eq. (4) is None."""
    sources = _bright_sources(before, counted)
    if len(sources) < _FEWEST_SOURCES:
        return None, len(sources)
    rise_after, rise_before = (_rise(_mean_profile(plane, sources)) for plane in (after, before))
    return 100 * max(0.0, rise_after - rise_before), len(sources)


# The noise is computed only for the pixels that the other conditions leave. These are few in most images, but they may
# be all pixels, so each function looks at a block of rows at a time.


def _holes(before: Plane, after: Plane, counted: Flags, noise_before: NoiseAt) -> Flags:
    """Find the counted pixels that fulfil Eq. (1)."""
    holes = np.zeros_like(counted)
    for rows in row_blocks(len(before)):
        y, x = np.nonzero(counted[rows] & (after[rows] < HOLE_SHARE * before[rows]))
        places = (y + rows.start, x)
        holes[places] = before[places] > DETECTION_SIGMA * noise_before(places)
    return holes


def _overshoots(
    before: Plane, after: Plane, counted: Flags, noise_before: NoiseAt, peak_weight: float
) -> Flags:
    """Find the counted pixels that fulfil Eq. (2)."""
    overshoots = np.zeros_like(counted)
    for rows in row_blocks(len(before)):
        y, x = np.nonzero(counted[rows] & (after[rows] > before[rows].astype(np.float64) / peak_weight))
        places = (y + rows.start, x)
        limit = (before[places] + DETECTION_SIGMA * noise_before(places)) / peak_weight
        overshoots[places] = after[places] > limit
    return overshoots


def _new_extremes(
    before: Plane, after: Plane, counted: Flags, noise_before: NoiseAt, noise_after: NoiseLevels
) -> Flags:
    """Find the counted pixels that fulfil Eq. (3).

    A median lies between the minimum and the maximum of its pixels. If a pixel differs from both by less than the
    limit, it cannot fulfil Eq. (3). Medians are therefore needed only for the pixels that are left.
    """
    extremes = np.zeros_like(counted)
    blocks = (_blocks_with_rim(plane, _MEDIAN_RADIUS_PX, "symmetric") for plane in (before, after))
    for (rows, block_before), (_, block) in zip(*blocks, strict=True):
        for sign in (1, -1):
            y, x = _peaks(block, before[rows], noise_after, sign)
            counted_here = counted[rows][y, x]
            for portion in _portions(y[counted_here], x[counted_here]):
                places = (portion[0] + rows.start, portion[1])
                limit = EXTREME_SIGMA * noise_after.at(before[places])
                away_after = sign * _differences(block, portion) > limit[:, None]
                # A real peak or pit is also visible in the image before, except for the noise.
                smooth_before = sign * _differences(block_before, portion) < noise_before(places)[:, None]
                extremes[places] |= _mostly(away_after) & _mostly(smooth_before)
    return extremes


def _peaks(block: Plane, before: Plane, noise_after: NoiseLevels, sign: int) -> Places:
    """The pixels of a block that may fulfil Eq. (3): for the sign 1 those that are the largest of 3 x 3 px, for -1 the
    smallest ones.

    Parameters
    ----------
    block
        Rows of the image after deconvolution, with a rim of 2 px.
    before
        The same rows of the image before deconvolution.
    """
    nearest, farthest = (np.maximum, np.minimum) if sign > 0 else (np.minimum, np.maximum)
    pixels, inner = block[2:-2, 2:-2], block[1:-1, 1:-1]
    away = sign * (pixels - _within(block, _MEDIAN_RADIUS_PX, farthest))
    # The noise is computed only where the smallest noise of all would not be enough. It is rounded differently: the
    # factor.
    y, x = np.nonzero(
        (pixels == _within(inner, 1, nearest)) & (away > 0.999 * EXTREME_SIGMA * noise_after.least)
    )
    left = away[y, x] > EXTREME_SIGMA * noise_after.at(before[y, x])
    return y[left], x[left]


def _portions(*arrays: NDArray[Any]) -> Iterator[tuple[NDArray[Any], ...]]:
    """Arrays (n,) of the same length, cut into portions of at most _PLACES_AT_ONCE."""
    for first in range(0, len(arrays[0]), _PLACES_AT_ONCE):
        yield tuple(values[first : first + _PLACES_AT_ONCE] for values in arrays)


def _differences(block: Plane, places: Places) -> Plane:
    """The pixels at these positions minus each pixel of the 5 x 5 px around them, (n, 25).

    Parameters
    ----------
    block
        Some rows with a rim of 2 px; the positions do not count the rim.
    """
    side = 2 * _MEDIAN_RADIUS_PX + 1
    around = np.lib.stride_tricks.sliding_window_view(block, (side, side))[places].reshape(-1, side**2)
    return np.asarray(around[:, side**2 // 2, None] - around)


def _mostly(fulfilled: Flags) -> Flags:
    """Whether more than half of an odd number of values fulfil a condition, (n,). If the condition is a limit, their
    median then fulfils it too, and no value is sorted.
    """
    return np.asarray(np.count_nonzero(fulfilled, axis=1) > fulfilled.shape[1] // 2)


def _within(block: Pixels, radius_px: int, chosen: np.ufunc) -> Pixels:
    """Extremes of the square around each pixel of a block, without a rim of radius_px."""
    width = 2 * radius_px + 1
    return _slid(_slid(block, width, chosen).T, width, chosen).T


def _slid(rows: Pixels, count: int, chosen: np.ufunc) -> Pixels:
    """Extremes of `count` successive rows. The windows double their height until they are high enough."""
    height = 1
    while height < count:
        more = min(height, count - height)
        rows = chosen(rows[:-more], rows[more:])
        height += more
    return rows


def _bright_sources(before: Plane, counted: Flags) -> NDArray[np.int64]:
    """Positions [y, x] of the brightest compact peaks, shape (n, 2): those that are more than twice as bright as the
    circle around them.
    """
    peaks = np.argwhere(_first_of_equals(_largest_around(before, counted)))
    peaks = peaks[np.argsort(-before[tuple(peaks.T)], kind="stable")]
    sources = peaks[:0]
    for (portion,) in _portions(peaks):  # the brightest first: hardly ever is more than one portion needed
        bright = before[tuple(portion.T)] > 2 * np.maximum(_median_on_circle(before, portion), 0)
        sources = np.concatenate([sources, portion[bright]])[:_SOURCES]
        if len(sources) == _SOURCES:
            break
    return sources


def _largest_around(plane: Plane, counted: Flags) -> Flags:
    """Find the pixels [y, x] that are the largest within RING_RADIUS_PX along both axes, where all pixels are
    counted and inside the plane.
    """
    largest = np.zeros_like(counted)
    blocks = zip(
        _blocks_with_rim(plane, RING_RADIUS_PX, "edge"),
        _blocks_with_rim(counted, RING_RADIUS_PX, "edge"),
        strict=True,
    )
    for (rows, block), (_, counted_block) in blocks:
        largest[rows] = plane[rows] == _within(block, RING_RADIUS_PX, np.maximum)
        largest[rows] &= _within(counted_block, RING_RADIUS_PX, np.minimum)
    inside = inside_band(largest.shape, RING_RADIUS_PX)
    return np.asarray(largest & inside)


def _first_of_equals(largest: Flags) -> Flags:
    """Of the largest pixels [y, x] around, those without another one in the rows above or to the left, within
    RING_RADIUS_PX along both axes. Two such pixels are equally bright. A plateau would otherwise have as many peaks as
    pixels.
    """
    first, radius = np.zeros_like(largest), RING_RADIUS_PX
    for rows, block in _blocks_with_rim(largest, radius, "edge"):
        above = _slid(_slid(block[: -radius - 1], radius, np.maximum).T, 2 * radius + 1, np.maximum).T
        left = _slid(block[radius:-radius, : -radius - 1].T, radius, np.maximum).T
        first[rows] = largest[rows] & ~(above | left)
    return first


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
