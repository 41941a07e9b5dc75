"""Scenes in half the memory of float32: numbers of 16 bits, with one power of two as a factor for each scene.

A scene is where an iteration continues, and what a PSF scatters into a disc. A number of 16 bits has a relative error
of at most 2^-11, which is random from pixel to pixel. The first step of a continued iteration removes it. In the light
that a scene scatters into a pixel, it is far below the noise of this pixel: at most 2e-5 of that light (rms, HRI_EUV).

All scenes lie in one array: arrays of single scenes, which threads replace all the time, would leave holes in the
memory.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.kernels import BLOCK_ROWS

Lanes = NDArray[np.float32]
_LARGEST_EXPONENT = 15  # all numbers of a scene are below 2^15; float16 ends at 65504


@dataclass(frozen=True, eq=False)
class StoredScene:
    """A scene in the memory order of the convolution engine, as it is stored.

    Attributes
    ----------
    values
        The scene times 2^-exponent.
    """

    values: NDArray[np.float16]
    exponent: int

    def lanes(self, blocks: slice = slice(None), *, out: Lanes | None = None) -> Lanes:
        """The scene, or some of its blocks of rows, in `out` if it is given."""
        values, factor = self.values[blocks], np.float32(2.0**self.exponent)
        lanes = np.empty(values.shape, np.float32) if out is None else out
        for block, stored in zip(lanes, values, strict=True):  # a block stays in the cache
            np.multiply(stored, factor, out=block)
        return lanes

    def __getitem__(self, window: tuple[slice, slice]) -> NDArray[np.float32]:
        """A part [y, x] of the scene."""
        rows, columns = window
        blocks = slice(rows.start // BLOCK_ROWS, -(-rows.stop // BLOCK_ROWS))
        lanes = self.lanes(blocks)[:, columns].transpose(0, 2, 3, 1)
        first = rows.start - blocks.start * BLOCK_ROWS
        return lanes.reshape(-1, lanes.shape[-1])[first : first + rows.stop - rows.start]


class Scenes(Sequence[Lanes]):
    """The scenes of all images. An item is a copy in float32; to assign an item stores a scene.

    Parameters
    ----------
    count
        The number of images.
    lanes_shape
        The shape of a scene in the memory order of the convolution engine.
    """

    def __init__(self, count: int, lanes_shape: tuple[int, ...]) -> None:
        self._values = np.empty((count, *lanes_shape), np.float16)
        self._exponents = np.zeros(count, np.int64)

    @overload
    def __getitem__(self, n: int) -> Lanes: ...
    @overload
    def __getitem__(self, n: slice) -> list[Lanes]: ...
    def __getitem__(self, n: int | slice) -> Lanes | list[Lanes]:
        if isinstance(n, slice):
            return [self.stored(k).lanes() for k in range(len(self))[n]]
        return self.stored(n).lanes()

    def __setitem__(self, n: int, lanes: Lanes) -> None:
        """Store a scene. A scene that was read from a stored one is stored without any change."""
        mantissa, exponent = math.frexp(max(float(lanes.max()), -float(lanes.min())))
        # A maximum that is rounded up to a power of two has the exponent that it will have when it is stored again.
        exponent += int(np.float16(mantissa) == 1) - _LARGEST_EXPONENT
        factor = np.float32(2.0**-exponent)
        for block, stored in zip(lanes, self._values[n], strict=True):
            stored[:] = block * factor
        self._exponents[n] = exponent

    def __len__(self) -> int:
        return len(self._values)

    def stored(self, n: int) -> StoredScene:
        """A scene as it is stored; only the part of it that is read becomes float32."""
        return StoredScene(self._values[n], int(self._exponents[n]))

    def copy(self) -> Scenes:
        """A second object with the same scenes."""
        other = Scenes(0, self._values.shape[1:])
        other._values, other._exponents = self._values.copy(), self._exponents.copy()
        return other
