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
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from psfcore.deconvolve.assess import ranks
from psfcore.deconvolve.assess.compared import Compared, Places, row_blocks, with_rim
from psfcore.shares import in_order

HOLE_SHARE = 0.02
DETECTION_SIGMA = 5.0
EXTREME_SIGMA = 8.0
# Values from which a person should inspect the image: pixels per million, and percent of the peak of a source.
ALARMS = {"holes_ppm": 100.0, "overshoots_ppm": 100.0, "new_extremes_ppm": 200.0, "ringing_pct": 2.0}
RING_RADIUS_PX = 8
_PLACES_AT_ONCE = 4096
_MEDIAN_RADIUS_PX = 2
_SOURCES = 100
_FEWEST_SOURCES = 3
_BRIGHTNESS_CLASSES = 16

Plane = NDArray[np.floating]
Flags = NDArray[np.bool_]
NoiseAt = Callable[[Places], Plane]  # the noise of the pixels at these positions [y, x], shape (n,)
Pixels = TypeVar("Pixels", NDArray[np.floating], NDArray[np.bool_])
Sign = Callable[[slice], Flags]  # the pixels of some rows that show a sign


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


def find_artefacts(pair: Compared, peak_weight: float, *, sigma: NoiseAt | None = None) -> Artefacts:
    """Find signs of artefacts in the compared pixels.

    Parameters
    ----------
    peak_weight
        The central weight of the PSF.
    sigma
        Function that returns the noise before the deconvolution at positions [y, x], in the unit of the image; None:
        the noise is estimated from the pixels.
    """
    before = pair.before
    classes = classes_of(pair.portions(before.__getitem__))
    noise_after = noise_levels(pair, pair.after, classes)
    noise_before, least = (sigma, 0.0) if sigma else _estimated_noise(pair, classes)
    suspected = np.zeros_like(pair.counted)
    counts: dict[str, int] = {}
    for name, sign in (
        ("holes_ppm", _holes(pair, noise_before, least)),
        ("overshoots_ppm", _overshoots(pair, noise_before, peak_weight)),
        ("new_extremes_ppm", _new_extremes(pair, noise_before, noise_after)),
    ):
        counts[name] = _marked(pair, sign, suspected)
    ringing, sources = ringing_pct(pair)
    area = max(1, int(pair.sizes.sum()))
    signs: dict[str, float | None] = {name: 1e6 * count / area for name, count in counts.items()}
    signs["ringing_pct"] = ringing
    score = sum((signs[name] or 0.0) / alarm for name, alarm in ALARMS.items())
    return Artefacts(suspected=suspected, signs=signs, sources=sources, score=float(score))


def _marked(pair: Compared, sign: Sign, suspected: Flags) -> int:
    """Add the pixels with a sign to the suspected ones; the number of pixels with this sign."""

    def marked(n: int) -> int:
        found = sign(pair.blocks[n])
        suspected[pair.blocks[n]] |= found
        return int(np.count_nonzero(found))

    return sum(in_order(marked, len(pair.blocks), pair.threads))


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


def classes_of(brightness: ranks.Portions) -> BrightnessClasses:
    """Divide pixels into classes by their brightness (n,). With fewer than 16 pixels there are no classes."""
    count = int(brightness.sizes.sum())
    if count < _BRIGHTNESS_CLASSES:
        return BrightnessClasses(np.zeros(count, np.uint8), np.empty(0))
    return BrightnessClasses(*ranks.parts_of_equal_size(brightness, _BRIGHTNESS_CLASSES))


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


def noise_levels(pair: Compared, plane: Plane, classes: BrightnessClasses) -> NoiseLevels:
    """Upper limit of the noise of one of the planes of a pair."""
    second = pair.portions(partial(_second_differences, plane), classes.numbers)
    levels = 1.4826 * ranks.medians(second, classes.centres.size)
    largest = max(float(np.abs(plane[rows]).max()) for rows in pair.blocks)
    return NoiseLevels(classes.centres, levels, 1e-6 * largest + np.finfo(float).tiny)


def _estimated_noise(pair: Compared, classes: BrightnessClasses) -> tuple[NoiseAt, float]:
    """The noise before the deconvolution, estimated from the pixels themselves, as a function of their brightness; and
    its smallest value.
    """
    levels = noise_levels(pair, pair.before, classes)
    return lambda at: levels.at(pair.before[at]), levels.least


def second_differences(plane: Plane, counted: Flags) -> Plane:
    """The absolute second difference along both axes, divided by 6, of the counted pixels (n,); the plane is mirrored
    at its edges. Sums are in double precision.
    """
    return np.concatenate(
        [_second_differences(plane, rows)[counted[rows]] for rows in row_blocks(len(counted))]
    )


def _second_differences(plane: Plane, rows: slice) -> Plane:
    """The absolute second differences of some rows [y, x]."""
    double = with_rim(plane, rows, 1).astype(np.float64)
    along_y = double[:-2] - 2 * double[1:-1] + double[2:]
    both = along_y[:, :-2] - 2 * along_y[:, 1:-1] + along_y[:, 2:]
    np.abs(both, out=both)
    both /= 6
    return np.asarray(both)


def ringing_pct(pair: Compared) -> tuple[float | None, int]:
    """Compute Eq. (4); also return the number of bright sources. With fewer than three sources, Eq. (4) is None."""
    sources = _bright_sources(pair)
    if len(sources) < _FEWEST_SOURCES:
        return None, len(sources)
    rise_after, rise_before = (_rise(_mean_profile(plane, sources)) for plane in (pair.after, pair.before))
    return 100 * max(0.0, rise_after - rise_before), len(sources)


# The noise is computed only for the pixels that the other conditions leave. These are few in most images, but they may
# be all pixels, so each sign is looked for in a block of rows at a time.


