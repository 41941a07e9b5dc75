"""The middle of a stored PSF as a FITS file, cut out of the stored file's bytes: no array is made of them.

A FITS image is its rows, one after the other, so a cut-out is a stretch of bytes of each of its rows (FITS standard
4.0, section 3.3.2). That holds for a plain image in the first HDU, as every PSF is that is built or fitted here.
"""

from __future__ import annotations

import math
import sys
from array import array
from pathlib import Path
from typing import BinaryIO

from astropy.io.fits import Header

from psfcore.errors import DataError
from psfcore.fits.header import BLOCK_BYTES, FitsLimits, read_summary

_CARD_BYTES = 80
_END = b"END" + b" " * 77
_FLOATS = {-32: "f", -64: "d"}
# Cards of the whole that a part makes wrong; what a part needs is written anew.
_DROPPED = ("EXTEND", "CHECKSUM", "DATASUM", "DATAMIN", "DATAMAX", "DATAMEAN", "PCOUNT", "GCOUNT")


def cutout(path: Path, size: int, limits: FitsLimits) -> bytes:
    """The central (size, size) px of a PSF's file as a FITS file, the centre at [size // 2, size // 2].

    Raises DataError "cutout-too-large", "cutout-not-plain" where the file is compressed or holds no plain floats.
    """
    summary = read_summary(path, limits)
    ny, nx = summary.shape
    if not 1 <= size <= min(ny, nx):
        raise DataError("cutout-too-large", f"expected a size of 1 to {min(ny, nx)} px; got {size}")
    plain = summary.hdu == 0 and summary.codec is None and not summary.gzipped
    if not plain or summary.bitpix not in _FLOATS:
        raise DataError(
            "cutout-not-plain",
            "expected a PSF whose file is a plain image of floats in its first HDU; this one is compressed, of whole "
            "numbers, or further back: download its file, and `heliopsf psf cutout` cuts it",
        )
    with path.open("rb") as file:
        header = _header(file)
        if "BSCALE" in header or "BZERO" in header:
            raise DataError("cutout-not-plain", "expected a PSF without BSCALE and BZERO; download its file")
        pixels = _middle(file, file.tell(), (ny, nx), size, abs(summary.bitpix) // 8)
    weights = array(_FLOATS[summary.bitpix], pixels)
    if sys.byteorder == "little":
        weights.byteswap()
    text = _cut_header(header, (ny, nx), size, math.fsum(weights)).tostring().encode("ascii")
    return text + pixels + bytes(-len(pixels) % BLOCK_BYTES)


def _header(file: BinaryIO) -> Header:
    """The first header; the file is left at the first byte of its data."""
    raw = bytearray()
    block = b""
    while not any(block[at : at + _CARD_BYTES] == _END for at in range(0, len(block), _CARD_BYTES)):
        block = file.read(BLOCK_BYTES)  # read_summary has seen the END
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
