"""What the tiles of a compressed image unfold to, bounded before they are decoded.

FITS standard 4.0, section 10.1: a tile is a stretch of the table's heap, found by a descriptor (length, offset) in
the table's row. A stream of gzip says nowhere how long it is inflated: half a megabyte of them makes half a gigabyte,
whatever ZNAXISn declare. So each is inflated here in a bounded way first, and refused where it holds more than its
tile has pixels. RICE_1 needs no such look: its decoder makes as many pixels as it was asked for.
"""

from __future__ import annotations

import gzip
import io
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError

# Streams of gzip stand in GZIP tiles, and beside RICE_1 for tiles that could not be quantised.
_GZIP_COLUMNS = {
    "GZIP_1": ("COMPRESSED_DATA", "GZIP_COMPRESSED_DATA"),
    "GZIP_2": ("COMPRESSED_DATA", "GZIP_COMPRESSED_DATA"),
    "RICE_1": ("GZIP_COMPRESSED_DATA",),
}
_LARGEST_PIXEL_BYTES = 8
_ITEM_BYTES = {"B": 1, "I": 2, "J": 4}
_OVERHEAD_BYTES = 1024  # of gzip over what it holds, generously


class Heap(Protocol):
    """The bytes that descriptors point into."""

    def read(self, offset: int, count: int) -> bytes:
        """``count`` bytes from ``offset`` on; fewer where the file ends."""


def check_tiles(
    rows: NDArray[np.void], formats: dict[str, str], heap: Heap, codec: str, tile_pixels: int
) -> None:
    """Raise DataError "tile-too-large" where a tile holds more than ``tile_pixels`` pixels of 8 bytes.

    rows: the table's rows as they are stored. formats: TFORMn by column. Passes on what a broken gzip stream raises:
    OSError, EOFError, zlib.error.
    """
    most = tile_pixels * _LARGEST_PIXEL_BYTES
    for name in _GZIP_COLUMNS.get(codec, ()):
        if name in (rows.dtype.names or ()):
            item_bytes = _ITEM_BYTES.get(formats[name].removeprefix("1")[1:2], 4)
            descriptors = np.asarray(rows[name]).reshape(len(rows), -1)[:, :2].astype(np.int64)
            for count, offset in descriptors.tolist():
                if count:
                    _check_stream(heap, offset, count * item_bytes, most)


def _check_stream(heap: Heap, offset: int, count: int, most: int) -> None:
    # An honest stream is hardly longer than what it holds. One that is would only cost time, over and over where
    # many descriptors point at it.
    if offset < 0 or not 0 < count <= 2 * most + _OVERHEAD_BYTES:
        raise _too_large(f"a compressed tile of {count} bytes", most)
    with gzip.GzipFile(fileobj=io.BytesIO(heap.read(offset, count))) as stream:
        if len(stream.read(most + 1)) > most:
            raise _too_large("a compressed tile that unfolds to more", most)


def _too_large(got: str, most: int) -> DataError:
    return DataError(
        "tile-too-large", f"expected tiles of at most {most} bytes, as ZTILEn declare; got {got}"
    )
