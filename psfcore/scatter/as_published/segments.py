"""Segments of the PSF: concentric shells, each with one coefficient.

Source: Hofmeister et al., The point-spread function of HRI_EUV, "The inversion algorithm", step (c). A segment S is a set
of offsets dr = target - source: light from a source falls on target = source + dr. A pixel belongs to segment k if
edges[k] <= r < edges[k + 1]. The central pixel belongs to no segment: its weight is 1 minus the light of all segments.

    n_S = number of pixels of S on the reach grid                                            Eq. (1)
    psf_S = (1 / n_S) sum over dr in S of f(dr)                                              Eq. (2)

Difference from the paper: about the innermost shells, the paper gives only their number, ten, and their outer edge, 5 px.
There are only twelve different pixel distances below 5 px, so four of ten shells of equal width would be empty. Here each
of the ten shells contains one or two of these distances.

| symbol | name | unit |
|---|---|---|
| r | distance from pixel centre to pixel centre | px |
| dr = (dx, dy) | offset, target minus source | px |
| n_S | counts | - |
| f | kernel | per px |
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from psfcore.psf import REACH_GRID_PX, squared_radii

# This radius is slightly larger than 1448.15 px, the distance of the corner of the reach grid from its centre.
FULL_REACH_PX = 1449.0
_PUBLISHED_CORE_PX = (0.5, 1.2, 1.7, 2.1, 2.5, 2.9, 3.1, 3.4, 3.8, 4.2, 5.0)
_PUBLISHED_TAIL = 35

Floats = NDArray[np.float64]


def shells_as_published(reach_px: float = FULL_REACH_PX) -> Floats:
    """The edges (51,) of the paper's 50 shells, in px.

    Ten shells lie within 5 px, and five between 5 and 10 px. The widths of the other 35 grow exponentially up to
    `reach_px`. Raises ValueError if `reach_px` is not above 10.
    """
    if not reach_px > 10:
        raise ValueError(f"expected a reach above 10 px; got {reach_px}")
    tail = 10.0 * (reach_px / 10.0) ** (np.arange(_PUBLISHED_TAIL + 1) / _PUBLISHED_TAIL)
    tail[-1] = reach_px
    return np.concatenate((_PUBLISHED_CORE_PX, np.arange(6.0, 10.0), tail))


@dataclass(frozen=True, eq=False)
class Runs:
    """The segments as runs of adjacent pixels, row by row.

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
    """Concentric shells.

    edges_px: edges of the shells, increasing; the first is above 0. Only pixels of the reach grid count. The shape of
    this grid is (reach_grid_px, reach_grid_px), and its centre is at [n // 2, n // 2]. Raises ValueError if an edge is
    0 or negative, or if the edges do not increase.
    """

    edges_px: tuple[float, ...]
    reach_grid_px: int = REACH_GRID_PX

    def __post_init__(self) -> None:
        edges = np.asarray(self.edges_px, dtype=np.float64)
        if edges.ndim != 1 or edges.size < 2 or not (edges[0] > 0 and (np.diff(edges) > 0).all()):
            raise ValueError(f"expected two or more edges that increase from above 0; got {self.edges_px}")
        object.__setattr__(self, "edges_px", tuple(edges.tolist()))

    @property
    def size(self) -> int:
        """Number of segments, including empty ones."""
        return len(self.edges_px) - 1

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        """n_S of Eq. (1), array (size,). It is 0 for a shell that is too narrow to contain a pixel."""
        label = self._reach_map.ravel()
        return np.bincount(label + 1, minlength=self.size + 1)[1:]

    def label_map(self, size: int) -> NDArray[np.int32]:
        """The index of the segment of each pixel [y, x], on (size, size) with centre [size // 2, size // 2].

        The value is -1 at the centre, outside all shells, and outside the reach grid.
        """
        whole = self._reach_map
        out = np.full((size, size), -1, dtype=np.int32)
        reach = self.reach_grid_px
        shift = reach // 2 - size // 2
        source = slice(max(shift, 0), min(shift + size, reach))
        target = slice(source.start - shift, source.stop - shift)
        out[target, target] = whole[source, source]
        return out

    def mean_of_map(self, kernel: Floats) -> Floats:
        """psf_S of Eq. (2) for any kernel [y, x] on the reach grid, array (size,). It is 0 for empty segments.

        Raises ValueError if `kernel` does not have the shape of the reach grid.
        """
        label = self._reach_map
        if kernel.shape != label.shape:
            raise ValueError(f"expected a kernel of shape {label.shape}, the reach grid; got {kernel.shape}")
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
