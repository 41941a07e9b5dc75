"""An image before and after a deconvolution, read in blocks of rows that stay in the processor's cache."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from psfcore.deconvolve.assess import ranks

_BLOCK_ROWS = 64
Plane = NDArray[np.floating]
Flags = NDArray[np.bool_]
Places = tuple[NDArray[np.intp], ...]
Number = TypeVar("Number", bound=np.generic)
Pixels = TypeVar("Pixels", NDArray[np.floating], NDArray[np.bool_])


class SinglePlane:
    """A plane [y, x] that is read in single precision, rows or positions at a time, and is never copied as a whole.

    Pixels that are not finite have the median of the finite ones.
    """

    def __init__(self, plane: Plane) -> None:
        middle = _middle(plane)
        self._plane, self._fill = plane, None if middle is None else np.float32(middle)

    def __len__(self) -> int:
        return len(self._plane)

    def __getitem__(self, at: slice | Places) -> NDArray[np.float32]:
        part = self._plane[at].astype(np.float32, copy=False)
        return part if self._fill is None else np.where(np.isfinite(part), part, self._fill)


@dataclass(frozen=True, eq=False)
class Compared:
    """An image before and after a deconvolution, the pixels that are compared, and the number of threads that compare.

    Attributes
    ----------
    counted
        The compared pixels [y, x].
    """

    before: SinglePlane
    after: SinglePlane
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
            return chosen(of(self.blocks[n]), self.counted[self.blocks[n]]).astype(np.float32, copy=False)

        return ranks.Portions(self.sizes, read, groups, self.threads)


def chosen(block: NDArray[Number], flags: Flags) -> NDArray[Number]:
    """The pixels (n,) of a block [y, x] that have a flag."""
    return block.ravel() if flags.all() else block[flags]


def row_blocks(count: int) -> Iterator[slice]:
    """All rows [0, count) in blocks that stay in the processor's cache."""
    for top in range(0, count, _BLOCK_ROWS):
        yield slice(top, min(top + _BLOCK_ROWS, count))


def with_rim(
    plane: Pixels | SinglePlane, rows: slice, rim_px: int, rim: Literal["edge", "symmetric"]
) -> Pixels:
    """Some rows of a plane with a rim on all sides.

    Parameters
    ----------
    rim
        How the rim is filled beyond the edges, as a mode of `numpy.pad`.
    """
    first, last = max(rows.start - rim_px, 0), min(rows.stop + rim_px, len(plane))
    missing = (rim_px - (rows.start - first), rim_px - (last - rows.stop))
    return np.pad(plane[first:last], (missing, (rim_px, rim_px)), mode=rim)


def filled(plane: Plane) -> Plane:
    """Replace the pixels of a plane that are not finite by the median of the finite pixels."""
    middle = _middle(plane)
    return plane if middle is None else np.where(np.isfinite(plane), plane, middle)


def _middle(plane: Plane) -> float | None:
    """The median of the finite pixels, 0 if there are none; None if all pixels are finite."""
    if all(np.isfinite(plane[rows]).all() for rows in row_blocks(len(plane))):
        return None
    good = np.isfinite(plane)
    return float(np.median(plane[good])) if good.any() else 0.0
