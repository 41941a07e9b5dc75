"""Check the size of the tiles of a compressed image before they are decoded.

FITS standard 4.0, section 10.1: each row of the table holds a descriptor (length, offset) of one tile in the table's
heap. A gzip stream does not say how large it is after decompression: half a megabyte can become half a gigabyte,
whatever ZNAXISn declare. Each stream is therefore first decompressed up to a limit. The file is refused if a stream
holds more bytes than the pixels of its tile need. RICE_1 needs no check, because its decoder returns exactly the
requested number of pixels.
"""

from __future__ import annotations

import gzip
import io
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError

# Columns that hold gzip streams. With RICE_1, only tiles that could not be quantised are gzip streams.
_GZIP_COLUMNS = {
    "GZIP_1": ("COMPRESSED_DATA", "GZIP_COMPRESSED_DATA"),
    "GZIP_2": ("COMPRESSED_DATA", "GZIP_COMPRESSED_DATA"),
    "RICE_1": ("GZIP_COMPRESSED_DATA",),
}
_LARGEST_PIXEL_BYTES = 8
_ITEM_BYTES = {"B": 1, "I": 2, "J": 4}
_OVERHEAD_BYTES = 1024  # upper limit of the bytes that gzip adds to its content


class Heap(Protocol):
    """The bytes to which the descriptors refer."""

    def read(self, offset: int, count: int) -> bytes:
        """Read `count` bytes, starting at `offset`; fewer at the end of the file."""


def check_tiles(
    rows: NDArray[np.void], formats: dict[str, str], heap: Heap, codec: str, tile_pixels: int
) -> None:
    """Raise DataError "tile-too-large" if a decompressed tile is larger than `tile_pixels` pixels of 8 bytes.

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
    # A correct stream is hardly longer than its content. A much longer stream is refused, because reading it costs
    # time, and many descriptors may refer to the same stream.
    if offset < 0 or not 0 < count <= 2 * most + _OVERHEAD_BYTES:
        raise _too_large(f"a compressed tile of {count} bytes", most)
    with gzip.GzipFile(fileobj=io.BytesIO(heap.read(offset, count))) as stream:
        if len(stream.read(most + 1)) > most:
            raise _too_large("a compressed tile that is larger after decompression", most)


def _too_large(got: str, most: int) -> DataError:
    return DataError(
        "tile-too-large", f"expected tiles of at most {most} bytes, as ZTILEn declare; got {got}"
    )
