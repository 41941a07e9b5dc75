"""Read the pixels of one HDU, and write a list of HDUs to a file.

A file that this module writes has the cards CHECKSUM and DATASUM, but no date of writing. Equal content therefore
gives equal bytes.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.io.fits.hdu.compressed._compression import CfitsioException
from astropy.io.fits.verify import VerifyError
from numpy.typing import NDArray

from psfcore.errors import DataError
from psfcore.fits.header import HeaderSummary
from psfcore.fits.tiles import check_tiles

_CHECKSUM_COMMENT = "computed when the file was written"
# Exceptions that astropy raises for a damaged data unit. The position of the damage decides which one it raises.
PIXEL_TROUBLE = (
    CfitsioException,  # raised when RICE decoding fails; astropy has no public name for it
    VerifyError,
    OSError,
    EOFError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    ArithmeticError,
    RuntimeError,
    struct.error,
    zlib.error,
)


def read_pixels(path: str | Path, summary: HeaderSummary) -> tuple[NDArray[np.float64], fits.Header]:
    """Pixels [y, x] (float64) and header of the image that `summary` describes.

    Raises DataError "unreadable-pixels" or "tile-too-large", and OSError if the disk fails.
    """
    try:
        if summary.codec is not None:
            _check_tiles(path, summary)
        # uint=False: otherwise astropy converts unsigned integers (BZERO 32768) before it applies BLANK.
        with fits.open(path, mode="readonly", memmap=False, lazy_load_hdus=True, uint=False) as hdus:
            hdu = hdus[summary.hdu]
            header = hdu.header.copy()
            data = hdu.data
            pixels = np.array(data, dtype=np.float64)
    except DataError:
        raise
    except PIXEL_TROUBLE as error:
        _raise_if_storage(error)
        message = f"expected readable pixels in HDU {summary.hdu} of {Path(path).name}; got: {error!s:.120}"
        raise DataError("unreadable-pixels", message) from None
    if pixels.shape != summary.shape:
        message = f"expected {summary.shape} pixels, as the header declares; got {pixels.shape}"
        raise DataError("unreadable-pixels", message)
    return pixels, header


class _TableHeap:
    """The heap after the rows of a binary table. It holds the compressed tiles."""

    def __init__(self, hdu: fits.BinTableHDU) -> None:
        place = hdu.fileinfo()
        self._file = place["file"]
        rows_bytes = hdu.header["NAXIS1"] * hdu.header["NAXIS2"]
        self._first = place["datLoc"] + int(hdu.header.get("THEAP", rows_bytes))

    def read(self, offset: int, count: int) -> bytes:
        self._file.seek(self._first + offset)
        return bytes(self._file.read(count))


def _check_tiles(path: str | Path, summary: HeaderSummary) -> None:
    """Raise DataError "tile-too-large" if a tile, when decompressed, has more pixels than its header declares."""
    with fits.open(path, memmap=False, lazy_load_hdus=True, disable_image_compression=True) as hdus:
        table = hdus[summary.hdu]
        tile_pixels = int(table.header.get("ZTILE1", summary.shape[1])) * int(table.header.get("ZTILE2", 1))
        formats = {column.name: column.format for column in table.columns}
        rows = np.asarray(table.data).view(np.ndarray)
        assert summary.codec is not None
        check_tiles(rows, formats, _TableHeap(table), summary.codec, tile_pixels)


def _raise_if_storage(error: Exception) -> None:
    """Raise the error again if the disk caused it, and not the content of the file."""
    if isinstance(error, OSError) and error.errno is not None:
        raise error


def ascii_text(text: str) -> str:
    """Convert a text to printable ASCII, as FITS requires. White space becomes a space; other characters become '?'."""
    return "".join(c if " " <= c <= "~" else " " if c.isspace() else "?" for c in text)


def write_hdus(path: str | Path, hdus: list[Any]) -> None:
    """Write HDUs with checksums, but without a date of writing."""
    hdus[0].header["EXTEND"] = True
    for hdu in hdus:
        hdu.verify("silentfix")
        hdu.add_checksum(when=_CHECKSUM_COMMENT)
    # Pass an open file. If astropy gets a name such as x.fits.gz, it compresses the file because of the ending.
    with Path(path).open("wb") as file:
        fits.HDUList(hdus).writeto(file, output_verify="silentfix")