def _holes(pair: Compared, noise_before: NoiseAt, least: float) -> Sign:
    """The compared pixels that fulfil Eq. (1). No noise before is below `least`."""

    def holes(rows: slice) -> Flags:
        before = pair.before[rows]
        found = pair.counted[rows] & (pair.after[rows] < HOLE_SHARE * before)
        found &= (
            before > 0.999 * DETECTION_SIGMA * least
        )  # the noise of a pixel is rounded differently: the factor
        y, x = _places(found)
        places = (y + rows.start, x)
        found[y, x] = pair.before[places] > DETECTION_SIGMA * noise_before(places)
        return found

    return holes


def _overshoots(pair: Compared, noise_before: NoiseAt, peak_weight: float) -> Sign:
    """The compared pixels that fulfil Eq. (2)."""

    def overshoots(rows: slice) -> Flags:
        found = pair.counted[rows] & (pair.after[rows] > pair.before[rows].astype(np.float64) / peak_weight)
        y, x = _places(found)
        places = (y + rows.start, x)
        limit = (pair.before[places] + DETECTION_SIGMA * noise_before(places)) / peak_weight
        found[y, x] = pair.after[places] > limit
        return found

    return overshoots


def _new_extremes(pair: Compared, noise_before: NoiseAt, noise_after: NoiseLevels) -> Sign:
    """The compared pixels that fulfil Eq. (3).

    A median lies between the minimum and the maximum of its pixels. If a pixel differs from both by less than the
    limit, it cannot fulfil Eq. (3). Medians are therefore needed only for the pixels that are left.
    """

    def extremes(rows: slice) -> Flags:
        block_before, block = (
            with_rim(plane, rows, _MEDIAN_RADIUS_PX) for plane in (pair.before, pair.after)
        )
        before, counted = pair.before[rows], pair.counted[rows]
        found = np.zeros_like(counted)
        for sign in (1, -1):
            y, x = _peaks(block, before, noise_after, sign)
            counted_here = counted[y, x]
            for portion in _portions(y[counted_here], x[counted_here]):
                limit = EXTREME_SIGMA * noise_after.at(before[portion])
                away_after = sign * _differences(block, portion) > limit[:, None]
                # A real peak or pit is also visible in the image before, except for the noise.
                noise = noise_before((portion[0] + rows.start, portion[1]))
                smooth_before = sign * _differences(block_before, portion) < noise[:, None]
                found[portion] |= _mostly(away_after) & _mostly(smooth_before)
        return found

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
    y, x = _places(
        (pixels == _within(inner, 1, nearest)) & (away > 0.999 * EXTREME_SIGMA * noise_after.least)
    )
    left = away[y, x] > EXTREME_SIGMA * noise_after.at(before[y, x])
    return y[left], x[left]


def _places(flags: Flags) -> Places:
    """The positions [y, x] of flags, as `numpy.nonzero` gives them, but faster for few flags of many."""
    return np.divmod(np.flatnonzero(flags), flags.shape[1])


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


def _bright_sources(pair: Compared) -> NDArray[np.int64]:
    """Positions [y, x] of the brightest compact peaks, shape (n, 2): those that are more than twice as bright as the
    circle around them.
    """
    before = pair.before
    peaks = np.argwhere(_first_of_equals(pair, _largest_around(pair)))
    peaks = peaks[np.argsort(-before[tuple(peaks.T)], kind="stable")]
    sources = peaks[:0]
    for (portion,) in _portions(peaks):  # the brightest first: hardly ever is more than one portion needed
        bright = before[tuple(portion.T)] > 2 * np.maximum(_median_on_circle(before, portion), 0)
        sources = np.concatenate([sources, portion[bright]])[:_SOURCES]
        if len(sources) == _SOURCES:
            break
    return sources


def _largest_around(pair: Compared) -> Flags:
    """Find the pixels [y, x] that are the largest within RING_RADIUS_PX along both axes, where all pixels are
    compared and inside the plane.
    """
    counted, radius = pair.counted, RING_RADIUS_PX

    def largest(rows: slice) -> Flags:
        block = with_rim(pair.before, rows, radius)
        found = block[radius:-radius, radius:-radius] == _within(block, radius, np.maximum)
        if not counted[max(rows.start - radius, 0) : rows.stop + radius].all():
            found &= _within(with_rim(counted, rows, radius), radius, np.minimum)
        found[:, :radius] = found[:, -radius:] = False
        return np.asarray(found)

    found = _by_rows(pair, largest)
    found[:radius] = found[-radius:] = False
    return found


def _by_rows(pair: Compared, of: Sign) -> Flags:
    """The flags [y, x] that a function finds in blocks of rows."""
    return np.concatenate(in_order(lambda n: of(pair.blocks[n]), len(pair.blocks), pair.threads))


def _first_of_equals(pair: Compared, largest: Flags) -> Flags:
    """Of the largest pixels [y, x] around, those without another one in the rows above or to the left, within
    RING_RADIUS_PX along both axes. Two such pixels are equally bright. A plateau would otherwise have as many peaks as
    pixels.
    """
    radius = RING_RADIUS_PX

    def first(rows: slice) -> Flags:
        block = with_rim(largest, rows, radius)
        above = _slid(_slid(block[: -radius - 1], radius, np.maximum).T, 2 * radius + 1, np.maximum).T
        left = _slid(block[radius:-radius, : -radius - 1].T, radius, np.maximum).T
        return np.asarray(largest[rows] & ~(above | left))

    return _by_rows(pair, first)


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
        stamp = plane[y + offset[0] : y + offset[-1] + 1][:, x + offset[0] : x + offset[-1] + 1].ravel()
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
