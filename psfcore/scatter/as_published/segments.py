"""Segments of the PSF: shells, or sectors of shells; each segment has one coefficient.

Source: Hofmeister et al., The point-spread function of HRI_EUV, "The inversion algorithm", step (c). The shells are
concentric and can be divided into angular sectors. A segment S is a set of offsets dr = target - source: light from a
source falls on target = source + dr. A pixel belongs to shell k if edges[k] <= r < edges[k + 1]. It belongs to sector m if
its angle from +x towards +y lies in [m, m + 1) times 360 / sectors degrees. The index of the segment is
shell * sectors + sector. The central pixel belongs to no segment: its weight is 1 minus the light of all segments.

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
| f | kernel_function | per px |
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from psfcore.psf import REACH_GRID_PX, squared_radii

# This radius is slightly larger than 1448.15 px, the distance of the corner of the reach grid from its centre.
FULL_REACH_PX = 1449.0
_PUBLISHED_CORE_PX = (0.5, 1.2, 1.7, 2.1, 2.5, 2.9, 3.1, 3.4, 3.8, 4.2, 5.0)
_PUBLISHED_TAIL = 35
_EXACT_PX = 32.0  # within this radius, the kernel is evaluated at every pixel
_CELL = 1 / 16  # side of a cell divided by its distance from the centre
_RING_EXACT_PX = 64.0
_RING = 1 / 2048  # width of a thin ring divided by its radius

Floats = NDArray[np.float64]
KernelFunction = Callable[[Floats, Floats], Floats]


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


def fine_shells(reach_px: float = FULL_REACH_PX, growth: float = 0.03) -> Floats:
    """The edges of shells from 0.5 px to `reach_px`, in px.

    The inner shells are 1 px wide. Farther out, the width of a shell is `growth` times its radius. The outer shells are
    widened slightly, so that the last shell ends at `reach_px`. Raises ValueError if `reach_px` is not above 1.5, or if
    `growth` is not above 0.
    """
    if not (reach_px > 1.5 and growth > 0):
        raise ValueError(f"expected a reach above 1.5 px and a growth above 0; got {reach_px} and {growth}")
    turn = 0.5 + np.floor(max(min(1 / growth, reach_px - 1) - 0.5, 0))
    narrow = np.arange(0.5, turn)
    most = min(np.log(reach_px / turn) / np.log1p(growth), reach_px - turn)
    count = max(int(most), 1)
    wide = turn * (reach_px / turn) ** (np.arange(count + 1) / count)
    wide[-1] = reach_px
    return np.concatenate((narrow, wide))


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


@dataclass(frozen=True, eq=False)
class _Nodes:
    """Points (dx, dy) in px at which a kernel is evaluated.

    weight: the number of pixels that each point represents. segment: the index of the segment of each point.
    """

    dx: Floats
    dy: Floats
    weight: Floats
    segment: NDArray[np.int64]


@dataclass(frozen=True)
class Segments:
    """Concentric shells, each divided into `sectors` sectors (1: isotropic).

    edges_px: edges of the shells, increasing; the first is above 0. Only pixels of the reach grid count. The shape of
    this grid is (reach_grid_px, reach_grid_px), and its centre is at [n // 2, n // 2]. Raises ValueError if an edge is
    0 or negative, if the edges do not increase, or if `sectors` is below 1.
    """

    edges_px: tuple[float, ...]
    sectors: int = 1
    reach_grid_px: int = REACH_GRID_PX

    def __post_init__(self) -> None:
        edges = np.asarray(self.edges_px, dtype=np.float64)
        if edges.ndim != 1 or edges.size < 2 or not (edges[0] > 0 and (np.diff(edges) > 0).all()):
            raise ValueError(f"expected two or more edges that increase from above 0; got {self.edges_px}")
        if self.sectors < 1:
            raise ValueError(f"expected at least one sector; got {self.sectors}")
        object.__setattr__(self, "edges_px", tuple(edges.tolist()))

    @property
    def shells(self) -> int:
        """Number of shells."""
        return len(self.edges_px) - 1

    @property
    def size(self) -> int:
        """Number of segments, including empty ones."""
        return self.shells * self.sectors

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        """n_S of Eq. (1), array (size,). It is 0 for a sector that is too narrow to contain a pixel."""
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

    def mean_of(self, kernel_function: KernelFunction) -> Floats:
        """psf_S of Eq. (2) for a smooth kernel, array (size,). It is 0 for empty segments.

        kernel_function: returns the weights at the offsets (dx, dy), which are two arrays in px of the same shape. Beyond
        32 px, pixels are grouped into cells; the side of a cell is about a sixteenth of its distance from the
        centre. Four points represent a cell. Their mean and covariance are those of the cell's pixels. For power laws,
        also stretched ones, the result has a relative error of at most 1e-5, compared with the mean over all pixels
        that `mean_of_map` computes (tested).
        """
        nodes = self._nodes
        return self._mean(nodes, kernel_function(nodes.dx, nodes.dy))

    def mean_of_radial(self, radial_function: Callable[[Floats], Floats]) -> Floats:
        """psf_S of Eq. (2) for an isotropic kernel, array (size,). It is 0 for empty segments.

        radial_function: returns the weights at an array of distances in px. The mean is exact up to 64 px. Beyond 64 px,
        the kernel is evaluated once in each ring of width r / 2048; the relative error is then at most 1e-6, compared with
        the mean over all pixels (tested).
        """
        nodes = self._ring_nodes
        return self._mean(nodes, radial_function(nodes.dx))

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
        """The segments as runs of pixels, row by row; `ring_sums` uses them."""
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

    def _mean(self, nodes: _Nodes, weights: Floats) -> Floats:
        sums = np.bincount(nodes.segment, weights=nodes.weight * weights, minlength=self.size)
        return np.asarray(sums / np.maximum(self.counts, 1))

    @cached_property
    def _shell_of_square(self) -> NDArray[np.int32]:
        """Element r^2 (px^2, an integer) is the shell of the pixels at the distance r; -1 at the centre and outside all
        shells."""
        corner = 2 * (self.reach_grid_px // 2) ** 2
        return _between(self.edges_px, np.sqrt(np.arange(corner + 1)))

    @cached_property
    def _reach_map(self) -> NDArray[np.int32]:
        """The label map of the reach grid."""
        shape = (self.reach_grid_px, self.reach_grid_px)
        label = self._shell_of_square[squared_radii(shape)]
        if self.sectors > 1:
            inside = label >= 0
            label = np.where(inside, label * self.sectors + _sector(shape, self.sectors), -1)
        return label.astype(np.int32)

    def _ring_of_square(self, exact_px: float, width: float) -> NDArray[np.int64]:
        """Element r^2 (px^2, an integer) is the ring of the pixels at the distance r.

        Below `exact_px`, every distance has its own ring. Farther out, the width of a ring is `width` times r. No ring
        crosses the edge of a shell.
        """
        squares = np.arange(self._shell_of_square.size)
        wide = np.floor(np.log(np.maximum(squares, 1)) / (2 * width)).astype(np.int64)
        new = (np.diff(wide, prepend=0) != 0) | (np.diff(self._shell_of_square, prepend=0) != 0)
        return np.cumsum(new | (squares < exact_px**2))

    @cached_property
    def _ring_nodes(self) -> _Nodes:
        """One node for each segment and distance within 64 px.

        Farther out, one node for each segment and thin ring, at the mean distance of the ring's pixels.
        """
        squares, label = squared_radii((self.reach_grid_px, self.reach_grid_px)), self._reach_map
        ring = self._ring_of_square(_RING_EXACT_PX, _RING)
        inside = label >= 0
        cell = ring[squares[inside]] * self.sectors + label[inside] % self.sectors
        counted = np.bincount(cell)
        held = np.flatnonzero(counted)
        weight = counted[held].astype(np.float64)
        radius = np.bincount(cell, weights=np.sqrt(squares[inside]))[held] / weight
        shell = _between(self.edges_px, radius)
        return _Nodes(radius, np.zeros_like(radius), weight, shell * self.sectors + held % self.sectors)

    @cached_property
    def _nodes(self) -> _Nodes:
        """Every pixel within 32 px is a node. Farther out, four nodes represent each cell of pixels."""
        shape = (self.reach_grid_px, self.reach_grid_px)
        squares, label = squared_radii(shape), self._reach_map
        parts = self.sectors * int(np.ceil(2 * np.pi / _CELL / self.sectors))
        dy, dx = np.indices(shape, dtype=np.float64) - self.reach_grid_px // 2
        near = (label >= 0) & (squares < _EXACT_PX**2)
        far = (label >= 0) & ~near
        ring = self._ring_of_square(_EXACT_PX, _CELL)
        cell = ring[squares[far]] * parts + _sector(shape, parts)[far]
        segment = np.zeros(int(cell.max(initial=0)) + 1, dtype=np.int64)
        segment[cell] = label[far]
        x, y, weight, held = _four_places(dx[far], dy[far], cell)
        return _Nodes(
            dx=np.concatenate((dx[near], x)),
            dy=np.concatenate((dy[near], y)),
            weight=np.concatenate((np.ones(int(near.sum())), weight)),
            segment=np.concatenate((label[near], segment[held])),
        )


def _between(edges_px: tuple[float, ...], radius_px: Floats) -> NDArray[np.int32]:
    """The index of the shell at each distance; -1 outside all shells."""
    shell = np.searchsorted(edges_px, radius_px, side="right") - 1
    return np.where(shell < len(edges_px) - 1, shell, -1).astype(np.int32)


def _sector(shape: tuple[int, int], sectors: int) -> NDArray[np.int32]:
    """The index of the sector of each pixel [y, x].

    The index follows from the angle of the pixel about [ny // 2, nx // 2], from +x towards +y.
    """
    dy = np.arange(shape[0], dtype=np.float64) - shape[0] // 2
    dx = np.arange(shape[1], dtype=np.float64) - shape[1] // 2
    turn = np.arctan2(dy[:, None], dx[None, :]) / (2 * np.pi) % 1.0
    # The offset makes a pixel on a boundary belong to the sector that begins there, despite rounding of its angle.
    return (np.floor(turn * sectors + 1e-9).astype(np.int32)) % sectors


def _four_places(
    dx: Floats, dy: Floats, cell: NDArray[np.int64]
) -> tuple[Floats, Floats, Floats, NDArray[np.int64]]:
    """dx, dy, weight and cell of four points of equal weight in each cell.

    The mean and covariance of the four points are those of the cell's pixels.
    """
    counted = np.bincount(cell)
    held = np.flatnonzero(counted)
    n = counted[held].astype(np.float64)

    def mean(value: Floats) -> Floats:
        return np.asarray(np.bincount(cell, weights=value)[held] / n)

    x, y = mean(dx), mean(dy)
    # The offsets are taken relative to the centre of the cell. This avoids differences of large squares.
    middle_x, middle_y = np.zeros(counted.size), np.zeros(counted.size)
    middle_x[held], middle_y[held] = x, y
    ex, ey = dx - middle_x[cell], dy - middle_y[cell]
    xx, xy, yy = mean(ex * ex), mean(ex * ey), mean(ey * ey)
    # The points lie at +- sqrt(2) standard deviations along the two axes of the covariance.
    spread = np.hypot((xx - yy) / 2, xy)
    long, short = np.sqrt(xx + yy + 2 * spread), np.sqrt(np.maximum(xx + yy - 2 * spread, 0.0))
    angle = np.arctan2(2 * xy, xx - yy) / 2
    c, s = np.cos(angle), np.sin(angle)
    places_x = np.concatenate((x + long * c, x - long * c, x - short * s, x + short * s))
    places_y = np.concatenate((y + long * s, y - long * s, y + short * c, y - short * c))
    return places_x, places_y, np.tile(n / 4, 4), np.tile(held, 4)
