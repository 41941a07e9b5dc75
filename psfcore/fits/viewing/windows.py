"""Cut a window out of a decoded plane, and reduce it to blocks of pixels, some rows at a time.

With the step n, each pixel of the answer represents a block of n x n pixels of the window. The value of this pixel is
the mean of the finite pixels of the block, or NaN if no pixel is finite. For a plane of bits, the value is the bitwise
OR of the pixels. Blocks at the upper edges of the window may contain fewer pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from psfcore.arrays import Number
from psfcore.errors import DataError
from psfcore.fits.viewing.planes import PIXEL_BYTES, Plane

_BLOCK_BYTES = 2**20


@dataclass(frozen=True)
class Window:
    """A part of a plane: its first pixel (x, y), counted from 0, its width and height, px, and the step."""

    x: int
    y: int
    width: int
    height: int
    step: int

    @property
    def shape(self) -> tuple[int, int]:
        """The shape (ny, nx) of the answer."""
        return -(-self.height // self.step), -(-self.width // self.step)

    @property
    def length(self) -> int:
        """Number of bytes of the answer."""
        return self.shape[0] * self.shape[1] * PIXEL_BYTES


def window_of(
    shape: tuple[int, int],
    *,
    x: int = 0,
    y: int = 0,
    width: int | None = None,
    height: int | None = None,
    step: int = 1,
) -> Window:
    """A window of a plane of ``shape`` (ny, nx). If width or height is None, the window extends to the end of the
    plane.

    Raises DataError "window-outside" if a part of the window is not in the plane.
    """
    ny, nx = shape
    width = nx - x if width is None else width
    height = ny - y if height is None else height
    if not (0 <= x < x + width <= nx and 0 <= y < y + height <= ny):
        raise DataError(
            "window-outside",
            f"expected a window inside the plane of {nx} x {ny} px: x + width at most {nx}, y + height at most {ny}; "
            f"got x {x}, y {y}, width {width}, height {height}",
        )
    return Window(x, y, width, height, step)


def pixels(plane: Plane, window: Window, *, bits: bool) -> Iterator[bytes]:
    """The pixels of a window as little-endian float32, row 0 first, some rows at a time.

    Raises EOFError if the plane cannot be read.

    Parameters
    ----------
    bits
        Whether the plane holds bits, see above.
    """
    at_once = max(1, _BLOCK_BYTES // (plane.shape[1] * PIXEL_BYTES))
    step, end = window.step, window.y + window.height
    reduced = _union if bits else _mean
    # For a small step, one read gives several rows of the answer. For a large step, one row of the answer needs several
    # reads.
    rows = max(1, at_once // step) * step
    for first in range(window.y, end, rows):
        pieces = _read(plane, window, first, min(first + rows, end), at_once)
        for block in pieces if step == 1 else (reduced(pieces, step),):
            yield np.ascontiguousarray(block, dtype="<f4").tobytes()


def _read(plane: Plane, window: Window, first: int, end: int, at_once: int) -> Iterator[NDArray[np.float32]]:
    """The rows ``first`` to ``end`` (excluded) of the window, at most ``at_once`` rows at a time."""
    for row in range(first, end, at_once):
        count = min(at_once, end - row)
        stored = np.frombuffer(plane.rows(row, count), dtype="<f4").reshape(count, plane.shape[1])
        yield stored[:, window.x : window.x + window.width]


def _mean(pieces: Iterator[NDArray[np.float32]], step: int) -> NDArray[np.float64]:
    """Means of blocks.

    Parameters
    ----------
    pieces
        One piece with several rows of blocks, or several pieces that together form one row.
    """
    total = count = np.zeros(())
    for piece in pieces:
        finite = np.isfinite(piece)
        total = total + _summed(np.where(finite, piece, 0).astype(np.float64), np.add, step)
        count = count + _summed(finite.astype(np.float64), np.add, step)
    return np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)


def _union(pieces: Iterator[NDArray[np.float32]], step: int) -> NDArray[np.int64]:
    union = np.zeros((), dtype=np.int64)
    for piece in pieces:
        union = union | _summed(piece.astype(np.int64), np.bitwise_or, step)
    return union


def _summed(piece: NDArray[Number], sum_of: np.ufunc, step: int) -> NDArray[Number]:
    rows, columns = (np.arange(0, size, step) for size in piece.shape)
    return sum_of.reduceat(sum_of.reduceat(piece, rows, axis=0), columns, axis=1)
