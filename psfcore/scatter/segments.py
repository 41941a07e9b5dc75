"""Segments of the PSF: concentric shells, each with one coefficient, and sums of an image over them.

Source: Hofmeister et al., The point-spread function of HRI_EUV, "The inversion algorithm", steps (c) and (h). A segment
S is a set of offsets dr = target - source: light from a source falls on target = source + dr. A pixel belongs to
segment k if edges[k] <= r < edges[k + 1]. The central pixel belongs to no segment: its weight is 1 minus the light of
all segments.

    n_S = number of pixels of S on the reach grid                                            Eq. (1)
    psf_S = (1 / n_S) sum over dr in S of f(dr)                                              Eq. (2)
    A_S[r] = sum over dr in S of I[r - dr]                                                   Eq. (3)

for targets r, with I = 0 beyond the image. In each row, a segment consists of a few runs of adjacent pixels. Running
sums P along the rows of the image are computed first. Each run then costs one difference, independent of its length:

    P[y, i] = sum over x < i of I[y, x]                                                      Eq. (4)
    sum over dx_start <= dx < dx_stop of I[y, x - dx] = P[y, x - dx_start + 1] - P[y, x - dx_stop + 1]    Eq. (5)

Targets are grouped into strips of up to 24 adjacent pixels of a row. The targets of a strip read adjacent values of P,
so the sums of a strip are vector operations. Image rows are processed four at a time. Their running sums stay in the
cache while all strips use them.

Difference from the paper: about the innermost shells, the paper gives only their number, ten, and their outer edge, 5
px. There are only twelve different pixel distances below 5 px, so four of ten shells of equal width would be empty.
Here each of the ten shells contains one or two of these distances.

| symbol | name | unit |
|---|---|---|
| r | distance from pixel centre to pixel centre; in Eq. (3) and (5), the targets (y, x) | px |
| dr = (dx, dy) | offset, target minus source | px |
| n_S | counts | - |
| f | kernel | per px |
| I | image[y, x] | - |
| P | running | - |
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from psfcore.arrays import cut
from psfcore.compiled import compiled
from psfcore.errors import DataError
from psfcore.psf import REACH_GRID_PX, squared_radii

# This radius is slightly larger than 1448.15 px, the distance of the corner of the reach grid from its centre.
FULL_REACH_PX = 1449.0
_PUBLISHED_CORE_PX = (0.5, 1.2, 1.7, 2.1, 2.5, 2.9, 3.1, 3.4, 3.8, 4.2, 5.0)
_PUBLISHED_TAIL = 35
LANES = 24
_ROWS = 4
_VECTOR = 4  # the number of lanes (pixels) of a strip is a multiple of this number
_LARGEST_SUMS = 2**20  # largest array of sums that one thread keeps at a time: 8 MiB

Floats = NDArray[np.float64]


def shells_as_published(reach_px: float = FULL_REACH_PX) -> tuple[float, ...]:
    """The 51 edges of the paper's 50 shells, in px.

    Ten shells lie within 5 px, and five between 5 and 10 px. The widths of the other 35 grow exponentially up to
    `reach_px`, which must be above 10.
    """
    tail = 10.0 * (reach_px / 10.0) ** (np.arange(_PUBLISHED_TAIL + 1) / _PUBLISHED_TAIL)
    return (*_PUBLISHED_CORE_PX, *np.arange(6.0, 10.0).tolist(), *tail[:-1].tolist(), reach_px)


class Runs(NamedTuple):
    """The segments as runs of adjacent pixels, row by row; a kernel takes them as one argument.

    Run i contains the offsets dx_start[i] <= dx < dx_stop[i]; they belong to the segment with the index segment[i]. The
    runs of row dy are sorted by dx. Their indices begin at row[dy - first_dy] and end before row[dy - first_dy + 1].
    """

    first_dy: int
    row: NDArray[np.int64]
    dx_start: NDArray[np.int32]
    dx_stop: NDArray[np.int32]
    segment: NDArray[np.int32]


@dataclass(frozen=True)
class Segments:
    """Concentric shells of pixels of the reach grid.

    Attributes
    ----------
    edges_px
        Edges of the shells, two or more, increasing from above 0.
    reach_grid_px
        Edge of the reach grid. The shape of this grid is (reach_grid_px, reach_grid_px), and its centre is at [n // 2,
        n // 2].
    """

    edges_px: tuple[float, ...]
    reach_grid_px: int = REACH_GRID_PX

    @property
    def size(self) -> int:
        """Number of segments, including empty ones."""
        return len(self.edges_px) - 1

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        """The number of pixels of each segment, n_S of Eq. (1), (size,). It is 0 for a shell that is too narrow to
        contain a pixel.
        """
        label = self._reach_map.ravel()
        return np.bincount(label + 1, minlength=self.size + 1)[1:]

    def label_map(self, size: int) -> NDArray[np.int32]:
        """The index of the segment of each pixel [y, x], on (size, size) with centre [size // 2, size // 2].

        The value is -1 at the centre, outside all shells, and outside the reach grid.
        """
        first = self.reach_grid_px // 2 - size // 2
        return np.asarray(cut(self._reach_map + 1, first, first, (size, size)) - 1)

    def mean_of_map(self, kernel: Floats) -> Floats:
        """psf_S of Eq. (2) for any kernel [y, x] on the reach grid, array (size,). It is 0 for empty segments."""
        label = self._reach_map
        sums = np.bincount(label.ravel() + 1, weights=kernel.ravel(), minlength=self.size + 1)[1:]
        return np.asarray(sums / np.maximum(self.counts, 1))

    @cached_property
    def runs(self) -> Runs:
        """The segments as runs of pixels, row by row; `segment_sums` uses them."""
        label = self._reach_map
        centre = self.reach_grid_px // 2
        # The padding makes every row begin and end outside all segments.
        walled = np.pad(label, ((0, 0), (1, 1)), constant_values=-1)
        row, place = np.nonzero(walled[:, 1:] != walled[:, :-1])
        segment = walled[row, place + 1]
        inside = segment >= 0
        # A run ends at the next change in its row. A change to -1 (no segment) starts no run.
        stop = np.append(place[1:], 0)
        counted = np.bincount(row[inside], minlength=label.shape[0])
        return Runs(
            first_dy=-centre,
            row=np.concatenate(([0], np.cumsum(counted))).astype(np.int64),
            dx_start=(place[inside] - centre).astype(np.int32),
            dx_stop=(stop[inside] - centre).astype(np.int32),
            segment=segment[inside].astype(np.int32),
        )

    @cached_property
    def _reach_map(self) -> NDArray[np.int32]:
        """The label map of the reach grid."""
        squares = squared_radii((self.reach_grid_px, self.reach_grid_px))
        # Element r^2 (px^2, an integer) is the segment of the pixels at the distance r.
        segment = np.searchsorted(self.edges_px, np.sqrt(np.arange(squares.max() + 1)), side="right") - 1
        segment[segment == self.size] = -1
        return np.asarray(segment.astype(np.int32)[squares])


def beyond_pct(light: Floats) -> Floats:
    """The percentage of all light that lies beyond the inner edge of each segment.

    Parameters
    ----------
    light
        The light in each segment, as a fraction of all light, (fits, segments).
    """
    return np.asarray(100 * np.cumsum(light[:, ::-1], axis=1)[:, ::-1])


def segment_sums(
    image: NDArray[np.floating], targets: NDArray[np.integer], segments: Segments, *, threads: int = 1
) -> Floats:
    """The sums of the image over the segments around each target, A_S of Eq. (3), (n, segments.size).

    The sums are in the image's unit times px^2, exact to float64 rounding.

    Raises DataError "image-nonfinite" if a pixel is NaN or infinite, and ValueError if a target lies outside the image.

    Parameters
    ----------
    image
        Pixels [y, x], float32 or float64; the image counts as 0 beyond its edges.
    targets
        The (y, x) of each target on the image, (n, 2), in any order.
    threads
        Number of threads that share the targets; it does not change the result.
    """
    if not ((targets >= 0) & (targets < image.shape)).all():
        raise ValueError(f"expected targets (y, x) inside the image of {image.shape}; got one outside it")
    if not np.isfinite(image).all():
        bad = int(np.count_nonzero(~np.isfinite(image)))
        raise DataError(
            "image-nonfinite", f"expected finite pixels; got {bad} NaN or infinite; fill or mask them first"
        )
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
    # The x indices at which the strips read P. All threads use the same, because the first determines the rounding.
    first = int(strip_yx[:, 1].min() - runs.dx_stop.max() + 1)
    places = int(strip_yx[:, 1].max() + LANES - runs.dx_start.min()) + 1 - first

    def work(part: slice) -> None:
        mine = slice(*np.searchsorted(strip, (part.start, part.stop)))
        lane = ordered[mine, 1] - strip_yx[strip[mine], 1]
        lanes = -(-(int(lane.max()) + 1) // _VECTOR) * _VECTOR
        sums = np.zeros((part.stop - part.start, segments.size, lanes))
        _accumulate(image, strip_yx[part], runs, first, np.zeros((_ROWS, places)), sums)
        out[order[mine]] = sums[strip[mine] - part.start, :, lane]

    # Each thread gets about equally many strips: in one part, or in more if the sums of one part would be too large.
    largest, strips = max(1, _LARGEST_SUMS // (segments.size * LANES)), len(strip_yx)
    count = min(strips, threads * -(-strips // (threads * largest)))
    bounds = [strips * k // count for k in range(count + 1)]
    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(work, (slice(*part) for part in pairwise(bounds))))
    return out


@compiled()
def _strips(targets):  # type: ignore[no-untyped-def]  # compiled
    """Index of the strip of each target, and (y, x) of the first pixel of each strip. Targets are sorted by y, then
    x.
    """
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


@compiled()
def _running_sums(image, top, first, running):  # type: ignore[no-untyped-def]  # compiled
    """P of Eq. (4) for the four rows that begin at `top`, at indices that begin at `first`.

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
def _accumulate(image, strip_yx, runs, first, running, sums):  # type: ignore[no-untyped-def]  # compiled
    ny, lanes, first_dy = image.shape[0], sums.shape[2], runs.first_dy
    row, dx_start, dx_stop, segment = runs.row, runs.dx_start, runs.dx_stop, runs.segment
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
                    # Eq. (5) for adjacent targets. The compiler vectorises this loop only if the indices are unsigned
                    # and the number of lanes is not known at compile time.
                    high, low = np.uint64(base - dx_start[i]), np.uint64(base - dx_stop[i])
                    a = np.uint64(segment[i]) * np.uint64(lanes)
                    for w in range(lanes):
                        mine[a + np.uint64(w)] += p[high + np.uint64(w)] - p[low + np.uint64(w)]
