"""Sums of an image over the segments of the PSF that are centred on many target pixels.

Hofmeister et al., The point-spread function of HRI_EUV, "The inversion algorithm", step (h):

    A_S[r] = sum over dr in S of I[r - dr]                                                   Eq. (1)

for targets r, with I = 0 beyond the image. In each row, a segment consists of a few runs of adjacent pixels. Running sums
P along the rows of the image are computed first. Each run then costs one difference, independent of its length:

    P[y, i] = sum over x < i of I[y, x]                                                      Eq. (2)
    sum over dx_start <= dx < dx_stop of I[y, x - dx] = P[y, x - dx_start + 1] - P[y, x - dx_stop + 1]    Eq. (3)

Targets are grouped into strips of up to 24 adjacent pixels of a row. The targets of a strip read adjacent values of P, so
the sums of a strip are vector operations. Image rows are processed four at a time. Their running sums stay in the cache
while all strips use them.

| symbol | name |
|---|---|
| I | image[y, x] |
| r | targets, (y, x) |
| dr = (dx, dy) | offset, target minus source, px |
| P | running |
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from psfcore.compiled import compiled
from psfcore.errors import DataError
from psfcore.scatter.as_published.segments import Runs, Segments

LANES = 24
_ROWS = 4
_VECTOR = 4  # the number of lanes (pixels) of a strip is a multiple of this number
_LARGEST_SUMS = 2**20  # largest array of sums that one thread keeps at a time: 8 MiB

Sums = NDArray[np.float64]


def segment_sums(
    image: NDArray[np.floating], targets: NDArray[np.integer], segments: Segments, *, threads: int = 1
) -> Sums:
    """A_S of Eq. (1), array (n, segments.size), in the image's unit times px^2; exact to float64 rounding.

    image: [y, x], float32 or float64; it is taken as 0 beyond its edges. targets: (n, 2), the (y, x) of each target on the
    image, in any order. threads: number of threads that share the targets; it does not change the result. Raises
    DataError "image-nonfinite" if a pixel is NaN or infinite, and ValueError if the image does not have two axes or a
    target lies outside it.
    """
    _check(image, targets)
    out = np.zeros((len(targets), segments.size))
    if len(targets) == 0:
        return out
    image = np.ascontiguousarray(image, dtype=np.float32 if image.dtype == np.float32 else np.float64)
    order = np.lexsort((targets[:, 1], targets[:, 0]))
    ordered = np.ascontiguousarray(targets[order], dtype=np.int64)
    strip, strip_yx = _strips(ordered)
    runs = segments.runs
    if runs.segment.size == 0:
        return out
    places = _places(strip_yx, runs)

    def work(part: slice) -> None:
        mine = slice(*np.searchsorted(strip, (part.start, part.stop)))
        lane = ordered[mine, 1] - strip_yx[strip[mine], 1]
        lanes = -(-(int(lane.max()) + 1) // _VECTOR) * _VECTOR
        sums = np.zeros((part.stop - part.start, segments.size, lanes))
        _sum_strips(image, strip_yx[part], runs, places, sums)
        out[order[mine]] = sums[strip[mine] - part.start, :, lane]

    largest = max(1, _LARGEST_SUMS // (segments.size * LANES))
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, _parts(len(strip_yx), threads, largest)))
    return out


def _check(image: NDArray[np.floating], targets: NDArray[np.integer]) -> None:
    if image.ndim != 2:
        raise ValueError(f"expected an image with two axes; got shape {image.shape}")
    if targets.ndim != 2 or targets.shape[1] != 2 or not np.issubdtype(targets.dtype, np.integer):
        raise ValueError(f"expected integer targets of shape (n, 2); got {targets.shape} of {targets.dtype}")
    if not ((targets >= 0) & (targets < image.shape)).all():
        raise ValueError(f"expected targets (y, x) inside the image of {image.shape}; got one outside it")
    if not np.isfinite(image).all():
        bad = int(np.count_nonzero(~np.isfinite(image)))
        raise DataError(
            "image-nonfinite", f"expected finite pixels; got {bad} NaN or infinite; fill or mask them first"
        )


def _parts(strips: int, threads: int, largest: int) -> list[slice]:
    """Slices that contain about equal numbers of strips.

    Each thread gets one slice, or more slices if the sums of one slice would exceed `largest` strips.
    """
    count = min(strips, threads * -(-strips // (threads * largest)))
    bounds = [strips * k // count for k in range(count + 1)]
    return [slice(start, stop) for start, stop in pairwise(bounds)]


@compiled()
def _strips(targets):  # type: ignore[no-untyped-def]
    """Index of the strip of each target, and (y, x) of the first pixel of each strip. Targets are sorted by y, then x."""
    strip = np.empty(len(targets), np.int64)
    first = np.empty((len(targets), 2), np.int64)
    count = 0
    for i in range(len(targets)):
        y, x = targets[i, 0], targets[i, 1]
        if count == 0 or y != first[count - 1, 0] or x >= first[count - 1, 1] + LANES:
            first[count, 0], first[count, 1] = y, x
            count += 1
        strip[i] = count - 1
    return strip, first[:count].copy()


def _places(strip_yx: NDArray[np.int64], runs: Runs) -> range:
    """The range of x indices at which the strips read P.

    All threads use the same range, because the start of the range determines the rounding of the sums.
    """
    first = strip_yx[:, 1].min() - runs.dx_stop.max() + 1
    last = strip_yx[:, 1].max() + LANES - runs.dx_start.min()
    return range(int(first), int(last) + 1)


def _sum_strips(
    image: NDArray[np.floating], strip_yx: NDArray[np.int64], runs: Runs, places: range, sums: Sums
) -> None:
    """Add the sums of Eq. (1) for some strips to `sums`, (strips, segments, lanes)."""
    running = np.zeros((_ROWS, len(places)))
    of_row = (runs.first_dy, runs.row, runs.dx_start, runs.dx_stop, runs.segment)
    _accumulate(image, strip_yx, *of_row, places.start, running, sums)


@compiled()
def _running_sums(image, top, first, running):  # type: ignore[no-untyped-def]
    """P of Eq. (2) for the four rows that begin at `top`, at indices that begin at `first`.

    P is constant beyond the columns of the image. If fewer than four rows remain, the last row of the image fills the
    rest; the caller does not use these copies. The four independent sums hide the latency of each addition.
    """
    ny, nx = image.shape
    places = running.shape[1]
    begin, end = max(0, first), min(nx, first + places - 1)
    y0, y1, y2, y3 = top, min(top + 1, ny - 1), min(top + 2, ny - 1), min(top + 3, ny - 1)
    t0 = t1 = t2 = t3 = 0.0
    running[:, : max(0, min(places, begin - first + 1))] = 0.0
    for x in range(begin, end):
        t0 += image[y0, x]
        t1 += image[y1, x]
        t2 += image[y2, x]
        t3 += image[y3, x]
        i = x + 1 - first
        running[0, i], running[1, i], running[2, i], running[3, i] = t0, t1, t2, t3
    beyond = max(0, end + 1 - first)
    running[0, beyond:], running[1, beyond:], running[2, beyond:], running[3, beyond:] = t0, t1, t2, t3


@compiled()
def _accumulate(image, strip_yx, first_dy, row, dx_start, dx_stop, segment, first, running, sums):  # type: ignore[no-untyped-def]
    ny, lanes = image.shape[0], sums.shape[2]
    rows_of_runs = len(row) - 1
    lowest_y, highest_y = strip_yx[0, 0], strip_yx[-1, 0]
    # dy = y - source y
    top = max(0, lowest_y - (first_dy + rows_of_runs - 1))
    bottom = min(ny, highest_y - first_dy + 1)
    for y0 in range(top, bottom, _ROWS):
        _running_sums(image, y0, first, running)
        for s in range(len(strip_yx)):
            base = strip_yx[s, 1] - first + 1
            mine = sums[s].ravel()
            for k in range(min(_ROWS, bottom - y0)):
                j = strip_yx[s, 0] - (y0 + k) - first_dy
                if j < 0 or j >= rows_of_runs:
                    continue
                p = running[k]
                for i in range(row[j], row[j + 1]):
                    # Eq. (3) for adjacent targets. The compiler vectorises this loop only if the indices are unsigned
                    # and the number of lanes is not known at compile time.
                    high, low = np.uint64(base - dx_start[i]), np.uint64(base - dx_stop[i])
                    a = np.uint64(segment[i]) * np.uint64(lanes)
                    for w in range(lanes):
                        mine[a + np.uint64(w)] += p[high + np.uint64(w)] - p[low + np.uint64(w)]
