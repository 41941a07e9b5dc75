"""Check the tiles of a compressed image before they are decoded.

FITS standard 4.0, section 10.1: each row of the table holds descriptors (length, offset) of one tile in the table's
heap. The decoders of astropy trust these numbers and the content of the heap. Therefore:

- Every descriptor must lie within the heap.
- A gzip stream does not reliably state its decompressed size: half a megabyte can become half a gigabyte, even if the
  cards ZNAXISn declare a small image. Therefore each stream is first decompressed up to a limit.
- Every tile must contain exactly its pixels, with 1, 2, 4 or 8 bytes per pixel. A scaled pixel may have at most 4
  bytes: for 8 bytes, astropy 8.0 returns memory that it has not written.
- A stream of RICE_1 must be complete, because the decoder may read past its end (`psfcore.fits.tiled.rice`).
"""

from __future__ import annotations

import gzip
import io
from collections.abc import Iterator
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.tiled.compression import COMPRESSED, GZIPPED, UNCOMPRESSED, Compression
from psfcore.fits.tiled.rice import rice_is_complete

_OVERHEAD_BYTES = 1024  # upper limit of the bytes that gzip adds to its content
_PIXEL_BYTES, _SCALED_PIXEL_BYTES = (1, 2, 4, 8), (1, 2, 4)


class Heap(Protocol):
    """The bytes to which the descriptors refer."""

    def read(self, offset: int, count: int) -> bytes:
        """Read `count` bytes, starting at `offset`; fewer at the end of the file."""


def check_tiles(rows: NDArray[np.void], image: Compression, heap: Heap) -> None:
    """Raise DataError "bad-tile" or "tile-too-large" if a tile does not hold exactly its pixels.

    rows: the rows of the table as stored. A broken gzip stream raises OSError, EOFError or zlib.error.
    """
    descriptors = {name: _descriptors(rows, name, image) for name in image.items}
    stored = descriptors[COMPRESSED][:, 0] > 0
    spare = GZIPPED if GZIPPED in descriptors else UNCOMPRESSED
    for number, pixels in enumerate(_tile_pixels(image)):
        name = COMPRESSED if stored[number] else spare
        if name not in descriptors or not descriptors[name][number, 0]:
            raise DataError("bad-tile", f"expected data of tile {number}; got none")
        items, offset = descriptors[name][number].tolist()
        count = items * image.items[name]
        scaled = image.quantised and name == COMPRESSED
        widths = _SCALED_PIXEL_BYTES if scaled else _PIXEL_BYTES
        if name == UNCOMPRESSED:
            _check_width(items, pixels, (1,), number)
        elif name == GZIPPED or image.codec.startswith("GZIP"):
            _check_gzip(heap, offset, count, pixels, widths, number)
        elif image.codec == "NOCOMPRESS":
            _check_width(count, pixels, widths, number)
        elif not rice_is_complete(heap.read(offset, count), pixels, image.bytepix, image.blocksize):
            raise DataError(
                "bad-tile", f"expected {pixels} pixels in tile {number}; its stream ends too early"
            )


def _descriptors(rows: NDArray[np.void], name: str, image: Compression) -> NDArray[np.int64]:
    """Length in items and offset in bytes of each tile, shape (tiles, 2). Raises DataError "bad-tile"."""
    found = np.asarray(rows[name]).reshape(len(rows), -1).astype(np.int64)
    item_bytes = image.items[name]
    good = (found >= 0).all(axis=1) & (found[:, 0] <= image.heap_bytes // item_bytes)
    good &= found[:, 1] <= image.heap_bytes - np.where(good, found[:, 0], 0) * item_bytes
    if not good.all():
        first = int(np.flatnonzero(~good)[0])
        count, offset = found[first].tolist()
        message = f"expected tile {first} within the {image.heap_bytes} bytes of the heap"
        raise DataError("bad-tile", f"{message}; got {count} x {item_bytes} bytes at {offset}")
    return found


def _tile_pixels(image: Compression) -> Iterator[int]:
    """The number of pixels of each tile, in the order of the rows of the table; tiles at the edges are smaller."""
    ny, nx = image.shape
    tile_y, tile_x = image.tile
    for y in range(0, ny, tile_y):
        for x in range(0, nx, tile_x):
            yield min(tile_y, ny - y) * min(tile_x, nx - x)


def _check_gzip(
    heap: Heap, offset: int, count: int, pixels: int, widths: tuple[int, ...], number: int
) -> None:
    most = pixels * widths[-1]
    # A correct stream is hardly longer than its content. A much longer stream is refused, because reading it costs
    # time, and many descriptors may refer to the same stream.
    if count > 2 * most + _OVERHEAD_BYTES:
        raise _too_large(f"a compressed tile of {count} bytes", most)
    with gzip.GzipFile(fileobj=io.BytesIO(heap.read(offset, count))) as stream:
        content = len(stream.read(most + 1))
    if content > most:
        raise _too_large("a compressed tile that is larger after decompression", most)
    _check_width(content, pixels, widths, number)


def _check_width(content: int, pixels: int, widths: tuple[int, ...], number: int) -> None:
    if content not in {pixels * width for width in widths}:
        wanted = " or ".join(str(pixels * width) for width in widths)
        raise DataError("bad-tile", f"expected {wanted} bytes or items in tile {number}; got {content}")


def _too_large(got: str, most: int) -> DataError:
    return DataError(
        "tile-too-large", f"expected tiles of at most {most} bytes, as ZTILEn declare; got {got}"
    )
