"""Write the central part of a stored PSF as a FITS file, without loading the whole PSF.

A FITS image stores its rows one after the other (FITS standard 4.0, section 3.3.2), so a cut-out consists of a range
of bytes from each row. The image must be uncompressed and in the first HDU. Every PSF that heliopsf writes is stored
in this way.
"""

from __future__ import annotations

import math
import sys
from array import array
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from psfcore.errors import DataError
from psfcore.fits.blocks import BLOCK_BYTES, CARD_BYTES, END_CARD
from psfcore.fits.header import FitsLimits, read_summary

if TYPE_CHECKING:
    from astropy.io.fits import Header

_FLOATS = {-32: "f", -64: "d"}
# Cards that describe the whole image and would be wrong in a cut-out.
_DROPPED = ("EXTEND", "CHECKSUM", "DATASUM", "DATAMIN", "DATAMAX", "DATAMEAN", "PCOUNT", "GCOUNT")


def cutout(path: Path, size: int, limits: FitsLimits) -> bytes:
    """Return the bytes of a FITS file that holds the central (size, size) px of a PSF.

    The centre of the PSF is at [size // 2, size // 2]. Raises DataError "cutout-too-large" if the PSF is smaller, and
    "cutout-not-plain" if the file is compressed or does not hold plain floats.
    """
    summary = read_summary(path, limits)
    ny, nx = summary.shape
    if not 1 <= size <= min(ny, nx):
        raise DataError("cutout-too-large", f"expected a size of 1 to {min(ny, nx)} px; got {size}")
    plain = summary.hdu == 0 and summary.codec is None and not summary.gzipped
    if not plain or summary.bitpix not in _FLOATS:
        raise DataError(
            "cutout-not-plain",
            "expected a PSF stored as uncompressed floats in the first HDU; this PSF is compressed, stored as integers, or "
            "in a later HDU. Download the file and run `heliopsf psf cutout` on it",
        )
    with path.open("rb") as file:
        header = _header(file)
        if "BSCALE" in header or "BZERO" in header:
            raise DataError(
                "cutout-not-plain",
                "expected a PSF without BSCALE and BZERO. Download the file and run `heliopsf psf cutout` on it",
            )
        pixels = _middle(file, file.tell(), (ny, nx), size, abs(summary.bitpix) // 8)
    weights = array(_FLOATS[summary.bitpix], pixels)
    if sys.byteorder == "little":
        weights.byteswap()
    text = _cut_header(header, (ny, nx), size, math.fsum(weights)).tostring().encode("ascii")
    return text + pixels + bytes(-len(pixels) % BLOCK_BYTES)


def _header(file: BinaryIO) -> Header:
    """Read the first header; the file is then at the first byte of its data."""
    from astropy.io.fits import Header  # see psfcore.fits.blocks: slow to import

    raw = bytearray()
    block = b""
    while not any(block[at : at + CARD_BYTES] == END_CARD for at in range(0, len(block), CARD_BYTES)):
        block = file.read(BLOCK_BYTES)  # the loop ends, because read_summary found an END card
        raw += block
    return Header.fromstring(bytes(raw))


def _middle(file: BinaryIO, first: int, shape: tuple[int, int], size: int, pixel_bytes: int) -> bytes:
    ny, nx = shape
    top, left = ny // 2 - size // 2, nx // 2 - size // 2
    rows = []
    for row in range(top, top + size):
        file.seek(first + (row * nx + left) * pixel_bytes)
        rows.append(file.read(size * pixel_bytes))
    return b"".join(rows)


def _cut_header(header: Header, shape: tuple[int, int], size: int, total: float) -> Header:
    cut = header.copy()
    for key in _DROPPED:
        cut.remove(key, ignore_missing=True, remove_all=True)
    for axis, whole in ((1, shape[1]), (2, shape[0])):
        cut[f"NAXIS{axis}"] = size
        if f"CRPIX{axis}" in cut:
            cut[f"CRPIX{axis}"] -= whole // 2 - size // 2
    cut["PSFSUM"] = (total, "sum of weights on this array")
    cut["REACH"] = (math.hypot(size // 2, size // 2), "[pixel] farthest pixel from the centre")
    cut.add_history(f"central {size} x {size} px of {shape[1]} x {shape[0]}, not renormalised")
    return cut
