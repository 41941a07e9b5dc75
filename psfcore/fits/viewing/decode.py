"""Decode one plane of a FITS file row by row, so that memory holds only some rows.

A tile-compressed image is read in whole rows of tiles. The values are the values of the file after BSCALE, BZERO and
BLANK are applied. No pixel is divided by the exposure time or masked.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from astropy.io import fits

from psfcore.errors import DataError
from psfcore.fits.hdus import ascii_text, opened_image, readable_pixels
from psfcore.fits.header import FitsLimits, check_all_headers, optional_text, read_summary
from psfcore.fits.viewing.planes import IMAGE, Decoded

_BLOCK_BYTES = 2**22
_DECODED_BYTES = 8  # largest number of bytes of a pixel while it is decoded
_LONGEST_UNIT = 68  # characters of a card's value


def decode_plane(path: str | Path, name: str, limits: FitsLimits, target: BinaryIO) -> Decoded:
    """Write the pixels of a plane to ``target`` as little-endian float32, in the order of the FITS file (row 0 first).

    NaN stays NaN. name: IMAGE for the first 2-D image of the file, or the name of a plane of a product, for example
    "quality". Returns the shape and the unit of the plane. Raises HeaderError for an unusable header; DataError
    "unreadable-pixels", "bad-tile", "tile-too-large" or "no-such-plane".
    """
    if name == IMAGE:
        with opened_image(path, read_summary(path, limits)) as hdu:
            return _written(hdu, target)
    check_all_headers(path, limits)
    with _opened_plane(path, name.upper()) as hdu:
        return _written(hdu, target)


def _written(hdu: Any, target: BinaryIO) -> Decoded:
    # Products of early versions hold a plane in a table with one row.
    if isinstance(hdu, fits.BinTableHDU):
        whole = hdu.data[hdu.name][0]
        shape, parts = whole.shape, iter([whole])
    else:
        shape, parts = hdu.shape, _rows(hdu)
    for rows in parts:
        target.write(np.ascontiguousarray(rows, dtype="<f4").data)
    unit = optional_text(hdu.header, "BUNIT")
    return Decoded((int(shape[0]), int(shape[1])), None if unit is None else ascii_text(unit)[:_LONGEST_UNIT])


def _rows(hdu: Any) -> Iterator[Any]:
    """The pixels of an image [y, x], read a few rows at a time to save memory."""
    ny, nx = hdu.shape
    at_once = max(1, _BLOCK_BYTES // (nx * _DECODED_BYTES))
    if isinstance(hdu, fits.CompImageHDU):
        tile_rows = hdu.tile_shape[0]
        # A multiple of tile_rows, so that no tile is decoded twice.
        at_once = -(-at_once // tile_rows) * tile_rows
    for first in range(0, ny, at_once):
        yield hdu.section[first : min(first + at_once, ny)]


@contextmanager
def _opened_plane(path: str | Path, name: str) -> Iterator[Any]:
    with (
        readable_pixels(path, f"plane {name}"),
        fits.open(path, memmap=False, uint=False, disable_image_compression=True) as hdus,
    ):
        planes = {hdu.name: hdu for hdu in hdus[1:] if hdu.header.get("PLANE") is True}
        if name not in planes:
            there = ", ".join([IMAGE, *map(str.lower, planes)])
            advice = ": submit the deconvolution with error_draws" if name == "ERROR" else ""
            raise DataError(
                "no-such-plane", f"expected a plane of this file ({there}); got {name.lower()}{advice}"
            )
        yield planes[name]
