"""Size check for the tiles of a compressed image, before they are decoded.

FITS standard 4.0, section 10.1: each row of the table holds a descriptor (length, offset) of one tile in the table's
heap. A gzip stream does not state its inflated size: half a megabyte can become half a gigabyte, whatever ZNAXISn
declare. Each stream is therefore first inflated up to a limit, and the file is refused if a stream holds more bytes
than the pixels of its tile. RICE_1 needs no check, because its decoder returns exactly the requested number of pixels.
"""

from __future__ import annotations

import gzip
import io
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError

# Gzip streams occur in GZIP tiles, and with RICE_1 for tiles that could not be quantised.
_GZIP_COLUMNS = {
    "GZIP_1": ("COMPRESSED_DATA", "GZIP_COMPRESSED_DATA"),
    "GZIP_2": ("COMPRESSED_DATA", "GZIP_COMPRESSED_DATA"),
    "RICE_1": ("GZIP_COMPRESSED_DATA",),
}
_LARGEST_PIXEL_BYTES = 8
_ITEM_BYTES = {"B": 1, "I": 2, "J": 4}
_OVERHEAD_BYTES = 1024  # of a gzip stream over its content, with ample margin


class Heap(Protocol):
    """The bytes that the descriptors refer to."""

    def read(self, offset: int, count: int) -> bytes:
        """`count` bytes from `offset` on; fewer at the end of the file."""


def check_tiles(
    rows: NDArray[np.void], formats: dict[str, str], heap: Heap, codec: str, tile_pixels: int
) -> None:
    """Raise DataError "tile-too-large" if a tile inflates to more than `tile_pixels` pixels of 8 bytes.

    rows: the rows of the table as stored. formats: TFORMn by column name. A broken gzip stream raises OSError,
    EOFError or zlib.error.
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
    # A correct stream is hardly longer than its content. A longer one only costs time, many times if many
    # descriptors point at it.
    if offset < 0 or not 0 < count <= 2 * most + _OVERHEAD_BYTES:
        raise _too_large(f"a compressed tile of {count} bytes", most)
    with gzip.GzipFile(fileobj=io.BytesIO(heap.read(offset, count))) as stream:
        if len(stream.read(most + 1)) > most:
            raise _too_large("a compressed tile that inflates to more", most)


def _too_large(got: str, most: int) -> DataError:
    return DataError(
        "tile-too-large", f"expected tiles of at most {most} bytes, as ZTILEn declare; got {got}"
    )
