"""Scenes in half the memory of float32: numbers of 16 bits, with one power of two as a factor for each scene.

A scene is where an iteration continues, and what a PSF scatters into a disc. A number of 16 bits has a relative error of
at most 2^-11, which is random from pixel to pixel. The first step of a continued iteration removes it. In the light that
a scene scatters into a pixel, it is far below the noise of this pixel: for HRI_EUV, its rms is 2e-5 of that light.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import overload

import numpy as np
from numpy.typing import NDArray

from psfcore.convolution.engine import BLOCK_ROWS
from psfcore.convolution.lanes import LANES

Lanes = NDArray[np.float32]
_LARGEST_EXPONENT = 15  # all numbers of a scene are below 2^15; float16 ends at 65504


@dataclass(frozen=True, eq=False)
class StoredScene:
    """A scene in the memory order of the convolution engine.

    Attributes
    ----------
    values
        The scene times 2^-exponent.
    """

    values: NDArray[np.float16]
    exponent: int

    @classmethod
    def of(cls, lanes: Lanes) -> StoredScene:
        """Store a scene. A scene that was read from a stored one is stored without any change."""
        mantissa, exponent = math.frexp(max(float(lanes.max()), -float(lanes.min())))
        # A maximum that is rounded up to a power of two has the exponent that it will have when it is stored again.
        exponent += int(np.float16(mantissa) == 1) - _LARGEST_EXPONENT
        factor, values = np.float32(2.0**-exponent), np.empty(lanes.shape, np.float16)
        for block, stored in zip(lanes, values, strict=True):  # a block stays in the cache
            stored[:] = block * factor
        return cls(values, exponent)

    def lanes(self, blocks: slice = slice(None)) -> Lanes:
        """The scene, or some of its blocks of rows."""
        values, factor = self.values[blocks], np.float32(2.0**self.exponent)
        lanes = np.empty(values.shape, np.float32)
        for block, stored in zip(lanes, values, strict=True):
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
    """The scenes of all images. An item is a copy in float32; to assign an item stores a scene."""

    def __init__(self, scenes: Iterable[Lanes | StoredScene]) -> None:
        self._stored = [s if isinstance(s, StoredScene) else StoredScene.of(s) for s in scenes]

    @overload
    def __getitem__(self, n: int) -> Lanes: ...
    @overload
    def __getitem__(self, n: slice) -> list[Lanes]: ...
    def __getitem__(self, n: int | slice) -> Lanes | list[Lanes]:
        return [s.lanes() for s in self._stored[n]] if isinstance(n, slice) else self._stored[n].lanes()

    def __setitem__(self, n: int, lanes: Lanes) -> None:
        self._stored[n] = StoredScene.of(lanes)

    def __len__(self) -> int:
        return len(self._stored)

    def stored(self, n: int) -> StoredScene:
        """A scene as it is stored."""
        return self._stored[n]

    def copy(self) -> Scenes:
        """A second object with the same scenes, which share their memory."""
        return Scenes(self._stored)
