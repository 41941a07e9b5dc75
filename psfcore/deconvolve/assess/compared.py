"""An image before and after a deconvolution, read in blocks of rows that stay in the processor's cache."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from psfcore.deconvolve.assess import ranks

_BLOCK_ROWS = 64
Plane = NDArray[np.floating]
Flags = NDArray[np.bool_]
Single = NDArray[np.float32]
Places = tuple[NDArray[np.intp], ...]
Number = TypeVar("Number", bound=np.generic)


@dataclass(frozen=True, eq=False)
class Compared:
    """An image before and after a deconvolution, the pixels that are compared, and the number of threads that compare.

    Attributes
    ----------
    before, after
        The planes [y, x] in single precision, which is accurate enough, see `single`.
    counted
        The compared pixels [y, x].
    """

    before: Single
    after: Single
    counted: Flags
    threads: int = 1

    @cached_property
    def blocks(self) -> list[slice]:
        """Blocks of rows that stay in the processor's cache."""
        return list(row_blocks(len(self.counted)))

    @cached_property
    def sizes(self) -> NDArray[np.intp]:
        """The number of compared pixels in each block."""
        return np.array([np.count_nonzero(self.counted[rows]) for rows in self.blocks])

    @cached_property
    def _columns(self) -> list[slice | None]:
        """The columns of each block whose pixels are all compared, if no others are; None: others are."""
        found: list[slice | None] = []
        for rows, size in zip(self.blocks, self.sizes, strict=True):
            flags = self.counted[rows]
            columns = np.flatnonzero(flags[0])
            inner = slice(columns[0], columns[-1] + 1) if columns.size else slice(0, 0)
            whole = size == flags[:, inner].size and flags[:, inner].all()
            found.append(inner if whole else None)
        return found

    def compared(self, plane: NDArray[Number], n: int) -> NDArray[Number]:
        """The compared pixels (k,) of block n, of its rows [y, x] of a plane."""
        columns = self._columns[n]
        return plane[self.counted[self.blocks[n]]] if columns is None else plane[:, columns].ravel()

    def portions(self, of: Callable[[slice], Plane], groups: ranks.Groups | None = None) -> ranks.Portions:
        """Numbers of the compared pixels, for `ranks`.

        Parameters
        ----------
        of
            Function of some rows that returns a number for each of their pixels [y, x].
        groups
            The group of each compared pixel (n,).
        """

        def read(n: int) -> ranks.Values:
            return self.compared(of(self.blocks[n]), n).astype(np.float32, copy=False)

        return ranks.Portions(self.sizes, read, groups, self.threads)


def single(plane: Plane) -> Single:
    """The plane in single precision; pixels that are not finite have the median of the finite ones."""
    return filled(plane.astype(np.float32, copy=False))


def row_blocks(count: int) -> Iterator[slice]:
    """All rows [0, count) in blocks that stay in the processor's cache."""
    for top in range(0, count, _BLOCK_ROWS):
        yield slice(top, min(top + _BLOCK_ROWS, count))


def with_rim(plane: NDArray[Number], rows: slice, rim_px: int) -> NDArray[Number]:
    """Some rows of a plane [y, x] with a rim on all sides; beyond the edges, it is the mirror image of the plane."""
    ny, nx = plane.shape
    first, last = max(rows.start - rim_px, 0), min(rows.stop + rim_px, ny)
    low, high = rim_px - (rows.start - first), rim_px - (last - rows.stop)
    if high or low or rim_px > nx:
        return np.pad(plane[first:last], ((low, high), (rim_px, rim_px)), mode="symmetric")
    # The same as `numpy.pad`, in half of the time.
    block = np.empty((last - first, nx + 2 * rim_px), plane.dtype)
    block[:, rim_px:-rim_px] = plane[first:last]
    block[:, :rim_px] = block[:, 2 * rim_px - 1 : rim_px - 1 : -1]
    block[:, -rim_px:] = block[:, -rim_px - 1 : -2 * rim_px - 1 : -1]
    return block


def filled(plane: Plane) -> Plane:
    """Replace the pixels of a plane that are not finite by the median of the finite pixels."""
    middle = _middle(plane)
    return plane if middle is None else np.where(np.isfinite(plane), plane, plane.dtype.type(middle))


def _middle(plane: Plane) -> float | None:
    """The median of the finite pixels, 0 if there are none; None if all pixels are finite."""
    if all(np.isfinite(plane[rows]).all() for rows in row_blocks(len(plane))):
        return None
    good = np.isfinite(plane)
    return float(np.median(plane[good])) if good.any() else 0.0
